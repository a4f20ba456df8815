"""Offset images as pictures that people and programs change, and the garment that comes of it."""
