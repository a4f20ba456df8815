"""Where on a surface a point lies, told by nothing but distances along the surface: the same in every pose.

A hand is far from most of a person, a hip is not, whichever way the arms hang. The signature of a point is how its
distances to all of the surface are distributed. Distances run over patches, a few hundredths of the surface's size
across, so that a scan of any resolution takes a fraction of a second. Patches never join what faces different ways: an
arm beside a trunk stays an arm, unless the mesh itself joins them.

References: Hamza and Krim 2003 (geodesic object representation); Osada et al. 2002 (shape distributions).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64, Integer
from scipy import sparse
from scipy.sparse import csgraph

from registration.approach import spread_evenly
from registration.correspondences import mesh_normals

__all__ = ["Likeness", "geodesic_signatures", "likeness"]

PATCH_M = 0.02
"""Edge of the cells that patches are cut by, of a template of 1.2 m; half of it changes nothing but the time."""
SOURCES = 80
"""Places, spread evenly, from which distances are measured."""
SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Quantiles of the distances that make a signature."""
COMPARED = 2000
"""Points, spread evenly, on which two surfaces' signatures are compared."""


def geodesic_signatures(
    vertices: Float[np.ndarray, "verts 3"], faces: Integer[np.ndarray, "faces 3"]
) -> Float64[np.ndarray, "verts quantiles"]:
    """Quantiles of each vertex's distances to the whole surface, along it, metres.

    Between pieces that do not touch, distances run through the air.
    """
    of_vertex, centres, graph = _patches(np.ascontiguousarray(vertices, np.float64), np.asarray(faces, np.int32))
    sources = spread_evenly(centres, SOURCES)
    distances = csgraph.dijkstra(graph, directed=False, indices=sources)
    through_air = np.linalg.norm(centres[sources, None] - centres[None], axis=2)
    distances = np.where(np.isfinite(distances), distances, through_air)
    return np.quantile(distances, SHARES, axis=0).T[of_vertex]


@dataclass(frozen=True, slots=True, eq=False)
class Likeness:
    """What one surface's signatures are beside another's."""

    size: float
    """Distances along the second surface over those along the first, in the median."""
    gap: float
    """How differently both are distributed, once they lie in one place, metres in the mean."""
    levelled: Float64[np.ndarray, "points quantiles"]
    """The second surface's signatures, shifted to where the first's lie: noise and holes make every way along a scan a
    little longer or shorter."""


def likeness(
    own: Float64[np.ndarray, "verts quantiles"],
    own_places: Float64[np.ndarray, "verts 3"],
    other: Float64[np.ndarray, "points quantiles"],
    other_places: Float64[np.ndarray, "points 3"],
) -> Likeness:
    """Compare the signatures of two surfaces, each point of which has one and a place."""
    shares = np.linspace(0.05, 0.95, 19)
    here = np.quantile(own[spread_evenly(own_places, COMPARED)], shares, axis=0)
    there = np.quantile(other[spread_evenly(other_places, COMPARED)], shares, axis=0)
    shift = np.median(there - here, axis=0)
    size = float((there[9] / np.maximum(here[9], 1e-9)).mean())
    return Likeness(size, float(np.abs(there - here - shift).mean()), other - shift)


def _patches(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[Int64[np.ndarray, " verts"], Float64[np.ndarray, "patches 3"], sparse.csr_array]:
    """Patch of each vertex, the patches' centres, and the distances between those that the mesh joins."""
    normals = mesh_normals(vertices, faces)
    main = np.abs(normals).argmax(axis=1)
    side = 2 * main + (normals[np.arange(len(normals)), main] > 0.0)
    cells = np.floor((vertices - vertices.min(axis=0)) / PATCH_M).astype(np.int64)
    size = cells.max(axis=0) + 1
    keys = ((cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]) * 6 + side
    of_vertex = np.unique(keys, return_inverse=True)[1].astype(np.int64)
    members = np.bincount(of_vertex)
    centres = np.stack([np.bincount(of_vertex, axis) for axis in vertices.T], axis=1) / members[:, None]
    corners = of_vertex[faces]
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    first, second = np.divmod(np.unique(pairs[:, 0] * len(members) + pairs[:, 1]), len(members))
    lengths = np.maximum(np.linalg.norm(centres[first] - centres[second], axis=1), 1e-9)
    return of_vertex, centres, sparse.csr_array((lengths, (first, second)), shape=(len(members),) * 2)
