"""Nearest points of a scan, by cells of a regular grid.

A template is matched to a scan a handful of times and a few thousand points at a time, so that most of a tree's time
goes into building it. Points of a surface, evenly spaced, sort into cells in a tenth of that. Results are exact: those
of `scipy.spatial.KDTree.query`, and the nearest point that faces a given way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from capture4d.heavy_imports import njit

__all__ = ["PointGrid"]

MAX_CELLS = 2_000_000
"""Scans with stray points far away get larger cells, not more memory."""


@dataclass(frozen=True, slots=True, eq=False)
class PointGrid:
    """Points sorted by cell."""

    origin: Float64[np.ndarray, "3"]
    cell: float
    """Edge of a cell, metres."""
    shape: tuple[int, int, int]
    starts: np.ndarray
    """(cells + 1,) int32: where the points of each cell begin."""
    points: Float64[np.ndarray, "points 3"]
    """In the order of the cells."""
    order: np.ndarray
    """(points,) int32: the index of each of them in the points handed to `build`."""

    @staticmethod
    def build(points: Float64[np.ndarray, "points 3"], cell: float) -> PointGrid:
        """Sort points, at least one, into cells.

        Args:
            cell: edge of a cell, metres: about three times the distance between the points.
        """
        origin, extent = box_of(points)
        a, b, c = extent.tolist()
        cell = max(cell, 1e-6 * max(a, b, c), 1e-12)
        while (a // cell + 1) * (b // cell + 1) * (c // cell + 1) > MAX_CELLS:
            cell *= 1.25
        shape = int(a / cell) + 1, int(b / cell) + 1, int(c / cell) + 1
        starts, order = sort_into_cells(points, origin, cell, *shape)
        return PointGrid(origin, cell, shape, starts, points[order], order)

    def query(
        self, points: Float64[np.ndarray, "queries 3"], bound: float = np.inf
    ) -> tuple[Float64[np.ndarray, " queries"], Int64[np.ndarray, " queries"]]:
        """Distance to the nearest point, metres, and its index.

        Args:
            bound: farther points are not looked for; there the distance is infinite and the index the number of points.
        """
        nothing = np.zeros((0, 3))
        return self._nearest(points, np.full(len(points), bound), nothing, nothing, -1.0)

    def query_facing(
        self,
        points: Float64[np.ndarray, "queries 3"],
        directions: Float64[np.ndarray, "queries 3"],
        bounds: Float64[np.ndarray, " queries"],
        normals: Float64[np.ndarray, "points 3"],
        min_cosine: float,
    ) -> tuple[Float64[np.ndarray, " queries"], Int64[np.ndarray, " queries"]]:
        """The same among points whose normal is near a direction.

        Args:
            normals: unit, of the points handed to `build` and in their order.
            min_cosine: smallest cosine between a direction and a normal.
        """
        return self._nearest(points, bounds, directions, normals, min_cosine)

    def _nearest(
        self, points: np.ndarray, bounds: np.ndarray, directions: np.ndarray, normals: np.ndarray, min_cosine: float
    ) -> tuple[np.ndarray, np.ndarray]:
        return nearest_points(
            np.ascontiguousarray(points, np.float64), bounds, directions, min_cosine,
            self.origin, self.cell, self.shape, self.starts, self.points, self.order, normals,
        )  # fmt: skip


@njit(cache=True)
def box_of(points):
    """Lowest corner and extent."""
    low, high = points[0].copy(), points[0].copy()
    for p in range(1, len(points)):
        for axis in range(3):
            low[axis], high[axis] = min(low[axis], points[p, axis]), max(high[axis], points[p, axis])
    return low, high - low


@njit(cache=True)
def sort_into_cells(points, origin, cell, x, y, z):
    """Counting sort: offsets of the cells, and the points' indices in the order of their cells."""
    cells = np.empty(len(points), np.int32)
    starts = np.zeros(x * y * z + 1, np.int32)
    for p in range(len(points)):
        i = min(np.int64((points[p, 0] - origin[0]) / cell), x - 1)
        j = min(np.int64((points[p, 1] - origin[1]) / cell), y - 1)
        k = min(np.int64((points[p, 2] - origin[2]) / cell), z - 1)
        cells[p] = (i * y + j) * z + k
        starts[cells[p] + 1] += 1
    for c in range(x * y * z):
        starts[c + 1] += starts[c]
    place = starts[:-1].copy()
    order = np.empty(len(points), np.int32)
    for p in range(len(points)):
        order[place[cells[p]]] = p
        place[cells[p]] += 1
    return starts, order


@njit(cache=True)
def nearest_points(queries, bounds, directions, min_cosine, origin, cell, shape, starts, points, order, normals):
    """Cells in shells around each query, until no cell beyond can hold a nearer point."""
    x, y, z = shape
    nearly = cell**2 * (1.0 - 1e-9)  # a point may lie beyond its cell by what rounding does
    choosy = len(directions) > 0
    distances, indices = np.full(len(queries), np.inf), np.full(len(queries), len(points), np.int64)
    for q in range(len(queries)):
        a, b, c = queries[q, 0], queries[q, 1], queries[q, 2]
        u, v, w = (a - origin[0]) / cell, (b - origin[1]) / cell, (c - origin[2]) / cell
        i0, j0, k0 = np.int64(np.floor(u)), np.int64(np.floor(v)), np.int64(np.floor(w))
        inset = min(u - i0, v - j0, w - k0, i0 + 1 - u, j0 + 1 - v, k0 + 1 - w)
        first = max(-i0, i0 - x + 1, -j0, j0 - y + 1, -k0, k0 - z + 1, 0)
        last = max(i0, x - 1 - i0, j0, y - 1 - j0, k0, z - 1 - k0)
        best = bounds[q] ** 2
        for shell in range(first, last + 1):
            if shell > 0 and ((shell - 1 + inset) * cell) ** 2 > best:
                break
            for i in range(max(i0 - shell, 0), min(i0 + shell, x - 1) + 1):
                for j in range(max(j0 - shell, 0), min(j0 + shell, y - 1) + 1):
                    whole = shell == 0 or abs(i - i0) == shell or abs(j - j0) == shell
                    for k in range(k0 - shell, k0 + shell + 1, 1 if whole else 2 * shell):
                        if k < 0 or k >= z:
                            continue
                        if shell > 0:
                            beside = max(i - u, u - i - 1, 0.0) ** 2 + max(j - v, v - j - 1, 0.0) ** 2
                            if (beside + max(k - w, w - k - 1, 0.0) ** 2) * nearly > best:
                                continue
                        at = (i * y + j) * z + k
                        for p in range(starts[at], starts[at + 1]):
                            away = (points[p, 0] - a) ** 2 + (points[p, 1] - b) ** 2 + (points[p, 2] - c) ** 2
                            if away >= best:
                                continue
                            n = order[p]
                            if choosy:
                                cosine = 0.0
                                for axis in range(3):
                                    cosine += directions[q, axis] * normals[n, axis]
                                if cosine < min_cosine:
                                    continue
                            best = away
                            indices[q] = n
                            distances[q] = np.sqrt(away)
    return distances, indices
