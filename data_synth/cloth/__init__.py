"""Sewing patterns, and cloth simulated from them."""
