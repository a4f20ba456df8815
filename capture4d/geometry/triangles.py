"""Triangles against points, segments and each other: nearest points, cuts, faces of a mesh that cut the mesh itself.

The compiled loops take plain arrays of float64 positions and integer faces, or tuples of three numbers for a point;
nothing is checked.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Integer

from capture4d.geometry.point_grid import PointGrid
from capture4d.heavy_imports import njit

__all__ = [
    "along3",
    "closest_in_triangle",
    "closest_on_faces",
    "count_intersecting_faces",
    "cross3",
    "difference3",
    "dot3",
    "fan_distances",
    "intersecting_pairs",
    "segment_cuts",
    "self_intersections",
]


def count_intersecting_faces(vertices: Float64[np.ndarray, "verts 3"], faces: Integer[np.ndarray, "faces 3"]) -> int:
    """Faces that cut another face they share no vertex with."""
    return int(self_intersections(vertices, faces).sum())


def self_intersections(
    vertices: Float64[np.ndarray, "verts 3"], faces: Integer[np.ndarray, "faces 3"]
) -> Bool[np.ndarray, " faces"]:
    """Which faces cut another face they share no vertex with."""
    return intersecting_faces(vertices, faces, *_cells_of_faces(vertices, faces))


def intersecting_pairs(
    vertices: Float64[np.ndarray, "verts 3"], faces: Integer[np.ndarray, "faces 3"]
) -> Integer[np.ndarray, "pairs 2"]:
    """The pairs of faces that cut each other and share no vertex, each once."""
    return pairs_of_faces(vertices, faces, *_cells_of_faces(vertices, faces))


def _cells_of_faces(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray, float, tuple[int, int, int], np.ndarray, np.ndarray]:
    """Centres of faces, how far apart those of faces that cut each other can be, and the grid of the centres."""
    corners = vertices[faces]
    centre = corners.mean(axis=1)
    offsets = corners - centre[:, None]
    reach = np.sqrt(np.einsum("fca,fca->fc", offsets, offsets).max(axis=1))
    radius = 2.0 * float(np.percentile(reach, 99))
    cells = PointGrid.build(centre, radius)
    return centre, radius, cells.origin, cells.cell, cells.shape, cells.starts, cells.order


@njit(cache=True, inline="always")
def dot3(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@njit(cache=True, inline="always")
def cross3(u, v):
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@njit(cache=True, inline="always")
def difference3(points, p, q):
    return points[p, 0] - points[q, 0], points[p, 1] - points[q, 1], points[p, 2] - points[q, 2]


@njit(cache=True, inline="always")
def along3(u, s, v, t):
    """u s + v t."""
    return u[0] * s + v[0] * t, u[1] * s + v[1] * t, u[2] * s + v[2] * t


@njit(cache=True)
def closest_in_triangle(p, a, b, c):
    """Barycentric coordinates of a triangle's point nearest to p (Ericson, Real-Time Collision Detection, 5.1.5)."""
    ab, ac, ap = along3(b, 1.0, a, -1.0), along3(c, 1.0, a, -1.0), along3(p, 1.0, a, -1.0)
    d1, d2 = dot3(ab, ap), dot3(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    bp = along3(p, 1.0, b, -1.0)
    d3, d4 = dot3(ab, bp), dot3(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        t = d1 / (d1 - d3) if d1 != d3 else 0.0
        return 1.0 - t, t, 0.0
    cp = along3(p, 1.0, c, -1.0)
    d5, d6 = dot3(ab, cp), dot3(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / (d2 - d6) if d2 != d6 else 0.0
        return 1.0 - t, 0.0, t
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and (d4 - d3) >= 0.0 and (d5 - d6) >= 0.0:
        total = (d4 - d3) + (d5 - d6)
        t = (d4 - d3) / total if total > 0.0 else 0.0
        return 0.0, 1.0 - t, t
    total = va + vb + vc
    if total <= 0.0:
        return 1.0, 0.0, 0.0
    return va / total, vb / total, vc / total


@njit(cache=True, inline="always")
def row3(points, p):
    return points[p, 0], points[p, 1], points[p, 2]


@njit(cache=True)
def fan_distances(points, nearest, vertices, faces, fan_offsets, fan_faces):
    """Distance of each point to the faces around one vertex; those of vertex v are fan_faces[fan_offsets[v] : ...]."""
    result = np.full(len(points), np.inf)
    for n in range(len(points)):
        p = row3(points, n)
        for entry in range(fan_offsets[nearest[n]], fan_offsets[nearest[n] + 1]):
            f = fan_faces[entry]
            a, b, c = row3(vertices, faces[f, 0]), row3(vertices, faces[f, 1]), row3(vertices, faces[f, 2])
            _, second, third = closest_in_triangle(p, a, b, c)
            to_closest = along3(along3(b, 1.0, a, -1.0), second, along3(c, 1.0, a, -1.0), third)
            apart = along3(along3(p, 1.0, a, -1.0), 1.0, to_closest, -1.0)
            result[n] = min(result[n], np.sqrt(dot3(apart, apart)))
    return result


@njit(cache=True)
def closest_on_faces(points, candidates, vertices, faces):
    """The nearest of the candidate faces of each point, and the barycentric coordinates of the nearest point there."""
    face = np.empty(len(points), np.int32)
    barycentric = np.zeros((len(points), 3))
    for i in range(len(points)):
        p = row3(points, i)
        best = np.inf
        for candidate in range(candidates.shape[1]):
            f = candidates[i, candidate]
            a, b, c = row3(vertices, faces[f, 0]), row3(vertices, faces[f, 1]), row3(vertices, faces[f, 2])
            here = closest_in_triangle(p, a, b, c)
            distance = 0.0
            for k in range(3):
                distance += (p[k] - here[0] * a[k] - here[1] * b[k] - here[2] * c[k]) ** 2
            if distance < best:
                best = distance
                face[i] = f
                barycentric[i, 0], barycentric[i, 1], barycentric[i, 2] = here
    return face, barycentric


@njit(cache=True)
def segment_cuts(vertices, start, end, a, b, c):
    """Whether the segment between two vertices passes through a triangle (Moeller and Trumbore 1997)."""
    d, e1, e2 = difference3(vertices, end, start), difference3(vertices, b, a), difference3(vertices, c, a)
    s = difference3(vertices, start, a)
    p = d[1] * e2[2] - d[2] * e2[1], d[2] * e2[0] - d[0] * e2[2], d[0] * e2[1] - d[1] * e2[0]
    det = dot3(e1, p)
    if abs(det) < 1e-18:
        return False
    u = dot3(s, p) / det
    if u < 0.0 or u > 1.0:
        return False
    q = s[1] * e1[2] - s[2] * e1[1], s[2] * e1[0] - s[0] * e1[2], s[0] * e1[1] - s[1] * e1[0]
    v = dot3(d, q) / det
    if v < 0.0 or u + v > 1.0:
        return False
    return 0.0 <= dot3(e2, q) / det <= 1.0


@njit(cache=True)
def intersecting_faces(vertices, faces, centres, radius, origin, cell, shape, starts, order):
    """Marks faces that cut each other, share no vertex, and have centres within a radius, which is not above a cell.

    The last five are of a `PointGrid` of the centres.
    """
    cut = np.zeros(len(faces), np.bool_)
    _search_cuts(vertices, faces, centres, radius, origin, cell, shape, starts, order, cut, np.empty((0, 2), np.int64))
    return cut


@njit(cache=True)
def pairs_of_faces(vertices, faces, centres, radius, origin, cell, shape, starts, order):
    """The same, pair by pair."""
    cut, pairs = np.zeros(len(faces), np.bool_), np.empty((1024, 2), np.int64)
    while True:
        count = _search_cuts(vertices, faces, centres, radius, origin, cell, shape, starts, order, cut, pairs)
        if count <= len(pairs):
            return pairs[:count]
        pairs = np.empty((2 * count, 2), np.int64)


@njit(cache=True)
def _search_cuts(vertices, faces, centres, radius, origin, cell, shape, starts, order, cut, pairs):
    """Mark faces that cut each other; write the pairs, as many as there is room for, and count them.

    Without room for any, faces that are marked are not tested against each other.
    """
    count, found = len(faces), 0
    low, high, centre = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 3))
    place = np.empty((count, 3), np.int64)
    for n in range(count):  # in the order of the cells, so that neighbours lie beside each other in memory
        f = order[n]
        for axis in range(3):
            a, b, c = vertices[faces[f, 0], axis], vertices[faces[f, 1], axis], vertices[faces[f, 2], axis]
            low[n, axis], high[n, axis], centre[n, axis] = min(a, b, c), max(a, b, c), centres[f, axis]
            place[n, axis] = min(np.int64((centres[f, axis] - origin[axis]) / cell), shape[axis] - 1)
    for n in range(count):
        first, last = max(place[n, 2] - 1, 0), min(place[n, 2] + 1, shape[2] - 1)
        for i in range(place[n, 0], min(place[n, 0] + 2, shape[0])):
            for j in range(max(place[n, 1] - 1, 0), min(place[n, 1] + 2, shape[1])):
                row = (i * shape[1] + j) * shape[2]
                for m in range(max(starts[row + first], n + 1), starts[row + last + 1]):
                    if (
                        low[n, 0] > high[m, 0] or low[m, 0] > high[n, 0]
                        or low[n, 1] > high[m, 1] or low[m, 1] > high[n, 1]
                        or low[n, 2] > high[m, 2] or low[m, 2] > high[n, 2]
                    ):  # fmt: skip
                        continue
                    away = 0.0
                    for axis in range(3):
                        away += (centre[n, axis] - centre[m, axis]) ** 2
                    f, g = order[n], order[m]
                    if away > radius**2 or (len(pairs) == 0 and cut[f] and cut[g]):
                        continue
                    if faces_cut(vertices, faces[f], faces[g]):
                        cut[f] = cut[g] = True
                        if found < len(pairs):
                            pairs[found, 0], pairs[found, 1] = f, g
                        found += 1
    return found


@njit(cache=True)
def faces_cut(vertices, f, g):
    """Whether two faces cut each other and share no vertex."""
    for i in range(3):
        for j in range(3):
            if f[i] == g[j]:
                return False
    for i in range(3):
        j = (i + 1) % 3
        if segment_cuts(vertices, f[i], f[j], g[0], g[1], g[2]):
            return True
        if segment_cuts(vertices, g[i], g[j], f[0], f[1], f[2]):
            return True
    return False
