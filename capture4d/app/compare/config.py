"""Settings of the comparison. Standard library only: the command line imports this to print its help."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CompareConfig"]


@dataclass(frozen=True, slots=True)
class CompareConfig:
    """What is compared."""

    held_out: float = 0.2
    """Share of frames at the end of the take that nothing is learned from here. A network keeps its own split."""
    gap: int = 10
    """Frames between the two that belong to neither."""
    pictures: int = 3
    """Held-out frames drawn."""
    image_texels: int = 256
    """Side of the offset images."""
    epochs: int = 30
    """Of the offset networks."""
