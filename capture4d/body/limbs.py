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
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64
from scipy.spatial import KDTree

from capture4d.body.skinning import ShapedBody
from capture4d.geometry.intersection_removal import Contacts
from capture4d.geometry.mesh import vertex_normals
from capture4d.geometry.ray_casting import TriangleScene
from capture4d.geometry.triangles import closest_in_triangle, row3
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
REACH_M = 0.01
"""Limbs whose boxes are farther away are not looked at."""
LEAVING_M = 0.002
"""Rays start so far over the skin: where two limbs meet, the other one's skin begins beside it."""


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
        self._worn = _Worn(
            faces,
            np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=len(person.vertices)))]),
            (np.argsort(corners, kind="stable") // 3).astype(np.int32),
            _shares(skin_weights, limbs) > CARRIED_SHARE,
            tuple(faces[limb_of_face == limb] for limb in range(limbs.max() + 1)),
        )
        under = carrying_skin(person, garment, skin_weights)
        self._start = self._worn.fans[self._worn.offsets[under]]

    def posed(self, vertices: Float[np.ndarray, "skin 3"]) -> LimbSurfaces:
        """The body in one pose."""
        return LimbSurfaces(self._worn, vertices, self._start)


@dataclass(frozen=True, slots=True, eq=False)
class _Worn:
    """A body's topology, and what of it carries a garment."""

    faces: Int32[np.ndarray, "faces 3"]
    offsets: Int64[np.ndarray, " skin_plus_1"]
    fans: Int32[np.ndarray, " corners"]
    """Faces around body vertex v: fans[offsets[v] : offsets[v + 1]]."""
    carried: Bool[np.ndarray, "verts limbs"]
    """Which limbs carry each vertex of the garment."""
    limbs: tuple[Int32[np.ndarray, "_ 3"], ...]
    """Faces of each."""


class LimbSurfaces:
    """A posed body as one garment sees it; of `contacts` it remembers which faces the vertices are over."""

    def __init__(self, worn: _Worn, vertices: Float[np.ndarray, "skin 3"], start: Int32[np.ndarray, " verts"]) -> None:
        self._worn, self._start, self._at = worn, start, start
        self._vertices = np.ascontiguousarray(vertices, np.float64)
        self._normals = vertex_normals(self._vertices, worn.faces)
        self._others: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []
        self._scenes: dict[int, TriangleScene] = {}
        for limb, faces in enumerate(worn.limbs):
            strangers = np.flatnonzero(~worn.carried[:, limb])
            if len(faces) and len(strangers):
                corners = self._vertices[faces.reshape(-1)]
                box = corners.min(axis=0) - REACH_M, corners.max(axis=0) + REACH_M
                self._others.append((limb, strangers, *box))

    def heights(
        self, points: Float[np.ndarray, "points 3"], vertices: Int32[np.ndarray, " points"]
    ) -> Float64[np.ndarray, " points"]:
        """Heights over the limb that carries a vertex beside each point, metres, negative inside."""
        return self._over(points, self._at[vertices])[0]

    def contacts(self, points: Float[np.ndarray, "verts 3"]) -> Contacts:
        """Where the garment's vertices are between the limbs.

        Every walk begins at the skin under the garment at rest: from where the last one ended it would creep, search by
        search, over the armpit from one limb to the other.
        """
        heights, normals, feet, self._at = self._over(points, self._start)
        far = heights > LEAVING_M / 2
        outwards = np.where(far[:, None], (points - feet) / np.maximum(heights, LEAVING_M / 2)[:, None], normals)
        room, overlapping = np.full(len(points), np.inf), np.zeros(len(points), bool)
        for limb, strangers, low, high in self._others:
            ends = feet[strangers], points[strangers]
            near = (np.maximum(*ends) > low).all(axis=1) & (np.minimum(*ends) < high).all(axis=1)
            chosen = strangers[near]
            if not len(chosen):
                continue
            away = outwards[chosen]
            hits = self._scene(limb).cast(np.hstack([feet[chosen] + LEAVING_M * away, away]))
            facing = np.einsum("px,px->p", hits.normals, away)
            met = np.isfinite(hits.distance)
            overlapping[chosen] |= met & (facing > 0)
            distance = np.where(met & (facing < 0), hits.distance + LEAVING_M, np.inf)
            room[chosen] = np.minimum(room[chosen], distance)
        return Contacts(heights, normals, feet, outwards, room, overlapping)

    def _scene(self, limb: int) -> TriangleScene:
        """A limb that rays are sent against; made when the garment first comes near it."""
        if limb not in self._scenes:
            self._scenes[limb] = TriangleScene((self._vertices, self._worn.limbs[limb]))
        return self._scenes[limb]

    def _over(self, points: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Heights, normals, nearest points and their faces, walking from some faces."""
        worn = self._worn
        points = np.ascontiguousarray(points, np.float64)
        found, weights = _walk(points, start, self._vertices, worn.faces, worn.offsets, worn.fans)
        corners = worn.faces[found]
        feet = np.einsum("pk,pkx->px", weights, self._vertices[corners])
        normals = np.einsum("pk,pkx->px", weights, self._normals[corners])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        apart = points - feet
        heights = np.linalg.norm(apart, axis=1) * np.where(np.einsum("px,px->p", apart, normals) < 0, -1.0, 1.0)
        return heights, normals, feet, found


@njit(cache=True)
def _walk(points, start, vertices, faces, offsets, fans):
    """For each point a face from which no face around is nearer, and barycentrics of the nearest point in it."""
    found = start.copy()
    weights = np.zeros((len(points), 3))
    for i in range(len(points)):
        p = row3(points, i)
        face, best, nearer = start[i], np.inf, True
        while nearer:
            around, nearer = face, False
            for corner in range(3):
                vertex = faces[around, corner]
                for entry in range(offsets[vertex], offsets[vertex + 1]):
                    f = fans[entry]
                    a, b, c = row3(vertices, faces[f, 0]), row3(vertices, faces[f, 1]), row3(vertices, faces[f, 2])
                    here = closest_in_triangle(p, a, b, c)
                    distance = 0.0
                    for k in range(3):
                        distance += (p[k] - here[0] * a[k] - here[1] * b[k] - here[2] * c[k]) ** 2
                    if distance < best - 1e-14:
                        best, face, nearer = distance, f, True
                        weights[i, 0], weights[i, 1], weights[i, 2] = here
        found[i] = face
    return found, weights
