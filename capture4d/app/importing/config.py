"""Settings of the import. Standard library alone: `capture4d --help` loads it."""

from __future__ import annotations

from typing import Literal

from capture4d.settings import Positive, settings
from capture4d.units import Units

__all__ = ["ImportConfig"]


@settings
class ImportConfig:
    """What a sequence of meshes does not say of itself."""

    fps: Positive | None = None
    """Frames a second; needed where the files do not tell: USD, Alembic and our GLB do."""
    units: Literal[Units, "auto"] = "auto"
    """Of the meshes; `auto`: what a USD file says, metres of all others."""
    up: Literal["y", "z", "auto"] = "auto"
    """Axis that points up; `auto`: what a USD file says, y of all others."""
