"""Settings of the comparison. Standard library only: the command line imports this to print its help."""

from __future__ import annotations

from typing import Annotated

from capture4d.settings import Count, PowerOfTwo, Range, Whole, settings

__all__ = ["CompareConfig"]


@settings
class CompareConfig:
    """What is compared."""

    held_out: Annotated[float, Range(above=0, below=1)] = 0.2
    """Share of frames at the end of the take that nothing is learned from here. A network keeps its own split."""
    gap: Whole = 10
    """Frames between the two that belong to neither."""
    pictures: Count = 3
    """Held-out frames drawn."""
    image_texels: Annotated[int, Range(least=16), PowerOfTwo] = 256
    """Side of the offset images."""
    epochs: Count = 30
    """Of the offset networks."""
