"""Settings of the comparison. Standard library only: the command line imports this to print its help."""

from __future__ import annotations

from typing import Annotated

from capture4d.settings import Count, Range, Whole, settings

__all__ = ["CompareConfig"]


@settings
class CompareConfig:
    """What is compared."""

    held_out: Annotated[float, Range(above=0, below=1)] = 0.2
    """Share of frames at the end of the take that are compared. A network that learned from the take keeps its own
    split, and so do, if it did not, the offset images."""
    held_out_gap: Whole = 10
    """Frames between the two that belong to neither."""
    pictures: Count = 3
    """Held-out frames drawn."""
