"""How much of a subject a rig sees: which cameras' images it lies in, here and in the middle of the rig."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, Int32

from capture4d.cameras.projection import project_world
from capture4d.types import Rig

__all__ = ["best_share", "camera_counts", "rig_middle"]

RIG_SAMPLES, RIG_STEP_M = 200, 0.3


def camera_counts(rig: Rig, points: Float[np.ndarray, "points 3"]) -> Int32[np.ndarray, " points"]:
    """In how many cameras' images each point lies; what hides it is not considered, nor distortion but a fisheye's."""
    counts = np.zeros(len(points), np.int32)
    for camera in range(len(rig.names)):
        if rig.lenses[camera] == "fisheye":
            counts += project_world(rig, camera, points.astype(np.float64))[1]
            continue
        T, (width, height) = rig.T_camera_world[camera], rig.image_sizes[camera]
        seen = points @ T[:3, :3].T + T[:3, 3]
        pixels = seen @ rig.intrinsics[camera].T
        depth = np.maximum(pixels[:, 2], 1e-9)
        u, v = pixels[:, 0] / depth, pixels[:, 1] / depth
        counts += (seen[:, 2] > 0) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
    return counts


def rig_middle(rig: Rig) -> Float64[np.ndarray, " 3"]:
    """The point nearest to all optical axes, in the least squares sense; where it is not determined, that nearest to
    the cameras' mean."""
    axes = rig.T_camera_world[:, 2, :3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    start = rig.centres.mean(axis=0)
    away = np.einsum("cab,cb->a", across, rig.centres - start)
    return start + np.linalg.pinv(across.sum(axis=0), rcond=1e-6) @ away


def best_share(rig: Rig, points: Float[np.ndarray, "points 3"]) -> float:
    """Share of the cameras that would see the points, moved about the middle of the rig: the best of a few places."""
    few = points[:: max(1, len(points) // RIG_SAMPLES)]
    home = (rig_middle(rig) - few.mean(axis=0)) * (1, 0, 1)
    steps = (-RIG_STEP_M, 0.0, RIG_STEP_M)
    shares = [camera_counts(rig, few + home + (x, 0.0, z)).mean() for x in steps for z in steps]
    return float(max(shares) / max(len(rig.names), 1))
