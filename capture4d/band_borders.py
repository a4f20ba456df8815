"""The border of a garment, carried on from the inner rim of its paint.

A scan that fuses a hem with the body behind it bends the outer half of the painted band towards that body, and loses
pieces of it. The inner rim, where garment colour meets paint, is sound. A plane is fitted to the surface on both sides
of each point of the rim, and the border lies on it, a band's width beyond the rim. The band's width is learned where
the band is flat: the median way to where the paint changes to another colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import KDTree

from capture4d.border_loops import straighten
from capture4d.types import Mesh

__all__ = ["border_beyond_rim"]

TRUSTED = 0.6
"""Share of the band, from its inner rim, to which planes are fitted; beyond, stereo scans bend (measured)."""
AVERAGED = 0.75
"""Width of the Gaussian along the rim over which planes are fitted, in widths of the band."""
OUTLIER_M, ROUNDS = 0.0008, 2
"""Scale and rounds of the Cauchy weights of the planes."""
FLAT_M = 0.0012
"""Ends of the paint within this distance of their plane tell the width of the band."""
MIN_REACH = 0.6
"""Rims from which the paint extends less than this share of the band's width are those of patches and shadows."""
LARGEST_WIDTH_M = 0.04


@dataclass(frozen=True, slots=True, eq=False)
class _Strip:
    """The mesh on both sides of the inner rim."""

    rim: Float64[np.ndarray, "rim 3"]
    """Midpoints of the edges between garment and paint."""
    positions: Float64[np.ndarray, "verts 3"]
    """Vertices that are connected to the rim."""
    distance: Float64[np.ndarray, " verts"]
    """To the rim along the surface, metres; negative on the garment."""
    nearest: np.ndarray
    """(V,) index of the nearest rim point, along the surface."""
    ends: Float64[np.ndarray, "ends 3"]
    """Where the paint ends."""
    ends_nearest: np.ndarray
    """(E,) index of the nearest rim point, along the surface."""
    ends_distance: Float64[np.ndarray, " ends"]
    """To the rim along the surface, metres."""


@dataclass(frozen=True, slots=True, eq=False)
class _Planes:
    """At every point of the rim, the plane `height = offset + slope * outward`."""

    origin: Float64[np.ndarray, "rim 3"]
    outward: Float64[np.ndarray, "rim 3"]
    normal: Float64[np.ndarray, "rim 3"]
    offset: Float64[np.ndarray, " rim"]
    slope: Float64[np.ndarray, " rim"]

    def beyond(self, distance: float) -> Float64[np.ndarray, "rim 3"]:
        """Points on the planes so far from the rim."""
        along = distance / np.hypot(1, self.slope)
        height = self.offset + self.slope * along
        return self.origin + along[:, None] * self.outward + height[:, None] * self.normal

    def coordinates(self, points: np.ndarray, rim: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far points are from the rim points `rim` within their planes, and how far off the planes."""
        offset = points - self.origin[rim]
        along = np.einsum("pi,pi->p", offset, self.outward[rim])
        height = np.einsum("pi,pi->p", offset, self.normal[rim]) - self.offset[rim] - self.slope[rim] * along
        return along * np.hypot(1, self.slope[rim]), height


def border_beyond_rim(
    mesh: Mesh, garment: Bool[np.ndarray, " verts"], painted: Bool[np.ndarray, " verts"]
) -> Float64[np.ndarray, "points 3"]:
    """Points on the border beyond a painted band of even width, one for each edge from garment to paint.

    Args:
        mesh: a scan that goes on beyond the border.
        garment, painted: its vertices of garment colour, and of one paint.
    """
    strip = _strip(mesh, garment, painted)
    if strip is None or len(strip.ends) < 3:
        return np.zeros((0, 3))
    rough = float(np.median(strip.ends_distance))
    planes = _planes(strip, rough)
    width = _width(strip, planes, rough)
    reached = _reach(strip, AVERAGED * rough) >= MIN_REACH * width
    return planes.beyond(width)[reached]


def _strip(mesh: Mesh, garment: np.ndarray, painted: np.ndarray) -> _Strip | None:
    """The surface within a wide band of the rim, and the way from there along its edges."""
    known = (garment | painted)[mesh.faces].all(axis=1)
    crossed = known & painted[mesh.faces].any(axis=1) & garment[mesh.faces].any(axis=1)
    if not crossed.any():
        return None
    middles = mesh.vertices[mesh.faces[crossed]].mean(axis=1)
    near = np.isfinite(KDTree(middles).query(mesh.vertices, distance_upper_bound=LARGEST_WIDTH_M)[0])
    local, corners = np.unique(mesh.faces[known & near[mesh.faces].all(axis=1)], return_inverse=True)
    corners = corners.reshape(-1, 3)
    pairs = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    start, end = np.divmod(np.unique(pairs[:, 0].astype(np.int64) * len(local) + pairs[:, 1]), len(local))
    positions, paint = mesh.vertices[local].astype(np.float64), painted[local]
    length = np.maximum(np.linalg.norm(positions[start] - positions[end], axis=1), 1e-9)
    crosses = paint[start] != paint[end]
    first, second, half = start[crosses], end[crosses], length[crosses] / 2
    sources = len(local) + np.arange(len(half))  # rim points become nodes of the graph
    graph = sparse.csr_array(
        (
            np.concatenate([length[~crosses], half, half]),
            (
                np.concatenate([start[~crosses], sources, sources]),
                np.concatenate([end[~crosses], first, second]),
            ),
        ),
        shape=(len(local) + len(half),) * 2,
    )
    distance, _, source = csgraph.dijkstra(
        graph, directed=False, indices=sources, min_only=True, return_predecessors=True, limit=LARGEST_WIDTH_M
    )
    linked = np.flatnonzero(np.isfinite(distance[: len(local)]))
    ends, inner = _ends(mesh, garment, painted)
    place = np.full(len(mesh.vertices), -1)
    place[local[linked]] = linked
    ends, inner = ends[place[inner] >= 0], place[inner[place[inner] >= 0]]
    return _Strip(
        rim=(positions[first] + positions[second]) / 2,
        positions=positions[linked],
        distance=np.where(paint, distance[: len(local)], -distance[: len(local)])[linked],
        nearest=source[linked] - len(local),
        ends=ends,
        ends_nearest=source[inner] - len(local),
        ends_distance=distance[inner] + np.linalg.norm(ends - positions[inner], axis=1),
    )


def _ends(mesh: Mesh, garment: np.ndarray, painted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Midpoints of the edges from paint to what is neither paint nor garment, and the painted vertex of each."""
    others = ~(garment | painted)
    faces = mesh.faces[painted[mesh.faces].any(axis=1) & others[mesh.faces].any(axis=1)]
    edges = np.concatenate([faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0), (1, 0), (2, 1), (0, 2))])
    edges = np.unique(edges[painted[edges[:, 0]] & others[edges[:, 1]]], axis=0)
    return mesh.vertices[edges].astype(np.float64).mean(axis=1), edges[:, 0]


def _planes(strip: _Strip, width_m: float) -> _Planes:
    """Planes through the garment and the inner part of the band, fitted to what is nearest to each piece of the rim."""
    reach = AVERAGED * width_m
    origin = straighten(strip.rim, width_m)
    tree, count = KDTree(origin), len(origin)
    links = tree.sparse_distance_matrix(tree, reach, output_type="coo_matrix")
    neighbours = origin[links.col] - origin[links.row]
    weight = np.exp(-2 * (links.data / reach) ** 2)
    middle = _summed(neighbours, weight, links.row, count) / _summed(np.ones(len(weight)), weight, links.row, count)
    neighbours -= middle[links.row]
    spread = _summed(neighbours[:, :, None] * neighbours[:, None, :], weight, links.row, count)
    along = np.linalg.eigh(spread.reshape(-1, 3, 3))[1][:, :, 2]

    sound = np.flatnonzero((strip.distance > -width_m) & (strip.distance < TRUSTED * width_m))
    foot = strip.rim[strip.nearest[sound]]
    links = tree.sparse_distance_matrix(KDTree(foot), reach, output_type="coo_matrix")
    row, point = links.row, sound[links.col]
    weight = np.exp(-2 * (links.data / reach) ** 2)
    offset = strip.positions[point] - origin[row]
    sideways = np.einsum("pi,pi->p", offset, along[row])
    across = (offset - sideways[:, None] * along[row]) * strip.distance[point][:, None]
    outward = _summed(across, weight, row, count)
    outward /= np.maximum(np.linalg.norm(outward, axis=1), 1e-12)[:, None]
    normal = np.cross(along, outward)
    terms = np.column_stack([np.ones(len(row)), sideways, np.einsum("pi,pi->p", offset, outward[row])])
    height = np.einsum("pi,pi->p", offset, normal[row])
    plane = np.zeros((count, 3))
    robust = weight
    for _ in range(1 + ROUNDS):
        square = _summed(terms[:, :, None] * terms[:, None, :], robust, row, count).reshape(-1, 3, 3)
        right = _summed(terms * height[:, None], robust, row, count)
        plane = np.linalg.solve(square + 1e-9 * np.eye(3), right[:, :, None])[:, :, 0]
        residual = height - np.einsum("pi,pi->p", terms, plane[row])
        robust = weight / (1 + (residual / OUTLIER_M) ** 2)
    return _Planes(origin, outward, normal, offset=plane[:, 0], slope=plane[:, 2])


def _summed(values: np.ndarray, weight: np.ndarray, row: np.ndarray, count: int) -> np.ndarray:
    """Weighted sums of the values of each row, (count, ...) flattened to two axes."""
    gather = sparse.csr_array((weight, (row, np.arange(len(row)))), (count, len(row)))
    return gather @ values.reshape(len(row), -1)


def _width(strip: _Strip, planes: _Planes, rough_m: float) -> float:
    along, height = planes.coordinates(strip.ends, strip.ends_nearest)
    flat = along[(np.abs(height) < FLAT_M) & (along > rough_m / 2)]
    return float(np.median(flat)) if len(flat) >= 20 else rough_m


def _reach(strip: _Strip, near_m: float) -> Float64[np.ndarray, " rim"]:
    """How far the paint extends from each point of the rim or one near it."""
    own = np.zeros(len(strip.rim))
    np.maximum.at(own, strip.nearest, strip.distance)
    tree = KDTree(strip.rim)
    links = tree.sparse_distance_matrix(tree, near_m, output_type="coo_matrix")
    farthest = own.copy()
    np.maximum.at(farthest, links.row, own[links.col])
    return farthest
