"""Pixel-based cloth: offsets from the body as images in pattern space."""
