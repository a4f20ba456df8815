"""A garment that moves at another rate than the one it was learned at: its coefficients between the model's frames."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32
from scipy.interpolate import CubicSpline

from capture4d.types import PoseSequence

__all__ = ["coefficients_at", "seconds"]


def seconds(poses: PoseSequence) -> Float[np.ndarray, " frames"]:
    """When each frame is, counted from the first."""
    return (poses.frame_ids - poses.frame_ids[0]) / poses.fps


def coefficients_at(
    coefficients: Float32[np.ndarray, "frames shapes"],
    known: Float[np.ndarray, " frames"],
    wanted: Float[np.ndarray, " others"],
) -> Float32[np.ndarray, "others shapes"]:
    """Coefficients at other times, by a natural cubic spline through those that are known; before the first and after
    the last they stay.

    Where the garment's frames lie, they are what the regressor said. Interpolated coefficients, unlike interpolated
    vertices, move with a body that is posed at the wanted time: limbs keep their length.

    Args:
        known, wanted: seconds, ascending.
    """
    if len(known) == 1:
        return np.repeat(coefficients, len(wanted), axis=0)
    spline = CubicSpline(known, coefficients.astype(np.float64), bc_type="natural")
    return spline(np.clip(wanted, known[0], known[-1])).astype(np.float32)
