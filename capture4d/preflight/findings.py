"""What may be wrong with a take: every kind of finding, how bad it is, what to do about it, and what is tolerated.

docs/reference/findings.md describes every finding.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

__all__ = ["ADVICE", "CODES", "Code", "Finding", "Limits", "Severity", "Verdict"]

Severity = Literal["error", "warning"]
Code = Literal[
    "units",
    "axes",
    "mirrored",
    "winding",
    "floor",
    "frame-unreadable",
    "frame-empty",
    "frame-nan",
    "read-in-part",
    "frame-partial",
    "frame-repeated",
    "frames-listed",
    "frames-missing",
    "frames-duplicated",
    "fps",
    "colours-missing",
    "colours-washed-out",
    "garment-absent",
    "border-absent",
    "border-not-separable",
    "border-on-body",
    "outside-volume",
    "noise",
    "holes",
    "faces-missing",
    "scale-jump",
    "poses-missing",
    "poses-mismatch",
    "template",
    "borders-named",
]
CODES: tuple[Code, ...] = get_args(Code)

ADVICE: Mapping[Code, tuple[Severity, str]] = {
    "units": ("error", "set units in capture.json, or export in metres; --fix rewrites the scans in metres"),
    "axes": ("error", "export with Y up; --fix turns the scans"),
    "mirrored": ("error", "look for a left-handed axis convention in the export; --fix mirrors the scans back"),
    "winding": ("error", "reverse the faces on export; --fix does. If text reads backwards, the take is mirrored"),
    "floor": ("warning", "put the floor at y = 0; --fix shifts scans and poses where the feet or motion capture tell"),
    "frame-unreadable": ("error", "copy or reconstruct these frames again; --fix leaves them out"),
    "frame-empty": ("error", "reconstruct these frames again; --fix leaves them out"),
    "frame-nan": ("error", "reconstruct these frames again; --fix leaves them out"),
    "read-in-part": (
        "warning",
        "see whether what could not be used matters; if it does, export these frames again",
    ),
    "frame-partial": ("warning", "look at these frames: cameras may have dropped out; --fix leaves them out"),
    "frame-repeated": ("warning", "the recorder stalled; --fix leaves the copies out"),
    "frames-listed": ("error", "find these scans, or take the numbers out of frames in capture.json, as --fix does"),
    "frames-missing": ("warning", "find the frames, or accept the gap, as --fix does; times follow from frame numbers"),
    "frames-duplicated": (
        "error",
        "keep one file per frame number; --fix drops equal copies, and both of unequal ones",
    ),
    "fps": ("warning", "correct fps in capture.json; --fix does where files or motion capture tell the rate"),
    "colours-missing": ("error", "export with vertex colours, or with UVs and a texture beside the mesh"),
    "colours-washed-out": ("error", "check exposure, white balance and the colour space of the export"),
    "garment-absent": ("error", "measure the garment's colour in a scan and correct garment_colour in capture.json"),
    "border-absent": ("error", "paint the border, or correct boundary_colours in capture.json"),
    "border-not-separable": ("error", "paint the border in a hue far from the garment's and the other paints'"),
    "border-on-body": ("warning", "use a paint that neither skin, hair nor suit has, or change the suit"),
    "outside-volume": ("warning", "move the subject or the rig, or leave these frames out"),
    "noise": ("warning", "check calibration and focus; smooth the scans before registration"),
    "holes": ("warning", "check light and camera coverage; registration bridges holes but cannot see in them"),
    "faces-missing": ("warning", "export meshes if there are any: faces between points are a guess, and holes blur"),
    "scale-jump": ("error", "reconstruct these frames with the others' calibration; --fix leaves them out"),
    "poses-missing": ("warning", "export the motion capture of all frames; --fix leaves the scans without a pose out"),
    "poses-mismatch": ("error", "check that poses.npz and body.npz are of this subject, take and time"),
    "template": ("error", "export the garment mesh again, or make the template anew with `capture4d template`"),
    "borders-named": (
        "error",
        "name the paints in boundary_colours as the template names its borders; --fix does where all have one paint",
    ),
}


@dataclass(frozen=True, slots=True)
class Limits:
    """What is tolerated. The strongest score of a sound take is 0.79 (`python -m benchmarks preflight --quick`)."""

    floor_rough_m: float = 0.35
    """Where neither feet nor motion capture tell the floor."""
    partial_area: float = 0.8
    """Least share of the take's typical surface size (square root of the area)."""
    scale_step: float = 0.04
    """Change of size that surface and spacing share."""
    noise: float = 0.12
    """Distance to the plane of the neighbours, spacings."""
    hole_share: float = 0.35
    fps_range: tuple[float, float] = (5.0, 1000.0)
    fastest_m_s: float = 3.0
    """Speed across the surface that a twentieth of a person exceeds."""
    slowest_m_s: float = 0.06
    """Nobody who moves at all moves slower than this all the time."""
    moved_m: float = 0.15
    """Who has moved less than this stood still."""
    fps_mismatch: float = 1.05
    """Factor between the capture's frame rate and that of motion capture or time stamps."""
    chroma_share: float = 0.5
    """Least share of the garment's chroma that the scans must show."""
    chroma: float = 10.0
    """Least chroma of the most colourful hundredth, where the garment's colour is not known; skin has 20."""
    clipped_share: float = 0.25
    garment_share: float = 0.02
    border_share: float = 0.002
    """Least share of a paint relative to the garment."""
    paint_angle: float = 0.36
    """Radians in linear RGB; the extraction takes 0.24 for one colour."""
    stray_share: float = 0.15
    """Largest share of a paint that lies away from the cloth."""
    cameras_lost: float = 0.12
    """Share of the views that a frame may lose against the take's best frames."""
    cameras_least: float = 0.5
    """Least share of the views that a frame has against the middle of the rig."""
    left_m: float = 0.25
    """Walked this far while the surface shrinks: left the volume, where no rig tells."""
    pose_distance_m: float = 0.02
    pose_distance_dressed_m: float = 0.04
    """The same where cloth cannot be told from the body."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong."""

    code: Code
    found: str
    """What was measured, for people."""
    score: float
    """Measured over tolerated."""
    frames: tuple[int, ...] = ()
    """Where; empty for the whole take."""

    @property
    def severity(self) -> Severity:
        return ADVICE[self.code][0]

    @property
    def advice(self) -> str:
        return ADVICE[self.code][1]


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    findings: tuple[Finding, ...]
    """Errors first, in the order of `CODES`."""
    scores: Mapping[Code, float]
    """Of everything that was checked, findings or not."""
