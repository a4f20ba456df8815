"""Settings of the export. Standard library alone: `capture4d --help` loads it."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Literal, get_args

from capture4d.settings import Positive, Range, settings

__all__ = ["FORMATS", "Along", "ExportConfig", "Format", "GlbConfig"]

Format = Literal["usd", "abc", "glb", "pc2", "mdd", "obj", "ply", "html"]
FORMATS: tuple[Format, ...] = get_args(Format)
Along = Literal["scans", "body"]


@settings
class GlbConfig:
    """How a GLB, which knows neither caches nor frames, is made to move."""

    motion: Literal["skinned", "exact"] = "skinned"
    """`skinned`: the skeleton moves it, and few shapes correct it, within the errors below. `exact`: a shape for each
    frame, for clips of up to a hundred frames or so."""
    p99_mm: Positive = 0.5
    """Error that 99 of 100 vertices keep, over all frames, ..."""
    max_mm: Positive = 2.0
    """... and the largest that any has."""
    most: Annotated[int, Range(least=1, most=400)] = 128
    """Correcting shapes at most, whatever is left of the error, which is told."""


@settings
class ExportConfig:
    """What is written beside positions, and how."""

    maps: Literal["8", "16", "none"] = "8"
    """Bits of the normal maps of WORK/wrinkles/generated that go along, if there are any."""
    albedo: str | None = None
    """Picture of the cloth's colours over the template's UVs, as `texture` makes one; if absent, that of WORK/texture,
    if there is one; `none` leaves it out."""
    along: tuple[Along, ...] = ()
    """What goes along: `body`, the body in the same formats, its motion as a bvh; `scans`, coloured, a ply a frame."""
    normals: bool = True
    """Author each frame's vertex normals in USD and Alembic: every client shades alike, Blender shows a frame in three
    times the time."""
    glb: GlbConfig = field(default_factory=GlbConfig)
