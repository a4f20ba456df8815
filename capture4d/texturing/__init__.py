"""Textures: the colours of a take's scans, baked to the template's UVs."""
