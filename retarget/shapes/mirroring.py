"""Takes seen in a mirror: twice the motions to learn from, for a garment and a body that are alike on both sides.

A frame's mirror image has the left joints' rotations on the right, reflected in x = 0, about which the rest pose is
symmetric. At a vertex it has what lies at the mirror image of that vertex, which is a point on a face: templates need
not be symmetric vertex by vertex.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Int64
from scipy import sparse

from capture4d.errors import InputError
from capture4d.geometry.ray_casting import closest_points
from capture4d.types import Mesh, PoseSequence

__all__ = ["Mirror", "find_mirror", "opposite_joints"]

ACROSS = np.array([-1.0, 1.0, 1.0])
"""Reflection in x = 0."""
ASYMMETRY_M = 0.015
"""Median distance from a vertex's mirror image to the garment above which its sides are not alike."""
_SIDES = (("left", "right"), ("Left", "Right"), (".L", ".R"), ("_L", "_R"), (".l", ".r"), ("_l", "_r"))


def opposite_joints(names: Sequence[str]) -> Int64[np.ndarray, " joints"]:
    """Where the joint of the other side stands; joints in the middle are their own.

    Raises:
        InputError: a joint of one side has no partner.
    """
    at = {name: place for place, name in enumerate(names)}
    opposite = np.arange(len(names))
    for place, name in enumerate(names):
        for pair in _SIDES:
            own, other = pair if pair[0] in name else pair[::-1]
            if own not in name or (own[0] in "._" and not name.endswith(own)):
                continue
            partner = name.replace(own, other) if own[0] not in "._" else name.removesuffix(own) + other
            if partner not in at:
                raise InputError(f"mirror: expected a joint '{partner}' beside '{name}', found none")
            opposite[place] = at[partner]
            break
    return opposite


@dataclass(frozen=True, slots=True, eq=False)
class Mirror:
    """Left and right of one garment on one skeleton."""

    joints: Int64[np.ndarray, " joints"]
    """Where each joint's partner stands."""
    weights: sparse.csr_array
    """(V, V): what lies at each vertex's mirror image, as a mean of vertices."""

    @staticmethod
    def create(rest: Mesh, joint_names: Sequence[str]) -> Mirror:
        """
        Args:
            rest: the garment in the rest pose, for instance its mean.
        Raises:
            InputError: the skeleton or the garment is not alike on both sides.
        """
        joints = opposite_joints(joint_names)
        if (joints == np.arange(len(joints))).all():
            raise InputError("mirror: expected joints with a side in their names, found none")
        places, faces, barycentric = closest_points(rest, rest.vertices * ACROSS)
        off = float(np.median(np.linalg.norm(places - rest.vertices * ACROSS, axis=1)))
        if off > ASYMMETRY_M:
            raise InputError(
                f"mirror: expected a garment that is alike on both sides, found {1e3 * off:.0f} mm between them in the "
                f"median (at most {1e3 * ASYMMETRY_M:g})"
            )
        count = len(rest.vertices)
        rows = np.repeat(np.arange(count), 3)
        weights = sparse.csr_array((barycentric.reshape(-1), (rows, rest.faces[faces].reshape(-1))), (count, count))
        return Mirror(joints, weights)

    def poses(self, poses: PoseSequence) -> PoseSequence:
        """A motion seen in the mirror."""
        rotations = ACROSS[:, None] * poses.rotations[:, self.joints] * ACROSS
        return replace(
            poses,
            rotations=rotations.astype(np.float32),
            translations=(poses.translations * ACROSS).astype(np.float32),
        )

    def frames(
        self, vertices: Float[np.ndarray, "frames verts 3"], weights: Float[np.ndarray, "frames verts"]
    ) -> tuple[Float32[np.ndarray, "frames verts 3"], Float32[np.ndarray, "frames verts"]]:
        """Unposed frames and the weights of their vertices, seen in the mirror."""
        count, verts = weights.shape
        seen = self.weights @ np.asarray(vertices, np.float64).transpose(1, 0, 2).reshape(verts, -1)
        seen = seen.reshape(verts, count, 3).transpose(1, 0, 2) * ACROSS
        return seen.astype(np.float32), (self.weights @ np.asarray(weights, np.float64).T).T.astype(np.float32)


def find_mirror(rest: Mesh, joint_names: Sequence[str], wish: Literal["auto", "on", "off"]) -> Mirror | None:
    """The mirror of a garment, if it is wished for, or, with `auto`, if there is one.

    Raises:
        InputError: it is wished for, and the garment or the skeleton is not alike on both sides.
    """
    if wish == "off":
        return None
    try:
        return Mirror.create(rest, joint_names)
    except InputError:
        if wish == "on":
            raise
        return None
