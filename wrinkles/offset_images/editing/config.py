"""Settings of drawn and edited offset images; the standard library alone, for the command line's sake."""

from __future__ import annotations

from typing import Annotated, Literal

from capture4d.settings import PowerOfTwo, Range, settings

__all__ = ["DrawConfig", "PictureFormat"]

PictureFormat = Literal["tif", "exr", "png"]


@settings
class DrawConfig:
    """How offsets are drawn."""

    texels: Annotated[int, Range(least=16), PowerOfTwo] = 256
    """Side of the pictures."""
    format: PictureFormat = "tif"
    """`tif` and `exr` (extra `exr`) keep float32 centimetres, exactly; `png` has 16 bits over a range that it tells,
    for programs that know no more."""
