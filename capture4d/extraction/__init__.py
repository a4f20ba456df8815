"""Coloured scans in, the garment of each and the points on its painted borders out."""
