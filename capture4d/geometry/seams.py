"""Seams: vertices that a file splits for texture coordinates, normals or materials, joined for topology.

Many formats keep one texture coordinate or normal per vertex (glb always, ply as Blender writes it; stl shares no
vertex at all), so a surface lies in the file as pieces whose edges coincide. Pieces are sewn edge by edge: two open
edges in one place whose faces lie on both sides of it, wound alike, and no third one. That is all that is joined.
Borders that touch in a point, a lining that lies on its cloth, and edges where three sheets meet stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int32, Int64, Integer
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import KDTree

from capture4d.geometry.mesh import edge_uses, half_edges
from capture4d.geometry.mesh_kernels import open_vertices
from capture4d.types import Mesh

__all__ = ["Welded", "weld", "welded_mesh"]

ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Largest distance of the two copies of a vertex, over the largest coordinate. Most writers copy them bit for bit;
where each piece was moved by a matrix of its own (a glb's nodes, quantised integers), three products and three sums may
round differently. Half a micrometre on a person: no two layers of cloth are so near along a whole edge."""


@dataclass(frozen=True, slots=True, eq=False)
class Welded:
    """A mesh without its seams: fewer vertices, the same faces in the same order."""

    faces: Int32[np.ndarray, "F 3"]
    """Of the welded vertices."""
    first: Int32[np.ndarray, " W"]
    """The vertex that each welded one stands for: the first of those in its place. They keep their turn."""
    of_vertex: Int32[np.ndarray, " V"]
    """The welded vertex that each vertex became."""
    against: int
    """Pairs of open edges that coincide but whose faces are wound against each other; they are left open."""

    @property
    def is_split(self) -> bool:
        """Anything was joined."""
        return len(self.first) < len(self.of_vertex)


def weld(vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"]) -> Welded:
    """Join the vertices along seams; what is no seam, and all vertices off the seams, stay as they are."""
    label, against = np.arange(len(vertices)), 0
    is_open, used = open_vertices(np.ascontiguousarray(faces, np.int32), len(vertices))
    scale = float(np.abs(vertices[used]).max(initial=0.0))
    sides = _open_sides(faces, is_open)
    for tolerance in (0.0, ROUNDING * scale):
        pairs, against = _seam_pairs(vertices, *sides, tolerance)
        if len(pairs):
            label = _joined(label, pairs, faces)
            joined = label[faces]
            sides = _open_sides(joined, open_vertices(np.ascontiguousarray(joined, np.int32), len(vertices))[0])
    if not (label != np.arange(len(label))).any():
        every = np.arange(len(label), dtype=np.int32)
        return Welded(faces.astype(np.int32, copy=False), every, every, against)
    standing, first, of_vertex = np.unique(label, return_index=True, return_inverse=True)
    order = np.argsort(first)
    turn = np.empty(len(standing), np.int32)
    turn[order] = np.arange(len(standing), dtype=np.int32)
    of_vertex = turn[of_vertex.reshape(-1)]
    return Welded(of_vertex[faces].reshape(-1, 3), first[order].astype(np.int32), of_vertex, against)


def welded_mesh(mesh: Mesh) -> tuple[Mesh, Welded]:
    """The mesh with its vertices joined along seams; its UVs, which belong to face corners, stay."""
    welded = weld(mesh.vertices, mesh.faces)
    if not welded.is_split:
        return mesh, welded
    return Mesh(mesh.vertices[welded.first], welded.faces, mesh.uv), welded


def _open_sides(faces: np.ndarray, is_open: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directed edges that belong to one face only, (E, 2), and the third corner of that face.

    Args:
        is_open: vertices on open edges.
    """
    first, second, third = (is_open[faces[:, corner]] for corner in range(3))
    near = faces[(first & second) | (second & third) | (third & first)]
    sides = half_edges(near).astype(np.int64)
    third = near[:, [2, 0, 1]].reshape(-1)
    keys = (sides.min(axis=1) << 32) | sides.max(axis=1)
    _, first, uses = np.unique(keys, return_index=True, return_counts=True)
    alone = first[uses == 1]
    return sides[alone], third[alone]


def _seam_pairs(
    vertices: np.ndarray, sides: np.ndarray, third: np.ndarray, tolerance: float
) -> tuple[Int64[np.ndarray, "pairs 2"], int]:
    """Vertices to be joined; and how many pairs of edges only their winding keeps apart.

    Args:
        sides, third: as `_open_sides` has them.
    """
    nothing = np.zeros((0, 2), np.int64)
    ends, corner = np.unique(sides, return_inverse=True)
    place = _places(vertices[ends], tolerance)
    if not len(ends) or place.max() + 1 == len(ends):
        return nothing, 0
    at = place[corner.reshape(-1, 2)]
    kept = at[:, 0] != at[:, 1]
    sides, third, at = sides[kept], third[kept], at[kept]
    keys = (at.min(axis=1).astype(np.int64) << 32) | at.max(axis=1)
    order = np.argsort(keys, kind="stable")
    _, start, uses = np.unique(keys[order], return_index=True, return_counts=True)
    pairs = start[uses == 2]  # of three or more nobody knows which belong together
    one, other = order[pairs], order[pairs + 1]
    apart = np.abs(vertices[third[one]].astype(np.float64) - vertices[third[other]]).max(axis=1) > tolerance
    one, other = one[apart], other[apart]  # the others are one triangle seen from both sides, or twice the same
    alike = at[one, 0] == at[other, 1]
    sewn = np.concatenate(
        [
            np.column_stack([sides[one[alike], 0], sides[other[alike], 1]]),
            np.column_stack([sides[one[alike], 1], sides[other[alike], 0]]),
        ]
    )
    return sewn[sewn[:, 0] != sewn[:, 1]], int(np.count_nonzero(~alike))


def _places(points: np.ndarray, tolerance: float) -> Int64[np.ndarray, " points"]:
    """A number for each place, the same for points in one place."""
    if tolerance == 0.0:
        order = np.lexsort(points.T)
        new = (np.diff(points[order], axis=0) != 0).any(axis=1)
        place = np.empty(len(points), np.int64)
        place[order] = np.concatenate([np.zeros(min(1, len(points)), np.int64), np.cumsum(new)])
        return place
    links = KDTree(points.astype(np.float64)).query_pairs(tolerance, output_type="ndarray")
    return _parts(len(points), links)


def _parts(count: int, links: np.ndarray) -> Int64[np.ndarray, " count"]:
    graph = sparse.coo_array((np.ones(len(links), bool), (links[:, 0], links[:, 1])), shape=(count, count))
    return csgraph.connected_components(graph, directed=False)[1].astype(np.int64)


def _joined(label: np.ndarray, pairs: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Labels after joining; where that would make an edge of three faces, or a face with one corner twice, not."""
    refused, concerned = np.zeros((2, len(label)), bool)
    concerned[pairs] = True
    touched = concerned[label]
    # no edge of another face changes, and around what is joined all faces are here
    faces = faces[touched[faces[:, 0]] | touched[faces[:, 1]] | touched[faces[:, 2]]]
    before, uses = edge_uses(label[faces])
    crowded = before[(uses > 2) | (before[:, 0] == before[:, 1])]
    while True:
        allowed = pairs[~refused[pairs].any(axis=1)]
        part = _parts(len(label), allowed)
        lowest = np.full(len(label), len(label))
        np.minimum.at(lowest, part, np.arange(len(label)))
        joined = lowest[part][label]
        edges, uses = edge_uses(joined[faces])
        new = ~_among(edges, np.sort(joined[crowded], axis=1))
        wrong = np.zeros(len(label), bool)
        wrong[edges[new & ((uses > 2) | (edges[:, 0] == edges[:, 1]))].reshape(-1)] = True
        guilty = wrong[lowest[part]] & np.isin(np.arange(len(label)), pairs) & ~refused
        if not (guilty & np.isin(np.arange(len(label)), allowed)).any():
            return joined
        refused |= guilty


def _among(edges: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Which edges are also among the others; both with the smaller vertex first."""
    keys, known = ((ends[:, 0].astype(np.int64) << 32) | ends[:, 1] for ends in (edges, others))
    return np.isin(keys, known)
