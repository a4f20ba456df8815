"""Photographs of a calibration board."""
