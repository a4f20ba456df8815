"""Scans in, the body's poses and one shape for the take out."""
