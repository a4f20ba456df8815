"""The inner rim of a painted border: where cloth and paint meet, on the edges of a scan between them.

A scan stops short of a border here and there, and of the paint's outer edge with it; its inner one is sound all along.
Colours blend over a sample or two there, and how they do tells where between two samples the paint begins.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from scipy.spatial import KDTree

from capture4d.geometry.mesh import unique_edges
from capture4d.types import Mesh

__all__ = ["inner_rim"]

BLENDED, SAMPLED = 2, 5
"""Edges on both sides of the rim within which colours may blend, and within which they are looked at at all."""
SAMPLES = 12
"""Unblended vertices whose mean colour is the pure colour there."""


def inner_rim(
    mesh: Mesh, colours: UInt8[np.ndarray, "verts 3"], painted: Bool[np.ndarray, " verts"]
) -> Float64[np.ndarray, "points 3"]:
    """Points where as much of the colour is the cloth's as is the paint's, metres; none without both.

    Args:
        painted: vertices of the paint; all others are cloth.
    """
    corners = painted[mesh.faces].sum(axis=1)
    rings = [_vertices(mesh.faces, (corners > 0) & (corners < 3), len(painted))]
    for _ in range(SAMPLED - 1):
        rings.append(_vertices(mesh.faces, rings[-1][mesh.faces].sum(axis=1) > 0, len(painted)))
    blended = rings[BLENDED - 1]
    asked = np.flatnonzero(blended)
    sides = [np.flatnonzero(rings[-1] & ~rings[0] & one) for one in (~painted, painted)]
    if min(map(len, sides)) < SAMPLES:
        return np.zeros((0, 3))
    positions = mesh.vertices.astype(np.float64)
    cloth, paint = (
        colours[side[KDTree(positions[side]).query(positions[asked], SAMPLES)[1]]].mean(axis=1) for side in sides
    )
    across = paint - cloth
    share = np.einsum("vc,vc->v", colours[asked] - cloth, across) / np.maximum((across**2).sum(axis=1), 1.0)
    place = np.cumsum(blended) - 1
    start, end = place[unique_edges(mesh.faces[blended[mesh.faces].all(axis=1)])].T
    crosses = (share[start] > 0.5) != (share[end] > 0.5)
    start, end = start[crosses], end[crosses]
    part = ((0.5 - share[start]) / (share[end] - share[start]))[:, None]
    return (1.0 - part) * positions[asked[start]] + part * positions[asked[end]]


def _vertices(faces: np.ndarray, chosen: np.ndarray, count: int) -> Bool[np.ndarray, " verts"]:
    """The vertices of some faces."""
    there = np.zeros(count, bool)
    there[faces[chosen]] = True
    return there
