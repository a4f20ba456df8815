"""Garments of several kinds draped on still bodies, one pose at a time."""
