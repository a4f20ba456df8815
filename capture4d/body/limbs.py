"""The limbs of a body, and the one that carries each vertex of a garment.

A surface point that is nearest to a piece of cloth may belong to somebody else: to the arm, where the side of a shirt
hangs beside it. A vertex is carried by the skin that lies under it in the rest pose and moves as it does (by its skin
weights). From there the nearest point of a posed body is found by walking over the surface, downhill in distance, so
that it stays on the limb. Other limbs are met along the ray from that point to the vertex.

Limbs are told by the skeleton: joints in the body's median plane, x = 0 in the rest pose, are the trunk; what hangs
from them on either side is a limb each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Int64
from scipy.spatial import KDTree

from capture4d.body.limb_rays import LEAVING_M, LimbPieces, PosedPieces
from capture4d.body.limb_walks import Walks, face_rows, walk_again
from capture4d.body.skinning import ShapedBody
from capture4d.geometry.intersection_removal import Contacts
from capture4d.geometry.mesh_kernels import vertex_normals_kernel
from capture4d.heavy_imports import njit
from capture4d.types import Body

__all__ = ["LimbSurfaces", "WornBody", "carrying_skin", "limbs_of_joints"]

MEDIAN_M = 0.02
"""A joint as near to the root's median plane is in it."""
UNLIKE_WEIGHTS_M = 0.3
"""Skin whose weights differ by one counts as so much farther away. 0.1 to 1 m do alike; with 0 cloth at the armpit is
taken to the wrong side."""
CARRIED_SHARE = 0.05
"""A limb carries a vertex that has this share of its skin weights; such a limb is none of the others."""


def limbs_of_joints(body: Body) -> Int32[np.ndarray, " joints"]:
    """The limb each joint belongs to, from 1; 0 is the trunk."""
    aside = np.abs(body.joints[:, 0] - body.joints[0, 0]) > MEDIAN_M
    limbs = np.zeros(len(body.joints), np.int32)
    for joint, parent in enumerate(body.parents):
        if parent < 0:
            continue
        if limbs[parent]:
            limbs[joint] = limbs[parent]
        elif aside[joint]:
            limbs[joint] = limbs.max() + 1
    return limbs


def _shares(weights: np.ndarray, limbs: np.ndarray) -> np.ndarray:
    """Skin weights by limb, (V, limbs)."""
    return np.stack([weights[:, limbs == limb].sum(axis=1) for limb in range(limbs.max(initial=0) + 1)], axis=1)


def carrying_skin(
    person: ShapedBody, garment: Float[np.ndarray, "verts 3"], skin_weights: Float[np.ndarray, "verts joints"]
) -> Int64[np.ndarray, " verts"]:
    """The body vertex that lies under each vertex of a garment in the rest pose and moves as it does.

    Args:
        garment: its vertices in the person's rest pose, metres.
        skin_weights: of the garment, over the body's joints.
    """
    moving = np.flatnonzero(skin_weights.max(axis=0, initial=0.0) > 0)
    used = np.unique(person.body.template.faces)
    skin = UNLIKE_WEIGHTS_M * person.body.skin_weights[used][:, moving]
    cloth = UNLIKE_WEIGHTS_M * skin_weights[:, moving]
    _, nearest = KDTree(np.hstack([person.vertices[used], skin])).query(np.hstack([garment, cloth]))
    return used[nearest].astype(np.int64)


class WornBody:
    """A garment on one person: what all frames share.

    Args:
        garment: its vertices in the person's rest pose, metres.
        skin_weights: of the garment, over the body's joints.
    """

    def __init__(
        self,
        person: ShapedBody,
        garment: Float[np.ndarray, "verts 3"],
        skin_weights: Float32[np.ndarray, "verts joints"],
    ) -> None:
        body, limbs = person.body, limbs_of_joints(person.body)
        faces, corners = body.template.faces, body.template.faces.reshape(-1)
        limb_of_face = np.argmax(_shares(body.skin_weights, limbs)[faces].sum(axis=1), axis=1)
        carried = _shares(skin_weights, limbs) > CARRIED_SHARE
        others = [
            _Limb(LimbPieces.of(person.vertices, own), np.flatnonzero(~carried[:, limb]))
            for limb in range(limbs.max() + 1)
            if len(own := faces[limb_of_face == limb])
        ]
        self._worn = _Worn(
            faces,
            np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=len(person.vertices)))]),
            (np.argsort(corners, kind="stable") // 3).astype(np.int32),
            tuple(limb for limb in others if len(limb.strangers)),
        )
        under = carrying_skin(person, garment, skin_weights)
        self._start = self._worn.fans[self._worn.offsets[under]]

    def posed(self, vertices: Float[np.ndarray, "skin 3"]) -> LimbSurfaces:
        """The body in one pose."""
        return LimbSurfaces(self._worn, vertices, self._start)


@dataclass(frozen=True, slots=True, eq=False)
class _Limb:
    """A limb, for the cloth that others carry."""

    pieces: LimbPieces
    strangers: Int64[np.ndarray, " verts"]
    """Vertices of the garment that it does not carry."""


@dataclass(frozen=True, slots=True, eq=False)
class _Worn:
    """A body's topology, and what of it carries a garment."""

    faces: Int32[np.ndarray, "faces 3"]
    offsets: Int64[np.ndarray, " skin_plus_1"]
    fans: Int32[np.ndarray, " corners"]
    """Faces around body vertex v: fans[offsets[v] : offsets[v + 1]]."""
    limbs: tuple[_Limb, ...]
    """Those that do not carry some of the cloth."""


class LimbSurfaces:
    """A posed body as one garment sees it; of a search it remembers what makes the next one short."""

    def __init__(self, worn: _Worn, vertices: Float[np.ndarray, "skin 3"], start: Int32[np.ndarray, " verts"]) -> None:
        self._worn, self._start, self._at = worn, start, start
        self._vertices = np.ascontiguousarray(vertices, np.float64)
        self._rows = face_rows(self._vertices, vertex_normals_kernel(self._vertices, worn.faces), worn.faces)
        self._walks, self._probes = Walks(len(start), len(worn.faces)), Walks(0, len(worn.faces))
        self._others = [(limb.strangers, PosedPieces(limb.pieces, self._vertices)) for limb in worn.limbs]

    def heights(
        self,
        points: Float[np.ndarray, "points 3"],
        vertices: Int32[np.ndarray, " points"],
        numbers: Int64[np.ndarray, " points"],
    ) -> Float64[np.ndarray, " points"]:
        """Heights over the limb that carries a vertex beside each point, metres, negative inside."""
        needed = int(numbers.max(initial=-1)) + 1
        if needed > len(self._probes.starts):
            self._probes = Walks(1 << needed.bit_length(), len(self._worn.faces))
        return self._over(points, self._at[vertices], numbers, self._probes)[0]

    def contacts(self, points: Float[np.ndarray, "verts 3"]) -> Contacts:
        """Where the garment's vertices are between the limbs.

        Every walk begins at the skin under the garment at rest: from where the last one ended it would creep, search by
        search, over the armpit from one limb to the other.
        """
        points = np.ascontiguousarray(points, np.float64)
        heights, normals, feet, self._at = self._over(points, self._start, np.arange(len(points)), self._walks)
        outwards = _away(points, feet, normals, heights)
        room, overlapping = np.full(len(points), np.inf), np.zeros(len(points), bool)
        for strangers, limb in self._others:
            chosen, hits = limb.cast(feet, points, outwards, strangers)
            if hits is None:
                continue
            facing = np.einsum("px,px->p", hits.normals, outwards[chosen])
            met = np.isfinite(hits.distance)
            overlapping[chosen] |= met & (facing > 0)
            distance = np.where(met & (facing < 0), hits.distance + LEAVING_M, np.inf)
            room[chosen] = np.minimum(room[chosen], distance)
        return Contacts(heights, normals, feet, outwards, room, overlapping)

    def _over(
        self, points: np.ndarray, start: np.ndarray, numbers: np.ndarray, walks: Walks
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Heights, normals, nearest points and their faces, walking from some faces."""
        worn = self._worn
        return walk_again(points, numbers, start, *self._rows, worn.faces, worn.offsets, worn.fans, *walks.arrays)


@njit(cache=True)
def _away(points, feet, normals, heights):
    """From the foot to the point; the normal, of a point inside or as good as on the skin."""
    result = normals.copy()
    for i in range(len(points)):
        if heights[i] > LEAVING_M / 2:
            for k in range(3):
                result[i, k] = (points[i, k] - feet[i, k]) / heights[i]
    return result
