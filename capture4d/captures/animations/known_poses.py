"""Which poses a garment was learned from, and how far others are from them.

The distance of two poses is the root mean square, over the garment's joints, of the angle between their rotations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from scipy.spatial.transform import Rotation

from capture4d.types import PoseSequence

__all__ = ["PoseRange", "nearest_poses", "pose_quaternions"]

PAIRS = 4_000_000
"""Joint angles that are compared at once."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseRange:
    """The poses a garment was learned from."""

    quaternions: Float32[np.ndarray, "training joints 4"]
    joints: tuple[int, ...]
    """The garment's, as positions in the skeleton."""
    validated_deg: float
    """How far validation frames were from the training poses while they validated, 95 %."""

    def distances(self, poses: PoseSequence) -> Float64[np.ndarray, " frames"]:
        """Degrees to the nearest learned pose."""
        return nearest_poses(pose_quaternions(poses.rotations, self.joints), self.quaternions)[0]


def pose_quaternions(
    rotations: Float[np.ndarray, "frames all 3 3"], joints: tuple[int, ...]
) -> Float32[np.ndarray, "frames joints 4"]:
    """Rotations of some joints as unit quaternions."""
    chosen = rotations[:, list(joints)].astype(np.float64)
    return Rotation.from_matrix(chosen.reshape(-1, 3, 3)).as_quat().reshape(*chosen.shape[:2], 4).astype(np.float32)


def nearest_poses(
    poses: Float32[np.ndarray, "frames joints 4"], training: Float32[np.ndarray, "training joints 4"]
) -> tuple[Float64[np.ndarray, " frames"], Int64[np.ndarray, " frames"]]:
    """Distance in degrees to the nearest training pose, and which it is."""
    distance, nearest = np.zeros(len(poses)), np.zeros(len(poses), np.int64)
    joints = poses.shape[1]
    if not joints or not len(training):
        return distance, nearest
    size = max(1, PAIRS // (len(training) * joints))
    for start in range(0, len(poses), size):
        part = poses[start : start + size].astype(np.float64)
        cosine = np.abs(np.einsum("tjq,njq->tnj", part, training.astype(np.float64)))
        squares = np.mean((2 * np.arccos(np.minimum(cosine, 1.0))) ** 2, axis=2)
        nearest[start : start + size] = np.argmin(squares, axis=1)
        distance[start : start + size] = np.degrees(np.sqrt(squares.min(axis=1)))
    return distance, nearest
