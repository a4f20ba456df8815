"""How far a pose is from those a garment was learned from: poses that are unlike any are reported, not trusted.

The distance of two poses is the root mean square, over the garment's joints, of the angle between their rotations.

References: DeepWrinkles (ECCV 2018), section 4.3: retargeting works best near the training poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.files.json_values import number, wholes
from capture4d.files.reading import reading
from capture4d.files.tensors import read_tensors, write_tensors
from capture4d.types import PoseSequence

__all__ = ["PoseRange", "load_pose_range", "nearest_poses", "pose_quaternions", "save_pose_range"]

_KIND = "capture4d training poses"
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


def save_pose_range(path: Path, known: PoseRange, *, model_digest: str) -> None:
    note = {"joints": list(known.joints), "validated_deg": known.validated_deg, "model": model_digest}
    write_tensors(path, _KIND, {"quaternions": known.quaternions}, note)


def load_pose_range(path: Path, *, model_digest: str) -> PoseRange:
    """Raises InputError: the file is damaged, another kind, or belongs to another model."""
    file = read_tensors(path, _KIND)
    if file.entry("model") != model_digest:
        raise InputError("expected the poses of the blendshapes beside it, found those of another model", where=path)
    with reading(path, "file of training poses"):
        joints = wholes(file.entry("joints"), "joints")
        validated_deg = number(file.entry("validated_deg"), "validated_deg")
        quaternions = file["quaternions"]
        if quaternions.dtype != np.float32 or quaternions.shape[1:] != (len(joints), 4):
            found = f"{quaternions.dtype} of {quaternions.shape}"
            raise InputError(f"expected quaternions of {len(joints)} joints as float32, found {found}")
        if not (np.abs(np.linalg.norm(quaternions, axis=2) - 1) < 1e-3).all():
            raise InputError("expected quaternions of length 1, found others")
        return PoseRange(quaternions, joints, validated_deg)
