"""Colours as people write them."""

from __future__ import annotations

import re

from capture4d.errors import InputError

__all__ = ["Colour", "format_colour", "parse_colour"]

Colour = tuple[int, int, int]
"""sRGB, 0 to 255."""


def parse_colour(text: str) -> Colour:
    """'#2f62c9' or '2f62c9' as numbers."""
    if not isinstance(text, str) or not re.fullmatch(r"#?[0-9a-fA-F]{6}", text):
        raise InputError(f"expected a colour such as #2f62c9, found '{text}'")
    red, green, blue = bytes.fromhex(text.removeprefix("#"))
    return red, green, blue


def format_colour(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)
