"""Colours and sizes that all pages share."""

from __future__ import annotations

__all__ = ["BLUE", "BODY", "CLOTH", "GREEN", "GREY", "HEIGHT", "LOOP", "ORANGE", "SKIN", "WIDTH"]

# Of curves.
BLUE, ORANGE, GREEN, GREY = "#2f62c9", "#d9772b", "#2f8f5b", "#8d97a5"
# sRGB of what is drawn: a garment, a person beside it, a tracked body over a scan, a border.
CLOTH, SKIN, BODY, LOOP = (176, 190, 208), (214, 190, 172), (226, 142, 84), (222, 140, 28)
WIDTH, HEIGHT = 400, 370
"""Of a picture, pixels."""
