"""Settings of the viewer. Standard library alone: `capture4d --help` loads it."""

from __future__ import annotations

from typing import Annotated

from capture4d.settings import Count, Positive, Range, settings

__all__ = ["ViewConfig"]


@settings
class ViewConfig:
    """How coarse scans are shown, and how much is kept in memory."""

    preview_mm: Annotated[float, Range(least=1.0, most=200.0)] = 10.0
    """Scans are shown with a vertex for each cube of this side."""
    memory_mb: Count = 128
    """Frames that were shown are kept ready in so much memory."""
    look_every_s: Positive = 2.0
    """Seconds between two looks for new frames."""
