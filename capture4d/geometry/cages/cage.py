"""A cage: curves along the edges of a mesh that part it into patches; its open borders belong to it.

Curves are where face labels meet, seams of a pattern, or lists of vertices. Jagged curves along the edges of triangles
are good enough for what they carry into the patches.

Letters: V vertices, F faces, C cage vertices, E cage edges.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 4 and appendix C.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float64, Int32, Integer
from scipy import sparse
from scipy.sparse import csgraph

from capture4d.errors import InputError
from capture4d.geometry.mesh import edge_lengths, edges_of_faces, unique_edges

__all__ = ["Cage", "cage_of_curves", "cage_of_edges", "cage_of_labels", "merged_specks"]


@dataclass(frozen=True, slots=True, eq=False)
class Cage:
    """Curves on a mesh, and the patches between them."""

    vertices: Int32[np.ndarray, " C"]
    """On the curves, ascending."""
    edges: Int32[np.ndarray, "E 2"]
    """Of the curves, as vertices of the mesh, the smaller first."""
    patches: Int32[np.ndarray, " F"]
    """The patch of each face, counted from 0."""

    @property
    def patch_count(self) -> int:
        """Number of patches."""
        return int(self.patches.max(initial=-1)) + 1

    def smoothed(self, values: Float[np.ndarray, "C channels"], steps: int) -> Float64[np.ndarray, "C channels"]:
        """Values half way to the mean of their neighbours along the curves, so many times."""
        ends = np.searchsorted(self.vertices, self.edges)
        rows, columns = np.concatenate([ends, ends[:, ::-1]]).T
        count = len(self.vertices)
        links = sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
        degree = np.maximum(links.sum(axis=1), 1)[:, None]
        values = np.asarray(values, np.float64)
        for _ in range(steps):
            values = 0.5 * values + 0.5 * (links @ values) / degree
        return values


def cage_of_edges(faces: Integer[np.ndarray, "F 3"], edges: Integer[np.ndarray, "E 2"]) -> Cage:
    """The cage of these edges and the open borders.

    Args:
        edges: of the mesh, in any order.
    Raises:
        InputError: one is no edge of the mesh.
    """
    every = unique_edges(faces)
    of_face = edges_of_faces(faces, every)
    in_cage = np.bincount(of_face.ravel(), minlength=len(every)) == 1
    if len(edges):
        keys = (every[:, 0].astype(np.int64) << 32) | every[:, 1]
        wanted = (edges.min(axis=1).astype(np.int64) << 32) | edges.max(axis=1)
        place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        strange = np.flatnonzero(keys[place] != wanted)
        if len(strange):
            first, second = (int(end) for end in edges[strange[0]])
            raise InputError(f"expected edges of the mesh, found {first} to {second}")
        in_cage[place] = True
    order = np.argsort(of_face.ravel(), kind="stable")
    edge, face = of_face.ravel()[order], order // 3
    across = np.flatnonzero((edge[1:] == edge[:-1]) & ~in_cage[edge[1:]])
    links = sparse.coo_array((np.ones(len(across)), (face[across], face[across + 1])), shape=(len(faces), len(faces)))
    patches = csgraph.connected_components(links, directed=False)[1].astype(np.int32)
    return Cage(np.unique(every[in_cage]).astype(np.int32), every[in_cage], patches)


def cage_of_labels(faces: Integer[np.ndarray, "F 3"], labels: Integer[np.ndarray, " labels"]) -> Cage:
    """The cage where faces of different labels meet, and the open borders. A label that lies in two places makes two
    patches.

    Raises:
        InputError: not one label a face.
    """
    if labels.shape != (len(faces),):
        raise InputError(f"expected a label for each of {len(faces)} triangles, found {labels.shape}")
    every = unique_edges(faces)
    return cage_of_edges(faces, every[_parted(edges_of_faces(faces, every), labels, len(every))])


def cage_of_curves(
    vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"], curves: Sequence[Integer[np.ndarray, " _"]]
) -> Cage:
    """The cage of curves through vertices, and the open borders.

    Args:
        curves: vertices in order; two that are no neighbours are joined by the shortest way along edges. A closed curve
            ends where it began.
    Raises:
        InputError: a vertex is not in the mesh, or there is no way from one to the next.
    """
    every = unique_edges(faces)
    lengths = edge_lengths(np.asarray(vertices, np.float64), every)
    count = len(vertices)
    ways = sparse.csr_array((np.maximum(lengths, 1e-12), (every[:, 0], every[:, 1])), shape=(count, count))
    sides = []
    for number, curve in enumerate(curves):
        if len(curve) < 2 or curve.min() < 0 or curve.max() >= count:
            raise InputError(f"curve {number}: expected two or more vertices from 0 to {count - 1}, found "
                             f"{len(curve)} from {curve.min(initial=0)} to {curve.max(initial=0)}")  # fmt: skip
        _, before = csgraph.dijkstra(ways, directed=False, indices=curve[:-1], return_predecessors=True)
        for row, (start, end) in enumerate(pairwise(curve.tolist())):
            here = end
            while here != start:
                onward = int(before[row, here])
                if onward < 0:
                    raise InputError(f"curve {number}: expected a way along edges, found none from {start} to "
                                     f"{end}")  # fmt: skip
                sides.append((onward, here))
                here = onward
    return cage_of_edges(faces, np.array(sides, np.int32).reshape(-1, 2))


def merged_specks(
    faces: Integer[np.ndarray, "F 3"], labels: Integer[np.ndarray, " F"], areas: Float[np.ndarray, " F"], least: float
) -> Int32[np.ndarray, " F"]:
    """Labels of which each covers a connected patch, none smaller than a share of the surface unless it is a part of
    its own: smaller ones go to the neighbour with the longest common border.

    Args:
        areas: of the faces.
        least: share of the sum of areas.
    """
    every = unique_edges(faces)
    of_face = edges_of_faces(faces, every)
    patches = cage_of_labels(faces, labels).patches
    order = np.argsort(of_face.ravel(), kind="stable")
    edge, face = of_face.ravel()[order], order // 3
    pair = np.flatnonzero(edge[1:] == edge[:-1])
    one, other = face[pair], face[pair + 1]
    while True:
        size = np.bincount(patches, areas)
        used = np.flatnonzero(np.bincount(patches))
        apart = patches[one] != patches[other]
        met = np.concatenate([np.stack([patches[one], patches[other]])[:, apart],
                              np.stack([patches[other], patches[one]])[:, apart]], axis=1)  # fmt: skip
        small = used[(size[used] < least * areas.sum()) & np.isin(used, met[0])]
        if not len(small):
            return np.unique(patches, return_inverse=True)[1].astype(np.int32)
        smallest = small[np.argmin(size[small])]
        patches = np.where(patches == smallest, np.bincount(met[1][met[0] == smallest]).argmax(), patches)


def _parted(of_face: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """Which of the edges have faces of different labels beside them."""
    low, high = np.full(count, np.iinfo(np.int64).max), np.full(count, np.iinfo(np.int64).min)
    for side in range(3):
        np.minimum.at(low, of_face[:, side], labels)
        np.maximum.at(high, of_face[:, side], labels)
    return low != high
