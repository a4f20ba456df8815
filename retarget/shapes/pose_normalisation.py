"""Inverse skinning of registered frames, and what each of their vertices is worth.

A vertex counts fully where the scan had data, a little where registration guessed it, and not at all where its blended
matrix cannot be inverted.

References: DeepWrinkles (ECCV 2018), section 3.2: R_bar = S^-1(R, theta).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32

from capture4d.body.binding import embedded_offset
from capture4d.body.skinning import ShapedBody, pose_frame, unskin, with_shape
from capture4d.errors import InputError
from capture4d.types import Garment, PoseSequence, RegisteredSequence

__all__ = ["PoseRows", "unpose_frame", "unpose_sequence"]


@dataclass(frozen=True, slots=True, eq=False)
class PoseRows:
    """The poses of a registered sequence, in its order."""

    shaped: ShapedBody
    poses: PoseSequence

    @staticmethod
    def match(registered: RegisteredSequence, shaped: ShapedBody, poses: PoseSequence) -> PoseRows:
        """
        Raises:
            InputError: the garment is not bound to this skeleton, or a frame has no pose.
        """
        return PoseRows.of_frames(registered.frame_ids, registered.garment, shaped, poses)

    @staticmethod
    def of_frames(
        frame_ids: Int32[np.ndarray, " frames"], garment: Garment, shaped: ShapedBody, poses: PoseSequence
    ) -> PoseRows:
        """`match` for somebody who has no frames at hand."""
        weights = garment.skin_weights
        if weights is None:
            raise InputError("registration: expected a template with skin weights, found none; bind it to a body")
        joints = len(shaped.body.joint_names)
        if poses.joint_names != shaped.body.joint_names or weights.shape[1] != joints:
            raise InputError(
                f"poses: expected the body's {joints} joints, found {len(poses.joint_names)} in the poses and "
                f"{weights.shape[1]} in the template's skin weights"
            )
        return PoseRows(shaped, poses.of_frames(frame_ids))

    def transforms(self, row: int) -> Float64[np.ndarray, "joints 4 4"]:
        """Rest pose to world of a frame, per joint."""
        return pose_frame(self.shaped, self.poses, row).transforms


def unpose_frame(
    vertices: Float[np.ndarray, "verts 3"],
    seen: Bool[np.ndarray, " verts"],
    skin_weights: Float[np.ndarray, "verts joints"],
    transforms: Float64[np.ndarray, "joints 4 4"],
    *,
    unseen_weight: float,
) -> tuple[Float32[np.ndarray, "verts 3"], Float32[np.ndarray, " verts"]]:
    """A frame in the rest pose, metres, and the weight of each vertex.

    Args:
        seen: where the scan had data.
        unseen_weight: of the other vertices; those that cannot be unposed get 0.
    """
    rest, singular = unskin(vertices.astype(np.float64), skin_weights, transforms)
    weights = np.where(seen, 1.0, unseen_weight) * ~singular
    return rest.astype(np.float32), weights.astype(np.float32)


def unpose_sequence(
    registered: RegisteredSequence, rows: PoseRows, person: Float[np.ndarray, " shapes"], *, unseen_weight: float
) -> Iterator[tuple[Float32[np.ndarray, "verts 3"], Float32[np.ndarray, " verts"]]]:
    """The frames of a take in the rest pose, with weights, on the person whom all takes share.

    Args:
        person: shape coefficients. Takes are tracked one by one, and their shapes differ a little.
    """
    garment = registered.garment
    assert garment.skin_weights is not None
    offset = np.zeros(3)
    if garment.embedding_faces is not None:
        body = rows.shaped.body
        offset = embedded_offset(garment, body, with_shape(body, person).vertices - rows.shaped.vertices)
    for row in range(len(registered.frame_ids)):
        rest, weights = unpose_frame(
            np.asarray(registered.vertices[row]),
            np.isfinite(registered.residual_m[row]),
            garment.skin_weights,
            rows.transforms(row),
            unseen_weight=unseen_weight,
        )
        yield (rest + offset).astype(np.float32), weights
