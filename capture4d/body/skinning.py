"""A skinned body in four steps: load -> with_shape -> with_pose -> vertices; and skinning with its inverse.

    body = load_npz or an adapter          # capture4d.types.Body, rest pose, shape space
    shaped = with_shape(body, shape)       # rest vertices and joints of one person
    posed = with_pose(shaped, rotations, translation)
    posed.vertices()

Letters: V vertices, J joints, S shape components, T frames. Joint rotations are about world-aligned axes and relative
to the rest pose, so that identity everywhere is the rest pose (the SMPL convention). Arithmetic keeps the floating
type it is given; transforms are float64.

References: linear blend skinning and its inverse as in DeepWrinkles (ECCV 2018), section 3.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32

from capture4d.errors import InputError
from capture4d.types import Body, PoseSequence

__all__ = [
    "PosedBody",
    "ShapedBody",
    "blend_transforms",
    "pose_frame",
    "skin",
    "sparse_weights",
    "unskin",
    "with_pose",
    "with_shape",
]

SINGULAR_CONDITION = 1e4
"""Blended matrices worse conditioned than this are flagged, not inverted. A half turn blended half and half with the
identity has determinant 0; real poses with twist joints stay below 20."""


@dataclass(frozen=True, slots=True, eq=False)
class ShapedBody:
    """One person in the rest pose."""

    body: Body
    shape: Float[np.ndarray, " shapes"]
    vertices: Float64[np.ndarray, "verts 3"]
    """Rest vertices, metres."""
    joints: Float64[np.ndarray, "joints 3"]
    """Rest joints, metres."""


@dataclass(frozen=True, slots=True, eq=False)
class PosedBody:
    """One person in one pose."""

    shaped: ShapedBody
    rotations: Float[np.ndarray, "joints 3 3"]
    transforms: Float64[np.ndarray, "joints 4 4"]
    """Rest pose to world, per joint."""

    def vertices(self) -> Float64[np.ndarray, "verts 3"]:
        """Skinned body surface, metres, world frame."""
        return skin(self.corrected(), self.shaped.body.skin_weights, self.transforms)

    def corrected(self) -> Float64[np.ndarray, "verts 3"]:
        """The surface in the rest pose with what the pose changes in its form, metres."""
        body, rest = self.shaped.body, self.shaped.vertices
        if body.pose_directions is None:
            return rest
        feature = (np.asarray(self.rotations[1:], np.float64) - np.eye(3)).ravel()
        return rest + np.tensordot(feature, body.pose_directions, axes=1)

    def joint_centres(self) -> Float64[np.ndarray, "joints 3"]:
        """Where the joints are, metres, world frame."""
        return np.einsum("jab,jb->ja", self.transforms[:, :3, :3], self.shaped.joints) + self.transforms[:, :3, 3]


def with_shape(body: Body, shape: Float[np.ndarray, " shapes"]) -> ShapedBody:
    """Rest vertices and joints of a person.

    Args:
        shape: coefficients in standard deviations; shorter than the body's shape space means zeros for the rest.
    Raises:
        InputError: more coefficients than the body has.
    """
    if len(shape) > len(body.shape_directions):
        raise InputError(f"shape: expected at most {len(body.shape_directions)} coefficients, found {len(shape)}")
    count = len(shape)
    coefficients = np.asarray(shape, np.float64)
    vertices = body.template.vertices + np.tensordot(coefficients, body.shape_directions[:count], axes=1)
    joints = body.joints + np.tensordot(coefficients, body.joint_directions[:count], axes=1)
    return ShapedBody(body, np.asarray(shape), vertices.astype(np.float64), joints.astype(np.float64))


def with_pose(
    shaped: ShapedBody, rotations: Float[np.ndarray, "joints 3 3"], translation: Float[np.ndarray, "3"]
) -> PosedBody:
    """Forward kinematics down the joint tree.

    Args:
        rotations: per joint, relative to its parent, about world-aligned axes.
        translation: displacement of the root joint, metres.
    """
    joints, parents = shaped.joints, shaped.body.parents
    world = np.empty((len(joints), 4, 4))
    world[:, 3] = (0, 0, 0, 1)
    world[0, :3, :3], world[0, :3, 3] = rotations[0], joints[0] + translation
    for joint in range(1, len(joints)):
        parent = parents[joint]
        world[joint, :3, :3] = world[parent, :3, :3] @ rotations[joint]
        world[joint, :3, 3] = world[parent, :3, :3] @ (joints[joint] - joints[parent]) + world[parent, :3, 3]
    world[:, :3, 3] -= np.einsum("jab,jb->ja", world[:, :3, :3], joints)
    return PosedBody(shaped, rotations, world)


def pose_frame(shaped: ShapedBody, poses: PoseSequence, index: int) -> PosedBody:
    """The body in frame `index` (a position in the sequence, not a frame number)."""
    return with_pose(shaped, poses.rotations[index], poses.translations[index])


def blend_transforms(
    skin_weights: Float[np.ndarray, "verts joints"], transforms: Float64[np.ndarray, "joints 4 4"]
) -> Float64[np.ndarray, "verts 3 4"]:
    """Weighted mean of the joint transforms, per vertex."""
    return (skin_weights.astype(np.float64) @ transforms[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)


def skin(
    vertices: Float[np.ndarray, "verts 3"],
    skin_weights: Float[np.ndarray, "verts joints"],
    transforms: Float64[np.ndarray, "joints 4 4"],
) -> Float64[np.ndarray, "verts 3"]:
    """Linear blend skinning, rest pose to world: v = (sum_j w_j T_j) v_rest."""
    blended = blend_transforms(skin_weights, transforms)
    return np.einsum("vab,vb->va", blended[:, :, :3], vertices) + blended[:, :, 3]


def unskin(
    vertices: Float[np.ndarray, "verts 3"],
    skin_weights: Float[np.ndarray, "verts joints"],
    transforms: Float64[np.ndarray, "joints 4 4"],
) -> tuple[Float64[np.ndarray, "verts 3"], Bool[np.ndarray, " verts"]]:
    """Inverse skinning, world to rest pose: v_rest = (sum_j w_j T_j)^-1 v.

    Returns:
        Rest positions, and True where the blended matrix is too near singular to invert (condition number above
        `SINGULAR_CONDITION`, as for a half turn blended with the identity). There the position is unposed by the
        transform of the joint with the largest weight instead, and should be given no weight.
    """
    blended = blend_transforms(skin_weights, transforms)
    flagged = _near_singular(blended[:, :, :3])
    if flagged.any():
        dominant = np.argmax(skin_weights[flagged], axis=1)
        blended[flagged] = transforms[dominant, :3]
    rest = np.linalg.solve(blended[:, :, :3], (vertices - blended[:, :, 3])[..., None])[..., 0]
    return rest, flagged


def _near_singular(matrices: Float64[np.ndarray, "verts 3 3"]) -> Bool[np.ndarray, " verts"]:
    """Whether the condition number is above `SINGULAR_CONDITION`. Frobenius norms bound it from above and cost no
    singular values; few matrices are doubtful then."""
    first, second, third = matrices[:, 0], matrices[:, 1], matrices[:, 2]
    adjugate = np.stack([np.cross(second, third), np.cross(third, first), np.cross(first, second)], axis=1)
    determinant = np.abs(np.einsum("va,va->v", first, adjugate[:, 0]))
    norms = np.linalg.norm(matrices, axis=(1, 2)) * np.linalg.norm(adjugate, axis=(1, 2))
    flagged = ~(norms < SINGULAR_CONDITION * determinant)
    flagged[flagged] = np.linalg.cond(matrices[flagged]) > SINGULAR_CONDITION
    return flagged


def sparse_weights(
    weights: Float[np.ndarray, "verts joints"],
) -> tuple[Int32[np.ndarray, "verts influences"], Float64[np.ndarray, "verts influences"]]:
    """Joints of each vertex by falling weight, and these weights; zero where a vertex has fewer than others."""
    most = max(int((weights > 0).sum(axis=1).max(initial=0)), 1)
    order = np.argsort(-weights, axis=1, kind="stable")[:, :most]
    return order.astype(np.int32), np.take_along_axis(weights, order, axis=1).astype(np.float64)
