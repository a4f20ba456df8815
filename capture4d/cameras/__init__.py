"""Cameras and the board they look at: projection, COLMAP's files."""
