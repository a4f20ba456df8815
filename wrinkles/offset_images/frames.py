"""What networks of offsets learn from: poses, and offsets from the body, frame by frame. Lengths in centimetres.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, section 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from capture4d.body.skinning import pose_frame, with_shape
from capture4d.types import Body, PoseSequence
from wrinkles.offset_images.layout import OffsetLayout, OffsetSpace, encode, worn_part

__all__ = ["CM", "OffsetFrames", "joined_frames", "offset_frames", "pose_joints", "pose_rows", "vertex_errors_cm"]

CM = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class OffsetFrames:
    """Poses and what they shall give, one row a frame."""

    pose: Float[Tensor, "frames pose"]
    offsets: Float[Tensor, "frames P 3"]
    points: Float[Tensor, "frames P 3"]
    axes: Float[Tensor, "frames P 3 3"]
    vertices: Float[Tensor, "frames V 3"]

    def __len__(self) -> int:
        return len(self.pose)

    def rows(self, index: Tensor | Sequence[int]) -> OffsetFrames:
        """Some of the frames."""
        at = torch.as_tensor(index)
        return OffsetFrames(self.pose[at], self.offsets[at], self.points[at], self.axes[at], self.vertices[at])

    def over(self, base: Float[Tensor, "frames P 3"]) -> OffsetFrames:
        """The same cloth as offsets from a first guess of it instead of from the body.

        Args:
            base: the guess, as offsets from the body along the same axes.
        """
        moved = self.points + torch.einsum("fpca,fpa->fpc", self.axes, base)
        return replace(self, offsets=self.offsets - base, points=moved)


def joined_frames(parts: Sequence[OffsetFrames]) -> OffsetFrames:
    """Frames of several takes or sets of one garment, one after the other."""
    names = OffsetFrames.__dataclass_fields__
    return OffsetFrames(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})


def pose_joints(
    poses: PoseSequence, skin_weights: Float[np.ndarray, "V joints"], *, count: int = 10
) -> Int[np.ndarray, " count"]:
    """The joints that move the garment most: by how much they turn, times what of the garment hangs on them.

    The root is left out: offsets turn with the body.
    """
    mean = poses.rotations.mean(axis=0)
    turn = np.linalg.norm(poses.rotations - mean, axis=(2, 3)).mean(axis=0)
    rank = turn * skin_weights.sum(axis=0)
    rank[0] = -1
    return np.sort(np.argsort(-rank, kind="stable")[:count])


def offset_frames(
    layout: OffsetLayout,
    body: Body,
    poses: PoseSequence,
    vertices: Float[np.ndarray, "frames V 3"],
    joints: Int[np.ndarray, " joints"],
    *,
    space: OffsetSpace = "local",
) -> OffsetFrames:
    """Encode frames of cloth, whose poses are those of `poses`, row by row."""
    near, skin = worn_part(layout, body)
    shaped = with_shape(skin, poses.shape)
    offsets, points, axes = [], [], []
    for row, placed in enumerate(vertices):
        anchors = near.anchors(pose_frame(shaped, poses, row), space)
        offsets.append(CM * encode(anchors, placed[layout.vertex].astype(np.float64)))
        points.append(CM * anchors.points)
        axes.append(anchors.axes)

    def stacked(arrays: list[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.stack(arrays).astype(np.float32))

    pose = pose_rows(poses.rotations, joints)
    return OffsetFrames(
        pose, stacked(offsets), stacked(points), stacked(axes), CM * torch.from_numpy(np.array(vertices))
    )


def pose_rows(
    rotations: Float[np.ndarray, "frames all 3 3"], joints: Int[np.ndarray, " joints"] | Sequence[int]
) -> Float[Tensor, "frames pose"]:
    """What a network sees of poses: the rotation matrices of some joints, flattened."""
    seen = np.ascontiguousarray(rotations[:, joints]).astype(np.float32, copy=False)
    return torch.from_numpy(seen.reshape(len(rotations), -1))


def vertex_errors_cm(made: Float[Tensor, "frames V 3"], truth: Float[Tensor, "frames V 3"]) -> float:
    """Mean distance of a vertex from where it should be."""
    return float((made - truth).norm(dim=-1).mean())
