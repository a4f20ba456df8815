"""How many points of a scan are kept for tracking. Standard library only: settings of `track` hold it."""

from __future__ import annotations

from capture4d.settings import Positive, settings

__all__ = ["SamplingConfig"]


@settings
class SamplingConfig:
    """How many points a scan gives."""

    body_cell_m: Positive = 0.016
    """One point per cell of this size on skin and suit."""
    cloth_cell_m: Positive = 0.028
    """The same on the garment."""
