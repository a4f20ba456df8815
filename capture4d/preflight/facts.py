"""What a take says about itself, and what its file names say: claims that measuring the scans may refute."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from capture4d.colours.spaces import Colour

__all__ = ["BadFrame", "Paints", "TakeFacts"]


@dataclass(frozen=True, slots=True)
class Paints:
    """Colours that the take's description promises."""

    garment: Colour | None = None
    borders: tuple[Colour, ...] = ()


@dataclass(frozen=True, slots=True)
class BadFrame:
    """A frame that cannot be looked at."""

    frame_id: int
    code: Literal["frame-unreadable", "frame-empty", "frame-nan"]
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class TakeFacts:
    """What a take says about itself, and what its file names say."""

    fps: float | None
    declared: float
    """Metres in a unit of the scan files."""
    paints: Paints = field(default_factory=Paints)
    border_names: tuple[tuple[str, ...], ...] = ()
    """Names of the borders of each paint."""
    borders_claimed: bool = False
    """The paints are those of the caller, who names no borders."""
    frame_ids: tuple[int, ...] = ()
    """All frame numbers with a file that the stages take, ascending."""
    listed: tuple[int, ...] | None = None
    """Frames that the description names."""
    dropped: tuple[int, ...] = ()
    """Frames that the description says, or by its list of frames shows, were left out."""
    duplicated: tuple[int, ...] = ()
    """Frame numbers with more than one file."""
    pose_frames: tuple[int, ...] | None = None
    pose_fps: float | None = None
    template_loops: tuple[str, ...] | None = None
    """Names of the template's borders; None without a template, or if it cannot be read."""
    template_fault: str = ""
    """Why the template cannot be registered."""
    unlisted: tuple[str, ...] = ()
    """Files among the scans that no stage takes: of frames that the description does not list, or without a number."""
