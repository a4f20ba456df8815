"""Registered and animated garments on their way out to other tools."""
