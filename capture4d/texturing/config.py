"""Settings of `texture`, and the names of what it writes. Standard library alone: `capture4d --help` loads it."""

from __future__ import annotations

from typing import Annotated

from capture4d.settings import Positive, Range, settings

__all__ = ["ALBEDO", "TEMPLATE", "TEXTURE", "TextureConfig"]

TEXTURE, ALBEDO, TEMPLATE = "texture", "albedo.png", "template.npz"
"""Folder of the texture in WORK, the picture, and the garment over whose UVs it lies."""


@settings
class TextureConfig:
    """How colours of scans become a picture."""

    texels: Annotated[int, Range(least=64, most=8192)] = 1024
    """Along each side of the picture. More than a scan has points show nothing more."""
    frames: Annotated[int, Range(least=1, most=200)] = 24
    """Frames that are looked at, evenly over the take."""
    light: bool = True
    """Divide out the light, as far as it goes by the direction in which the cloth faces."""
    distance_m: Positive = 0.008
    """Farther from the registered cloth than so much a scan says nothing of it."""
