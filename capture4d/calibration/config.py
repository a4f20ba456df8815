"""Settings of rig calibration and of the check of a rig; the standard library alone, for the command line's sake."""

from __future__ import annotations

from typing import Annotated, Literal

from capture4d.settings import NonNegative, Part, Positive, Range, settings

__all__ = ["CALIBRATION", "RIG_CHECK", "CalibrationConfig", "RigCheckConfig"]


@settings
class CalibrationConfig:
    """How a rig is calibrated."""

    lens: Literal["brown", "fisheye"] = "brown"
    """Of all cameras: a pinhole with radial and tangential distortion, or an equidistant fisheye, for wide angles."""
    floor: str | None = None
    """Pose at which the board lies on the floor, printed side up: the world's origin and its Y axis."""
    held_out: Part = 0.15
    """Share of the poses that a second calibration leaves out and is measured on; 0 spares it."""
    flatness: bool = True
    """Solve once more with the shape of the board unknown."""
    start_loss_px: Positive = 1.0
    """Scale of the loss while start values are still millimetres off."""
    loss_sigmas: Positive = 2.385
    """Scale of the final loss in standard deviations: Cauchy's loss is then 95 % efficient on Gaussian noise."""


@settings
class RigCheckConfig:
    """When a camera counts as moved."""

    false_alarms: Annotated[float, Range(above=0, below=1)] = 2e-4
    """Share of checks of an untouched rig that may blame a camera."""
    floor_mm: NonNegative = 0.03
    """Standard deviation granted to every camera beyond its own: real lenses are not quite their model."""
    floor_deg: NonNegative = 0.001
    """The same for its direction."""


CALIBRATION = CalibrationConfig()
RIG_CHECK = RigCheckConfig()
