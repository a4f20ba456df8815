"""Cameras and the board they look at: projection, and rigs in the files of other programs."""
