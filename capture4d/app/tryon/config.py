"""Settings of the try-on. Standard library alone: `capture4d --help` loads it."""

from __future__ import annotations

from typing import Annotated

from capture4d.settings import Positive, Range, settings

__all__ = ["TryOnConfig"]


@settings
class TryOnConfig:
    """How live it is."""

    rest_after_s: Positive = 0.3
    """When nothing has moved for so long, the garment is taken out of the body exactly."""
    most_hz: Annotated[float, Range(least=1.0, most=120.0)] = 60.0
    """Frames a second at most."""
