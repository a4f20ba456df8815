"""How smooth in time a motion of a garment is that static drapes have taught (Jin et al., Fig. 10).

Drapes know no time: each frame is the drape of its pose. A body goes from one pose for tests to the next in a second,
starting and ending at rest; what the garment's vertices do between three frames, |x - 2 x' + x''|, is held against the
garment of the first frame, carried along by the body alone (`to_carried`). At twice the rate that of a smooth motion
falls to a quarter and that of flicker not at all (`halved`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from capture4d.body.skinning import pose_frame, with_shape
from capture4d.types import PoseSequence
from wrinkles.offset_images.drape_model import DrapeOffsets
from wrinkles.offset_images.frames import CM, pose_rows
from wrinkles.offset_images.layout import decode, worn_part

__all__ = ["ClipSmoothness", "clip_smoothness", "path_between", "second_differences_mm"]

RATE = 60


@dataclass(frozen=True, slots=True)
class ClipSmoothness:
    """Of a garment on paths between poses."""

    second_differences_mm: float
    """At 60 frames a second, the mean over vertices and frames."""
    to_carried: float
    halved: float


def clip_smoothness(model: DrapeOffsets, poses: PoseSequence) -> ClipSmoothness:
    """A model on the paths from each pose to the next.

    Args:
        poses: at least two of the model's person.
    """
    made, carried, fine = [], [], []
    for row in range(len(poses.frame_ids) - 1):
        ends = poses.rotations[row : row + 2]
        twice = model.vertices(path_between(poses, ends, 2 * RATE + 1))
        fine.append(second_differences_mm(twice))
        made.append(second_differences_mm(twice[::2]))
        carried.append(second_differences_mm(_carried(model, path_between(poses, ends, RATE + 1))))
    mean = float(np.mean(made))
    return ClipSmoothness(mean, mean / float(np.mean(carried)), float(np.mean(fine)) / mean)


def path_between(poses: PoseSequence, ends: Float[np.ndarray, "2 joints 3 3"], count: int) -> PoseSequence:
    """So many poses from one to another, at rest at both ends, each joint by the shortest turn.

    Args:
        poses: whose skeleton and shape they have.
    """
    shares = (1 - np.cos(np.pi * np.linspace(0, 1, count))) / 2
    turned = [Slerp([0, 1], Rotation.from_matrix(ends[:, joint]))(shares).as_matrix() for joint in range(ends.shape[1])]
    return PoseSequence(
        np.stack(turned, axis=1).astype(np.float32), np.zeros((count, 3), np.float32), poses.shape,
        np.arange(1, count + 1, dtype=np.int32), float(count - 1), poses.joint_names,
    )  # fmt: skip


def second_differences_mm(vertices: Sequence[np.ndarray] | Float[np.ndarray, "frames V 3"]) -> float:
    """The mean length over vertices and inner frames."""
    placed = np.asarray(vertices)
    return float(1e3 * np.linalg.norm(placed[2:] - 2 * placed[1:-1] + placed[:-2], axis=2).mean())


def _carried(model: DrapeOffsets, poses: PoseSequence) -> Float[np.ndarray, "frames V 3"]:
    """The garment of the first pose on the body of all: its offsets stay, along the body's axes."""
    near, skin = worn_part(model.layout, model.parts.body)
    person = with_shape(skin, model.parts.shape)
    joints = [poses.joint_names.index(name) for name in model.parts.joint_names]
    own = model.offsets(pose_rows(poses.rotations[:1], joints))[0].double().numpy() / CM
    found = []
    for row in range(len(poses.frame_ids)):
        anchors = near.anchors(pose_frame(person, poses, row), model.parts.config.space)
        found.append(model.layout.vertices(decode(anchors, own)))
    return np.stack(found)
