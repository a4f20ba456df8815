"""A garment pushed out of a moving body as fast as a picture is drawn: the skin that it may ever meet is chosen once.

    near = BodyCandidates(person, at_rest, faces, skin_weights)
    for posed in motion:
        vertices = near.pushed_out(near.skinned(unposed, posed), posed)

Of the body, only the skin within `REACH_M` of the garment at rest is posed. Every vertex of the garment leaves the limb
that carries it, as in `capture4d.body.limbs`: from the skin under it at rest the nearest candidate is found by walking
over the candidates' edges, downhill in distance, and the nearest point in the triangles around it. Positions are then
projected as in `capture4d.geometry.intersection_removal`, a few sweeps for each of a few searches.

What this leaves out, and `IntersectionRemoval` does: limbs that do not carry a vertex, faces that the body pokes
through between their corners, a search that starts anew until everything has settled, and a report. It is for live
views.

Letters: V vertices of the garment, C candidates, J joints.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, Int32
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from capture4d.body.limbs import carrying_skin
from capture4d.body.skinning import PosedBody, ShapedBody, sparse_weights
from capture4d.body.surface_kernels import skin_sparse
from capture4d.geometry.intersection_removal import SHORTEST, project, sweep_order
from capture4d.geometry.mesh import edge_lengths, unique_edges, vertex_adjacency
from capture4d.geometry.mesh_kernels import vertex_normals_kernel
from capture4d.geometry.triangles import closest_in_triangle, row3
from capture4d.heavy_imports import njit

__all__ = ["BodyCandidates"]

REACH_M = 0.12
"""Skin farther than this from the garment at rest is no candidate: cloth slides over the skin by less."""
FAR_M = 0.03
"""Cloth that is farther out than this over its nearest candidate is not looked at more closely."""
LESS = 0.5
"""Of the way to its neighbours' mean displacement, per search: as the exact removal begins, and falling likewise."""


class BodyCandidates:
    """One garment on one person, with everything found once that frames share.

    Args:
        person: whose body it is.
        at_rest: the garment's vertices in the person's rest pose, metres.
        skin_weights: of the garment, over the body's joints.
        longest: the longest that an edge may be, times its length at rest.
        margin_m: how far over the skin vertices are put.
    """

    def __init__(
        self,
        person: ShapedBody,
        at_rest: Float[np.ndarray, "verts 3"],
        faces: Int32[np.ndarray, "faces 3"],
        skin_weights: Float[np.ndarray, "verts joints"],
        *,
        longest: float = np.inf,
        margin_m: float = 0.002,
    ) -> None:
        body = person.body
        points = np.ascontiguousarray(at_rest, np.float64)
        under = carrying_skin(person, points, skin_weights)
        chosen = _within_reach(person, points, under)
        numbers = np.full(len(person.vertices), -1, np.int32)
        numbers[chosen] = np.arange(len(chosen), dtype=np.int32)
        kept = (numbers[body.template.faces] >= 0).all(axis=1)
        self._faces = numbers[body.template.faces[kept]]
        self._chosen, self._start = chosen, numbers[under]
        self._rest = np.ascontiguousarray(person.vertices[chosen], np.float64)
        self._corrections = None if body.pose_directions is None else body.pose_directions[:, chosen]
        self._body_skin = sparse_weights(body.skin_weights[chosen])
        self._cloth_skin = sparse_weights(skin_weights)
        self._around = _rows(vertex_adjacency(self._faces, len(chosen)))
        self._fans = _fans(self._faces, len(chosen))
        self._edges = unique_edges(faces)
        lengths = np.maximum(edge_lengths(points, self._edges), 1e-9)
        self._longest, self._shortest = longest * lengths, SHORTEST * lengths
        rows = _rows(vertex_adjacency(faces, len(points)))
        self._cloth_around = *rows, sweep_order(*rows)
        self._margin = margin_m

    @property
    def count(self) -> int:
        """Number of candidates."""
        return len(self._chosen)

    def skinned(self, unposed: Float[np.ndarray, "verts 3"], posed: PosedBody) -> Float64[np.ndarray, "verts 3"]:
        """The garment moved by its skin weights, metres: `skinning.skin`, of the few joints that each vertex has."""
        return skin_sparse(np.ascontiguousarray(unposed, np.float64), *self._cloth_skin, _contiguous(posed))

    def pushed_out(
        self, points: Float[np.ndarray, "verts 3"], posed: PosedBody, *, searches: int = 3, sweeps: int = 4
    ) -> Float64[np.ndarray, "verts 3"]:
        """The garment moved out of the limbs that carry it.

        Args:
            points: the garment on the posed body, metres; left as they are.
            posed: the person in that pose.
            searches: for where the skin is.
            sweeps: over all edges and vertices after each search.
        """
        rest = self._rest
        if self._corrections is not None:
            feature = (np.asarray(posed.rotations[1:], np.float64) - np.eye(3)).ravel()
            rest = rest + np.tensordot(feature, self._corrections, axes=1)
        skin = skin_sparse(rest, *self._body_skin, _contiguous(posed))
        normals = vertex_normals_kernel(skin, self._faces)
        start = np.ascontiguousarray(points, np.float64)
        result, at = start.copy(), self._start.copy()
        shortest = np.minimum(self._shortest, edge_lengths(start, self._edges))
        feet, outwards, low = np.zeros_like(start), np.zeros_like(start), np.full(len(start), -np.inf)
        high, due, travelled = np.full(len(start), np.inf), np.full(len(shortest), -1.0), np.zeros(len(start))
        for search in range(searches):
            inside = _look_up(
                result, at, skin, normals, self._faces, *self._around, *self._fans, self._margin, feet, outwards, low
            )
            if not inside:
                break
            spread = LESS * (1 - (search + 1) / searches)
            project(
                result, start, self._edges, self._longest, shortest, due, travelled, *self._cloth_around,
                feet, outwards, outwards, low, high, spread, sweeps,
            )  # fmt: skip
        return result


def _contiguous(posed: PosedBody) -> np.ndarray:
    return np.ascontiguousarray(posed.transforms, np.float64)


def _within_reach(person: ShapedBody, points: np.ndarray, under: np.ndarray) -> np.ndarray:
    """Vertices of the body, ascending, that the garment may meet: the skin under it and what is near, (C,)."""
    distance, _ = KDTree(points).query(person.vertices, distance_upper_bound=REACH_M)
    used = np.zeros(len(person.vertices), bool)
    used[person.body.template.faces] = True
    near = np.isfinite(distance) & used
    near[under] = True
    return np.flatnonzero(near)


def _rows(adjacency: csr_array) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours of vertex v: around[offsets[v] : offsets[v + 1]]."""
    return adjacency.indptr.astype(np.int64), adjacency.indices.astype(np.int32)


def _fans(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Faces around vertex v: fans[offsets[v] : offsets[v + 1]]."""
    corners = faces.reshape(-1)
    offsets = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=count))]).astype(np.int64)
    return offsets, (np.argsort(corners, kind="stable") // 3).astype(np.int32)


@njit(cache=True)
def _look_up(points, at, skin, normals, faces, offsets, around, fan_offsets, fans, margin, feet, outwards, low):
    """Fill `feet`, `outwards` and `low`, the least height of each vertex, and say how many are inside the body.

    Args:
        at: (V,) candidate where the walk begins; where it ended afterwards.
    """
    inside = 0
    for i in range(len(points)):
        p = row3(points, i)
        v = at[i]
        best = (p[0] - skin[v, 0]) ** 2 + (p[1] - skin[v, 1]) ** 2 + (p[2] - skin[v, 2]) ** 2
        nearer = True
        while nearer:
            nearer, here = False, v
            for entry in range(offsets[here], offsets[here + 1]):
                u = around[entry]
                distance = (p[0] - skin[u, 0]) ** 2 + (p[1] - skin[u, 1]) ** 2 + (p[2] - skin[u, 2]) ** 2
                if distance < best:
                    best, v, nearer = distance, u, True
        at[i] = v
        over = 0.0
        for k in range(3):
            over += (p[k] - skin[v, k]) * normals[v, k]
        if over > FAR_M:
            low[i] = -np.inf
            continue
        nearest = np.inf
        f, wa, wb, wc = -1, 0.0, 0.0, 0.0
        for entry in range(fan_offsets[v], fan_offsets[v + 1]):
            face = fans[entry]
            a, b, c = row3(skin, faces[face, 0]), row3(skin, faces[face, 1]), row3(skin, faces[face, 2])
            share = closest_in_triangle(p, a, b, c)
            distance = 0.0
            for k in range(3):
                distance += (p[k] - share[0] * a[k] - share[1] * b[k] - share[2] * c[k]) ** 2
            if distance < nearest:
                nearest, f = distance, face
                wa, wb, wc = share
        if f < 0:
            low[i] = -np.inf
            continue
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        length, height = 0.0, 0.0
        for k in range(3):
            feet[i, k] = wa * skin[a, k] + wb * skin[b, k] + wc * skin[c, k]
            outwards[i, k] = wa * normals[a, k] + wb * normals[b, k] + wc * normals[c, k]
            length += outwards[i, k] ** 2
        length = max(np.sqrt(length), 1e-30)
        for k in range(3):
            outwards[i, k] /= length
            height += (p[k] - feet[i, k]) * outwards[i, k]
        if height < 0.0:
            inside += 1
            low[i] = margin
        else:
            low[i] = min(height, margin)
    return inside
