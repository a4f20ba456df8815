"""The border of a garment, carried on from the inner rim of its paint.

A scan that fuses a hem with the body behind it bends the outer half of the painted band towards that body, and loses
pieces of it. The inner rim, where garment colour meets paint, is sound. A surface is fitted near each point of the rim,
and the border lies on it, a band's width beyond the rim. The band's width is learned where the band is flat: the median
way to where the paint changes to another colour. The fit is made twice, to what lies around the rim and to the band
itself, which the scan may have bent. Where the two disagree, a hem is curled or the scan is wrong, and nothing is said.

At a point of the rim, with a along the rim, b outwards and h along the normal, the surface is

    h = c0 + c1 a + c2 b + c3 a^2 + c4 a b

straight in b, because it is carried on in that direction. c3 and c4 have a prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import KDTree

from capture4d.extraction.border_loops import straighten
from capture4d.types import Mesh

__all__ = ["border_beyond_rim"]

AROUND_RIM, WHOLE_BAND = (1.0, 0.6), (0.4, 1.0)
"""The two fits: to what lies within so many widths of the band before the rim, and behind it."""
AGREED_M = 0.0008
"""Largest distance of the two borders."""
NOISE_M, BENT_M, BENT_FROM = 0.0006, 0.002, 0.6
"""Standard deviation of scan points, and what is added to it at the end of the paint, rising from this share of the
band: there stereo scans bend (measured)."""
CURVATURE = 60.0
"""Of folds and twists, 1/m, standard deviation."""
CORRELATED = 9.0
"""Points whose errors count as one."""
AVERAGED = 1.0
"""How far the fits reach along the rim, to both sides, in widths of the band; two standard deviations of a Gaussian."""
OUTLIER_M, ROUNDS = 0.0008, 2
"""Scale and rounds of the fits' Cauchy weights."""
FLAT_M = 0.0012
"""Ends of the paint within this distance of the surface around the rim tell the width of the band."""
MIN_REACH = 0.6
"""Rims from which the paint extends less than this share of the band's width are those of patches and shadows."""
REACH_ALONG = 0.75
"""Widths of the band to both sides along the rim in which that is looked for."""
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
class _Sheets:
    """At every point of the rim, `height = offset + slope * outward`: the surface straight ahead."""

    origin: Float64[np.ndarray, "rim 3"]
    outward: Float64[np.ndarray, "rim 3"]
    normal: Float64[np.ndarray, "rim 3"]
    offset: Float64[np.ndarray, " rim"]
    slope: Float64[np.ndarray, " rim"]

    def beyond(self, distance: float) -> Float64[np.ndarray, "rim 3"]:
        """Points on the surface so far from the rim."""
        along = distance / np.hypot(1, self.slope)
        height = self.offset + self.slope * along
        return self.origin + along[:, None] * self.outward + height[:, None] * self.normal

    def coordinates(self, points: np.ndarray, rim: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far points are from the rim points `rim` along the surface, and how far off it."""
        offset = points - self.origin[rim]
        along = np.einsum("pi,pi->p", offset, self.outward[rim])
        height = np.einsum("pi,pi->p", offset, self.normal[rim]) - self.offset[rim] - self.slope[rim] * along
        return along * np.hypot(1, self.slope[rim]), height


def border_beyond_rim(
    mesh: Mesh, garment: Bool[np.ndarray, " verts"], painted: Bool[np.ndarray, " verts"]
) -> Float64[np.ndarray, "points 3"]:
    """Points on the border beyond a painted band of even width: one for each edge from garment to paint, but for those
    where the two fits disagree.

    Args:
        mesh: a scan that goes on beyond the border.
        garment, painted: its vertices of garment colour, and of one paint.
    """
    strip = _strip(mesh, garment, painted)
    if strip is None or len(strip.ends) < 3:
        return np.zeros((0, 3))
    rough = float(np.median(strip.ends_distance))
    width = _width(strip, _sheets(strip, rough, AROUND_RIM), rough)
    said, checked = (_sheets(strip, width, part).beyond(width) for part in (WHOLE_BAND, AROUND_RIM))
    agreed = np.linalg.norm(said - checked, axis=1) < AGREED_M
    return said[agreed & (_reach(strip, REACH_ALONG * width) >= MIN_REACH * width)]


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


def _sheets(strip: _Strip, width_m: float, part: tuple[float, float]) -> _Sheets:
    """Surfaces fitted to what is nearest to each piece of the rim.

    Args:
        part: one of AROUND_RIM, WHOLE_BAND.
    """
    reach = AVERAGED * width_m
    origin = straighten(strip.rim, width_m)
    count = len(origin)
    along = _along(origin, 0.75 * width_m)
    back, ahead = part
    sound = np.flatnonzero((strip.distance > -back * width_m) & (strip.distance < ahead * width_m))
    links = KDTree(origin).sparse_distance_matrix(
        KDTree(strip.rim[strip.nearest[sound]]), reach, output_type="coo_matrix"
    )
    row, point = links.row, sound[links.col]
    offset = strip.positions[point] - origin[row]
    a = np.einsum("pi,pi->p", offset, along[row])
    near = np.exp(-2 * (links.data / reach) ** 2)
    across = (offset - a[:, None] * along[row]) * strip.distance[point][:, None]
    outward = _summed(across, near, row, count)
    outward /= np.maximum(np.linalg.norm(outward, axis=1), 1e-12)[:, None]
    normal = np.cross(along, outward)
    b, height = (np.einsum("pi,pi->p", offset, axis[row]) for axis in (outward, normal))
    bent = np.maximum(strip.distance[point] / width_m - BENT_FROM, 0) / (1 - BENT_FROM)
    weight = near / (1 + BENT_M / NOISE_M * bent) ** 2
    terms = np.column_stack([np.ones(len(row)), a / width_m, b / width_m, (a / width_m) ** 2, a * b / width_m**2])
    spread = CURVATURE * width_m**2  # of c4 in these units; half of it is that of c3
    prior = np.diag(CORRELATED * (NOISE_M * np.array([0, 0, 0, 2 / spread, 1 / spread])) ** 2 + 1e-9)
    robust = weight
    for _ in range(1 + ROUNDS):
        square = _summed(terms[:, :, None] * terms[:, None, :], robust, row, count).reshape(-1, 5, 5)
        right = _summed(terms * height[:, None], robust, row, count)
        fitted = np.linalg.solve(square + prior, right[:, :, None])[:, :, 0]
        residual = height - np.einsum("pi,pi->p", terms, fitted[row])
        robust = weight / (1 + (residual / OUTLIER_M) ** 2)
    return _Sheets(origin, outward, normal, offset=fitted[:, 0], slope=fitted[:, 2] / width_m)


def _along(points: np.ndarray, reach_m: float) -> Float64[np.ndarray, "points 3"]:
    """The direction of a curve at each of its points."""
    tree, count = KDTree(points), len(points)
    links = tree.sparse_distance_matrix(tree, reach_m, output_type="coo_matrix")
    offset, weight = points[links.col] - points[links.row], np.exp(-2 * (links.data / reach_m) ** 2)
    middle = _summed(offset, weight, links.row, count) / _summed(np.ones(len(weight)), weight, links.row, count)
    offset -= middle[links.row]
    spread = _summed(offset[:, :, None] * offset[:, None, :], weight, links.row, count)
    return np.linalg.eigh(spread.reshape(-1, 3, 3))[1][:, :, 2]


def _summed(values: np.ndarray, weight: np.ndarray, row: np.ndarray, count: int) -> np.ndarray:
    """Weighted sums of the values of each row, (count, ...) flattened to two axes."""
    gather = sparse.csr_array((weight, (row, np.arange(len(row)))), (count, len(row)))
    return gather @ values.reshape(len(row), -1)


def _width(strip: _Strip, sheets: _Sheets, rough_m: float) -> float:
    along, height = sheets.coordinates(strip.ends, strip.ends_nearest)
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
