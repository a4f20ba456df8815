"""Cloth that has passed through itself is drawn back, without knowing how it got there.

Where two faces cut each other, an edge of one pierces the other, and the cut runs on from there into the face behind
the edge. Moved against each other in the direction in which the cut shortens fastest, they part where cloth has only
just passed through cloth; layers that lie in each other over a hand's breadth do not.

References: Volino and Magnenat-Thalmann, Resolving Surface Collisions through Intersection Contour Minimization
(SIGGRAPH 2006); a face's share of the gradient here is that of the cut's length on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture4d.geometry.triangles import (
    along3,
    cross3,
    difference3,
    dot3,
    intersecting_pairs,
    segment_cuts,
)
from capture4d.heavy_imports import njit
from data_synth.cloth.tightening import tighten

__all__ = ["Room", "untangle"]

RINGS = 3
"""Around faces that cut each other so many rings of cloth give way."""
SWEEPS = 3
"""Over the lengths of that cloth after each step."""
ADVANCE = 0.25
"""Of a step, as a share of the mean edge."""


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """Where the vertices of a sheet may be."""

    base: np.ndarray
    """(V, 3) float32 metres."""
    radius: float
    """Farthest from the base, metres."""
    plane_points: np.ndarray
    """(V, 3) float32 points of half planes that the vertices keep outside of."""
    plane_normals: np.ndarray
    """(V, 3) float32."""
    margin: float
    """Nearest to the half planes, metres."""

    def of(self, rows: np.ndarray) -> Room:
        """The same for some of the vertices."""
        return Room(self.base[rows], self.radius, self.plane_points[rows], self.plane_normals[rows], self.margin)


def untangle(
    points: np.ndarray, faces: np.ndarray, edges: np.ndarray, lengths: np.ndarray, room: Room, *, steps: int
) -> np.ndarray:
    """Part faces that cut each other, as far as some steps go.

    Args:
        points: (V, 3) float32 metres.
        faces: (F, 3) int32.
        edges: (E, 2) int32 of the faces, and their lengths, (E,) float32 metres.
    Returns:
        (V, 3) float32: the points, moved where cloth cuts cloth and `RINGS` around it.
    """
    pairs = intersecting_pairs(points.astype(np.float64), faces) if steps else np.zeros((0, 2), np.int64)
    if not len(pairs):
        return points
    near = np.zeros(len(points), bool)
    near[faces[pairs]] = True
    for _ in range(RINGS):
        near[edges[near[edges].any(axis=1)]] = True
    rows, number = np.flatnonzero(near), np.cumsum(near, dtype=np.int32) - 1
    inner = near[edges].all(axis=1)
    part, part_edges, part_lengths = number[faces[near[faces].all(axis=1)]], number[edges[inner]], lengths[inner]
    here, moved = room.of(rows), points[rows]
    step = ADVANCE * float(part_lengths.mean())
    none, no_weights = np.zeros((0, 4), np.int32), np.zeros((0, 5), np.float32)
    for _ in range(steps):
        places = moved.astype(np.float64)
        pairs = intersecting_pairs(places, part)
        if not len(pairs):
            break
        moved = (places + step * _shortening(places, part, pairs)).astype(np.float32)
        tighten(
            moved,
            here.base,
            np.float32(here.radius),
            part_edges,
            part_lengths,
            np.float32(1),
            np.float32(1),
            none,
            no_weights,
            np.float32(0),
            here.plane_points,
            here.plane_normals,
            np.float32(here.margin),
            SWEEPS,
        )
    result = points.copy()
    result[rows] = moved
    return result


@njit(cache=True)
def _shortening(x, faces, pairs):
    """Directions, (V, 3) of length 1 at most, in which the cuts between pairs of faces shorten fastest."""
    moves, weights = np.zeros((len(x), 3)), np.zeros(len(x))
    for n in range(len(pairs)):
        for way in range(2):
            f, g = faces[pairs[n, way]], faces[pairs[n, 1 - way]]
            for i in range(3):
                if segment_cuts(x, f[i], f[(i + 1) % 3], g[0], g[1], g[2]):
                    _part(x, f[i], f[(i + 1) % 3], f[(i + 2) % 3], g, moves, weights)
    for v in range(len(x)):
        if weights[v] > 0:
            size = np.sqrt(moves[v, 0] ** 2 + moves[v, 1] ** 2 + moves[v, 2] ** 2)
            for k in range(3):
                moves[v, k] /= max(weights[v], size)
    return moves


@njit(cache=True)
def _part(x, start, end, behind, g, moves, weights):
    """Add what parts the edge of a face, with its third vertex behind it, from the face g that it pierces."""
    along, e1, e2 = difference3(x, end, start), difference3(x, g[1], g[0]), difference3(x, g[2], g[0])
    inwards = difference3(x, behind, start)
    normal, own = cross3(e1, e2), cross3(along, inwards)
    cut = cross3(normal, own)
    n, e, c = np.sqrt(dot3(normal, normal)), np.sqrt(dot3(along, along)), np.sqrt(dot3(cut, cut))
    across = dot3(along, normal)
    if c < 1e-18 or abs(across) < 1e-3 * n * e:
        return
    if dot3(cut, cross3(own, along)) < 0:  # the cut runs into the face
        c = -c
    slide = dot3(along, cut) / c / across
    move = along3(cut, 1 / c, normal, -slide)
    size = np.sqrt(dot3(move, move))
    if size < 1e-9:
        return
    t = -dot3(difference3(x, start, g[0]), normal) / across
    s = along3(difference3(x, start, g[0]), 1.0, along, t)
    second = dot3(cross3(s, e2), normal) / n**2
    third = dot3(cross3(e1, s), normal) / n**2
    for vertex, share in ((start, 1 - t), (end, t), (g[0], second + third - 1), (g[1], -second), (g[2], -third)):
        for k in range(3):
            moves[vertex, k] += share * move[k] / size
        weights[vertex] += abs(share)
