"""What the template is matched to: the scan's surface, smoothed once, with normals and its points sorted for searching.

A template vertex is matched to its nearest scan vertex and measured against the plane there. With 2-3 mm between scan
vertices that is as good as the closest point of the triangles and half the time; matches on the rims of holes are kept,
because a plane continues sensibly into a hole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Integer
from scipy import sparse
from scipy.spatial import KDTree

from capture4d.geometry.mesh_kernels import laplacian_pass, mean_edge_length, open_vertices, vertex_normals_kernel
from capture4d.geometry.point_grid import PointGrid

__all__ = ["Gates", "Matches", "ScanSurface", "match", "match_both_ways", "mesh_normals", "prepare_scan"]


SECOND_LAYER = 2.0
"""A vertex whose nearest scan vertex looks another way may take one so many scan spacings beside it that does not."""
OUTWARDS = 1.06
"""Of the pass outwards, beside 1 of the one inwards: what Taubin's filter has for a pass band of 0.1."""
CELL_SPACINGS = 3.0
"""Edge of a search cell in scan spacings: some nine points in each cell that the surface passes through."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanSurface:
    """A scan ready to be matched against."""

    points: Float64[np.ndarray, "points 3"]
    """Smoothed vertices, metres."""
    normals: Float64[np.ndarray, "points 3"]
    """Unit normals."""
    grid: PointGrid
    spacing: float
    """Mean edge length, metres: what the scan resolves."""
    used: Bool[np.ndarray, " vertices"] | None = None
    """The scan's vertices that are its points, those with faces; None if all are."""

    def of_points(self, values: np.ndarray) -> np.ndarray:
        """Of values of the scan's vertices, those of its points."""
        return values if self.used is None else values[self.used]


@dataclass(frozen=True, slots=True)
class Gates:
    """Which matches count, and how much."""

    distance: float
    """Largest, metres."""
    normal_cosine: float
    """Least, between the normals of the point and of the scan."""
    robust_scale: float
    """Scale of the weight (1 + (d/s)^2)^-2 as a share of the largest distance."""

    def weigh(
        self, away: Float64[np.ndarray, " queries"], closed: Bool[np.ndarray, " queries"]
    ) -> Float64[np.ndarray, " queries"]:
        """Geman-McClure weights of residuals, metres; 0 where the gates are closed."""
        weights = 1.0 / (1.0 + (away / (self.robust_scale * self.distance)) ** 2) ** 2
        weights[closed] = 0.0
        return weights


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """One matched plane per query point."""

    points: Float64[np.ndarray, "queries 3"]
    normals: Float64[np.ndarray, "queries 3"]
    weights: Float64[np.ndarray, " queries"]
    """0 where the gates reject the match."""


def prepare_scan(
    vertices: Float[np.ndarray, "points 3"],
    faces: Integer[np.ndarray, "faces 3"],
    *,
    smoothing_passes: int,
    unshrunk: bool = False,
) -> ScanSurface:
    """Smooth the scan, take normals and sort the points for searching; vertices without faces are dropped.

    Args:
        smoothing_passes: Laplacian passes at half step; open edges stay where they are.
        unshrunk: each pass is followed by one outwards, which gives back what round limbs lost.
    References: Taubin 1995 (a signal processing approach to fair surface design), for the second pass.
    """
    positions = np.ascontiguousarray(vertices, np.float64)
    triangles = np.ascontiguousarray(faces, np.int32)
    rim, used = open_vertices(triangles, len(positions))
    for _ in range(smoothing_passes):
        positions = laplacian_pass(positions, triangles, rim)
        if unshrunk:
            positions = positions + OUTWARDS * (positions - laplacian_pass(positions, triangles, rim))
    normals = vertex_normals_kernel(positions, triangles)
    spacing = float(mean_edge_length(positions, triangles))
    if not used.all():
        positions, normals = positions[used], normals[used]
    grid = PointGrid.build(positions, CELL_SPACINGS * spacing)
    return ScanSurface(positions, normals, grid, spacing, None if used.all() else used)


def mesh_normals(
    vertices: Float64[np.ndarray, "verts 3"], faces: Integer[np.ndarray, "faces 3"]
) -> Float64[np.ndarray, "verts 3"]:
    """Area-weighted unit vertex normals in float64: `capture4d.geometry.mesh.vertex_normals` at a tenth of the time."""
    return vertex_normals_kernel(np.ascontiguousarray(vertices, np.float64), faces)


def match(
    surface: ScanSurface,
    points: Float64[np.ndarray, "queries 3"],
    normals: Float64[np.ndarray, "queries 3"],
    gates: Gates,
    *,
    of_both: bool = False,
) -> Matches:
    """Nearest scan vertex of each point, gated in distance and normal, with Geman-McClure weights.

    A point whose nearest scan vertex looks another way, as on two layers of cloth, takes the nearest that does not, if
    there is one close beside it. Weights are by the distance along the scan's normal.

    Args:
        of_both: planes have the mean of the scan's normal and the point's own.
    References: Rusinkiewicz 2019 (a symmetric objective function for ICP), for the mean.
    """
    distances, indices = surface.grid.query(points, gates.distance)
    found = indices < len(surface.points)
    nearest = np.where(found, indices, 0)
    cosine = np.einsum("va,va->v", normals, surface.normals[nearest])
    turned = np.flatnonzero(found & (cosine < gates.normal_cosine))
    bounds = np.minimum(np.hypot(distances[turned], SECOND_LAYER * surface.spacing), gates.distance)
    further, others = surface.grid.query_facing(
        points[turned], normals[turned], bounds, surface.normals, gates.normal_cosine
    )
    better = np.isfinite(further)
    changed = turned[better]
    nearest[changed] = others[better]
    cosine[changed] = np.einsum("va,va->v", normals[changed], surface.normals[nearest[changed]])
    target, target_normal = surface.points[nearest], surface.normals[nearest]
    off_plane = np.einsum("va,va->v", points - target, target_normal)
    weights = gates.weigh(off_plane, ~found | (cosine < gates.normal_cosine))
    if of_both:
        mean = target_normal + normals
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        target_normal = np.where(length > 1e-6, mean / np.maximum(length, 1e-6), target_normal)
    return Matches(target, target_normal, weights)


def of_another_part(
    targets: Float64[np.ndarray, "queries 3"],
    distances: Float64[np.ndarray, " queries"],
    own: Integer[np.ndarray, " queries"],
    vertices: Float64[np.ndarray, "verts 3"],
    rest: Float64[np.ndarray, "verts 3"],
    *,
    share: float,
    reach: float,
) -> Bool[np.ndarray, " queries"]:
    """Whether what was found for a template vertex is the scan of another part of the template.

    Where a sleeve hides the side of a shirt, the scan nearest to the hidden cloth is the sleeve's: some vertex of the
    sleeve lies nearer to it, and far from the hidden vertex on the template.

    Args:
        targets: scan points that were found.
        distances: from each vertex to what was found for it, metres.
        own: the vertices they were found for.
        vertices: of the whole template, as it lies.
        rest: the same at rest, metres.
        share: the other part is nearer than this share of the distance.
        reach: parts of the template lie at least so far from each other at rest, metres.
    """
    foreign = np.zeros(len(own), bool)
    doubtful = np.flatnonzero(distances > 0.0)
    if not len(doubtful):
        return foreign
    nearer, owner = PointGrid.build(vertices, reach).query(targets[doubtful])
    apart = np.linalg.norm(rest[owner] - rest[own[doubtful]], axis=1)
    foreign[doubtful] = (nearer < share * distances[doubtful]) & (apart > reach)
    return foreign


def match_both_ways(
    surface: ScanSurface,
    points: Float64[np.ndarray, "queries 3"],
    normals: Float64[np.ndarray, "queries 3"],
    gates: Gates,
    *,
    neighbours: int,
    max_points: int,
    normal_length: float,
) -> Matches:
    """Soft matches in which the scan has a say: nearest scan points of each point, nearest points of each scan point.

    Both lists of nearest neighbours, in position and normal, are weighed by inverse squared distance, made to sum to
    one per voter, and added; the matched plane is their weighted mean. Scan that sticks out beyond the template's edge
    pulls that edge outwards, which one-way matching never does.

    Args:
        neighbours: nearest neighbours either way.
        max_points: the scan is thinned to this many voters.
        normal_length: distance that a normal turned by 60 degrees counts as, metres.
    References: MeshMonk (White et al. 2019), symmetric weighted correspondences.
    """
    stride = max(1, -(-len(surface.points) // max_points))
    voters = np.arange(0, len(surface.points), stride)
    scan_features = np.concatenate([surface.points[voters], normal_length * surface.normals[voters]], axis=1)
    features = np.concatenate([points, normal_length * normals], axis=1)
    pull_distance, pull = KDTree(scan_features, balanced_tree=False).query(features, k=neighbours)
    push_distance, push = KDTree(features, balanced_tree=False).query(scan_features, k=neighbours)
    rows = np.concatenate([np.repeat(np.arange(len(points)), neighbours), push.reshape(-1)])
    columns = np.concatenate([pull.reshape(-1), np.repeat(np.arange(len(voters)), neighbours)])
    affinity = np.concatenate([_affinity(pull_distance).reshape(-1), _affinity(push_distance).reshape(-1)])
    mixing = sparse.csr_array((affinity, (rows, columns)), shape=(len(points), len(voters)))
    mixing = sparse.diags_array(1.0 / np.asarray(mixing.sum(axis=1)).ravel()) @ mixing
    target = mixing @ surface.points[voters]
    normal = mixing @ surface.normals[voters]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    away = np.linalg.norm(points - target, axis=1)
    turned = np.einsum("va,va->v", normals, normal) < gates.normal_cosine
    return Matches(target, normal, gates.weigh(away, (away > gates.distance) | turned))


def _affinity(distance: np.ndarray) -> np.ndarray:
    weight = 1.0 / np.maximum(distance, 1e-9) ** 2
    return weight / weight.sum(axis=1, keepdims=True)
