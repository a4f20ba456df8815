"""Settings that every way to an animated garment has."""

from __future__ import annotations

from capture4d.settings import Count, NonNegative, Share, Whole, settings

__all__ = ["RemovalConfig"]


@settings
class RemovalConfig:
    """Taking an animated garment out of the body; `capture4d.geometry.intersection_removal` reads this."""

    enabled: bool = True
    """Take the garment out of the body; off, what is inside is only measured, and edges alone keep to their lengths."""
    margin_mm: NonNegative = 2.0
    """How far outside the body its vertices are put."""
    rounds: Whole = 12
    """Searches for where the limbs are; it ends sooner if nothing moves."""
    sweeps: Count = 15
    """Passes over all edges and vertices from one search to the next."""
    spread: Share = 0.2
    """Share of the way to its neighbours' mean displacement that a vertex goes in a pass, at first; none in the end."""
