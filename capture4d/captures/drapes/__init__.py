"""Folders of drapes: a garment at rest in many poses, of one style on one person, or of many styles and people."""
