"""Colours: as people write them, as light, as people see them."""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Float, Float64, UInt8

from capture4d.errors import InputError

__all__ = [
    "Colour",
    "colour_angles",
    "encode_colours",
    "format_colour",
    "linear_colours",
    "nearly_encoded",
    "nearly_linear",
    "parse_colour",
    "to_lab",
]

Colour = tuple[int, int, int]
"""sRGB, 0 to 255."""
GAMMA = 2.2
"""The power that sRGB's curve is near to: at most 0.9 % of full light apart."""


def parse_colour(text: str) -> Colour:
    """'#2f62c9' or '2f62c9' as numbers."""
    if not isinstance(text, str) or not re.fullmatch(r"#?[0-9a-fA-F]{6}", text):
        raise InputError(f"expected a colour such as #2f62c9, found '{text}'")
    red, green, blue = bytes.fromhex(text.removeprefix("#"))
    return red, green, blue


def format_colour(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


def linear_colours(colours: np.ndarray) -> Float64[np.ndarray, "colours 3"]:
    """sRGB, 0 to 255, to linear light, 0 to 1; shading scales the latter."""
    value = colours / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def encode_colours(light: Float64[np.ndarray, "colours 3"]) -> UInt8[np.ndarray, "colours 3"]:
    """Linear light to sRGB; what is too bright is clipped."""
    light = np.clip(light, 0, 1)
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * value).astype(np.uint8)


def nearly_linear(values: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """sRGB, 0 to 1, to linear light, by a power alone: for shaded pictures and simulated cameras, which need to go back
    and forth and no true light. What measures colours takes `linear_colours`."""
    return values**GAMMA


def nearly_encoded(light: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Linear light to sRGB, 0 to 1, the way back of `nearly_linear`."""
    return light ** (1 / GAMMA)


def colour_angles(colours: UInt8[np.ndarray, "n 3"], reference: Colour) -> Float64[np.ndarray, " n"]:
    """Angle between colours and a reference in linear RGB, radians; shading does not change it."""
    light, wanted = linear_colours(colours), linear_colours(np.array([reference], np.uint8))[0]
    size = np.maximum(np.linalg.norm(light, axis=1) * np.linalg.norm(wanted), 1e-9)
    return np.arccos(np.clip(light @ wanted / size, -1, 1))


def to_lab(colours: UInt8[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """CIELAB of sRGB under D65: lightness 0 to 100, and two axes of chroma."""
    # IEC 61966-2-1 primaries, rows divided by the white point; CIE 15 for the cube roots.
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = linear_colours(colours) @ (to_xyz / to_xyz.sum(axis=1, keepdims=True)).T
    root = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.stack([116 * root[:, 1] - 16, 500 * (root[:, 0] - root[:, 1]), 200 * (root[:, 1] - root[:, 2])], axis=1)
