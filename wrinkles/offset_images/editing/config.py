"""Settings of drawn and edited offset images; the standard library alone, for the command line's sake."""

from __future__ import annotations

from typing import Annotated, Literal

from capture4d.settings import Count, NonNegative, PowerOfTwo, Range, Share, Whole, settings

__all__ = ["ApplyEditsConfig", "DrawConfig", "PictureFormat"]

PictureFormat = Literal["tif", "png"]


@settings
class DrawConfig:
    """How offsets are drawn."""

    texels: Annotated[int, Range(least=16), PowerOfTwo] = 256
    """Side of the pictures."""
    format: PictureFormat = "tif"
    """`tif` keeps float32 centimetres, exactly; `png` has 16 bits over a range that it tells, for programs that know no
    more."""


@settings
class ApplyEditsConfig:
    """How the edited garment is taken out of the body; `IntersectionRemoval` reads this."""

    enabled: bool = True
    """Take it out."""
    margin_mm: NonNegative = 2.0
    """How far outside the body its vertices are put."""
    rounds: Whole = 12
    """Searches for where the limbs are; it ends sooner if nothing moves."""
    sweeps: Count = 15
    """Passes over all edges and vertices from one search to the next."""
    spread: Share = 0.2
    """Share of the way to its neighbours' mean displacement that a vertex goes in a pass, at first; none in the end."""
