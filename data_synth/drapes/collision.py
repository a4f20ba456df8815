"""The body as cloth meets it: overlapping parts, and the half plane under each vertex of the part it belongs to.

A sleeve collides with its arm and the front with the trunk, whatever is nearer: where an arm lies against the trunk, or
two thighs touch, cloth between them would otherwise be pulled to both sides (Jin et al., A Pixel-Based Framework for
Data-Driven Clothing, SCA 2020, section 5). Parts overlap, and a vertex meets one, whatever panel is sewn beside it.

The nearest body vertex is found by walking downhill over the part's surface from where the garment was put on, and the
nearest point in the triangles around it. No tree is built, a look-up of 3,000 vertices takes a millisecond.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from capture4d.body.skinning import PosedBody, ShapedBody, skin
from capture4d.geometry.mesh import vertex_adjacency, vertex_normals
from capture4d.geometry.ray_casting import TriangleScene, barycentric
from capture4d.geometry.triangles import closest_in_triangle, row3
from capture4d.heavy_imports import njit
from data_synth.drapes.solver import Planes

__all__ = ["BESIDE_COSINE", "BodyParts", "Surface", "Wearing"]

BESIDE_M, BESIDE_COSINE = 0.01, 0.7
"""Behind its half plane and farther than this from the skin, in a direction so far from the normal's, a vertex is not
inside the body but beyond the border of the part, where the part goes on as something else."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyParts:
    """Parts of one person's skin. U of its vertices are in one or another."""

    vertices: np.ndarray
    """(U, 3) in the rest pose."""
    skin_weights: np.ndarray
    """(U, J)."""
    faces: np.ndarray
    """(F, 3) int32, into the U."""
    inside: np.ndarray
    """(P, U) bool: the vertices of each part."""
    part_faces: np.ndarray
    """(P, F) bool: its faces."""
    neighbours: tuple[np.ndarray, np.ndarray]
    """Vertices around each vertex: where each one's begin, (U + 1,), and all of them."""
    fans: tuple[np.ndarray, np.ndarray]
    """Faces around each vertex, likewise."""

    @staticmethod
    def create(person: ShapedBody, masks: np.ndarray) -> BodyParts:
        """Args: masks: (P, B) bool, which vertices of the body belong to each part."""
        all_faces = person.body.template.faces
        part_faces = np.asarray(masks[:, all_faces].all(axis=2))
        kept = part_faces.any(axis=0)
        used, corners = np.unique(all_faces[kept], return_inverse=True)
        faces = np.ascontiguousarray(corners.reshape(-1, 3), np.int32)
        adjacency = vertex_adjacency(faces, len(used))
        flat = faces.ravel()
        starts = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=len(used)))])
        part_faces = part_faces[:, kept]
        inside = np.zeros((len(masks), len(used)), bool)
        for part, chosen in enumerate(part_faces):
            inside[part, faces[chosen].ravel()] = True
        return BodyParts(
            person.vertices[used],
            np.ascontiguousarray(person.body.skin_weights[used], np.float64),
            faces,
            inside,
            part_faces,
            (adjacency.indptr.astype(np.int64), adjacency.indices.astype(np.int32)),
            (starts, (np.argsort(flat, kind="stable") // 3).astype(np.int32)),
        )

    def posed(self, body: PosedBody) -> Surface:
        vertices = skin(self.vertices, self.skin_weights, body.transforms)
        return Surface(vertices, vertex_normals(vertices, self.faces))


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """The parts in one pose."""

    vertices: np.ndarray
    """(U, 3)."""
    normals: np.ndarray
    """(U, 3)."""


class Wearing:
    """Which part of a body each vertex of a garment collides with, and over which skin it is now.

    Args:
        contacts: the garment's vertices, and the part each collides with, both (C,) int32; a vertex may come twice.
        start: (C,) int32 body vertex under each, to begin the first walk with.
    """

    def __init__(self, parts: BodyParts, contacts: tuple[np.ndarray, np.ndarray], start: np.ndarray) -> None:
        self.parts, self._contacts = parts, contacts
        self._at = start.copy()

    @staticmethod
    def begin(
        parts: BodyParts, contacts: tuple[np.ndarray, np.ndarray], points: np.ndarray, surface: Surface
    ) -> np.ndarray:
        """The body vertex under each contact, (C,) int32, of a garment at some points, (V, 3), by looking at all."""
        start = np.empty(len(contacts[0]), np.int32)
        corners = surface.vertices[parts.faces]
        middles = corners.mean(axis=1)
        for part, inside in enumerate(parts.inside):
            rows = np.flatnonzero(contacts[1] == part)
            if not len(rows):
                continue
            here = points[contacts[0][rows]]
            own, own_faces = np.flatnonzero(inside), np.flatnonzero(parts.part_faces[part])
            # Middles of faces as well: where skin is near skin, the nearest vertex may be of the other side.
            found = KDTree(np.concatenate([surface.vertices[own], middles[own_faces]])).query(here)[1]
            face = own_faces[np.maximum(found - len(own), 0)]
            corner = np.linalg.norm(corners[face] - here[:, None], axis=2).argmin(axis=1)
            start[rows] = np.where(found < len(own), own[np.minimum(found, len(own) - 1)], parts.faces[face, corner])
        return start

    def begin_again(self, points: np.ndarray, surface: Surface) -> None:
        """Look at all of the body: a walk that began far away may have ended in a hollow."""
        self._at = self.begin(self.parts, self._contacts, points, surface)

    def look_up(self, points: np.ndarray, surface: Surface) -> Planes:
        """Half planes of the body under a garment's vertices, (V, 3)."""
        vertices, parts = self._contacts
        feet, normals = np.empty((len(vertices), 3)), np.empty((len(vertices), 3))
        body = self.parts
        _walk(
            points, vertices, parts, self._at, surface.vertices, surface.normals, body.faces, body.inside,
            body.part_faces, *body.neighbours, *body.fans, feet, normals,
        )  # fmt: skip
        return Planes(vertices, feet, normals)

    def look_up_exactly(self, points: np.ndarray, surface: Surface) -> Planes:
        """The same from the nearest point of all of each part: where skin is near skin, a walk may end on the other."""
        vertices, parts = self._contacts
        feet, normals = np.empty((len(vertices), 3)), np.empty((len(vertices), 3))
        for part, own in enumerate(self.parts.part_faces):
            rows = np.flatnonzero(parts == part)
            if not len(rows):
                continue
            faces = self.parts.faces[own]
            near = TriangleScene((surface.vertices, faces)).nearest(points[vertices[rows]])
            feet[rows] = near.points
            normals[rows] = np.einsum("nk,nkx->nx", barycentric(near.uv), surface.normals[faces[near.faces]])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
        offsets = points[vertices] - feet
        heights, apart = np.einsum("cx,cx->c", offsets, normals), np.linalg.norm(offsets, axis=1)
        beside = (apart > BESIDE_M) & (heights < 0) & (heights > -BESIDE_COSINE * apart)
        feet[beside] = (points[vertices] - normals)[beside]
        return Planes(vertices, feet, normals)


@njit(cache=True, inline="always")
def _squared_distance(points, p, others, q):
    dx, dy, dz = points[p, 0] - others[q, 0], points[p, 1] - others[q, 1], points[p, 2] - others[q, 2]
    return dx * dx + dy * dy + dz * dz


@njit(cache=True)
def _walk(
    points, vertices, parts, at, skin_points, skin_normals, faces, inside, part_faces, neighbour_starts, neighbours,
    fan_starts, fans, feet, normals,
):  # fmt: skip
    """Fill feet and normals, (C, 3); `at` is where the walks begin and then where they ended."""
    for c in range(len(vertices)):
        i, part, here = vertices[c], parts[c], at[c]
        nearest = _squared_distance(points, i, skin_points, here)
        walking = True
        while walking:
            walking = False
            around = here
            for entry in range(neighbour_starts[around], neighbour_starts[around + 1]):
                other = neighbours[entry]
                if inside[part, other]:
                    distance = _squared_distance(points, i, skin_points, other)
                    if distance < nearest:
                        nearest, here, walking = distance, other, True
        at[c] = here
        for k in range(3):
            feet[c, k], normals[c, k] = skin_points[here, k], skin_normals[here, k]
        p, best = row3(points, i), nearest
        for entry in range(fan_starts[here], fan_starts[here + 1]):
            f = fans[entry]
            if not part_faces[part, f]:
                continue
            a, b, d = faces[f, 0], faces[f, 1], faces[f, 2]
            wa, wb, wd = closest_in_triangle(p, row3(skin_points, a), row3(skin_points, b), row3(skin_points, d))
            x = wa * skin_points[a, 0] + wb * skin_points[b, 0] + wd * skin_points[d, 0]
            y = wa * skin_points[a, 1] + wb * skin_points[b, 1] + wd * skin_points[d, 1]
            z = wa * skin_points[a, 2] + wb * skin_points[b, 2] + wd * skin_points[d, 2]
            distance = (p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - z) ** 2
            if distance <= best:
                best = distance
                feet[c, 0], feet[c, 1], feet[c, 2] = x, y, z
                for k in range(3):
                    normals[c, k] = wa * skin_normals[a, k] + wb * skin_normals[b, k] + wd * skin_normals[d, k]
        size = np.sqrt(normals[c, 0] ** 2 + normals[c, 1] ** 2 + normals[c, 2] ** 2) + 1e-12
        height, apart = 0.0, 0.0
        for k in range(3):
            normals[c, k] /= size
            height += (points[i, k] - feet[c, k]) * normals[c, k]
            apart += (points[i, k] - feet[c, k]) ** 2
        if height < 0 and apart > BESIDE_M**2 and height > -BESIDE_COSINE * np.sqrt(apart):
            for k in range(3):  # beside the part's border, not inside the body
                feet[c, k] = points[i, k] - normals[c, k]
