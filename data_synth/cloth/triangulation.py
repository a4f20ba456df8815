"""A polygon of the pattern cut into triangles of one size; and panels that are meshed as each other's mirror images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import Delaunay, KDTree

from data_synth.cloth.panels import Pattern, mirrored_name

__all__ = ["mirrored_vertices", "triangulate", "triangulate_mirrored"]

MIRROR = np.array([-1.0, 1.0])
COINCIDE_M = 1e-6
"""Points of a panel and of its mirror image that are as near are the same."""


def triangulate(boundary: np.ndarray, spacing: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Delaunay triangles of a polygon; its vertices come first and all its edges are kept.

    No inner point lies in the diametral circle of a boundary edge, so the Delaunay triangulation holds each edge.
    """
    low, high = boundary.min(axis=0), boundary.max(axis=0)
    rows = np.arange(low[1], high[1], spacing * np.sqrt(3) / 2)
    columns = np.arange(low[0], high[0] + spacing, spacing)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    grid[1::2, :, 0] += spacing / 2
    grid = grid.reshape(-1, 2)
    grid = grid + rng.uniform(-0.18, 0.18, grid.shape) * spacing
    fractions = np.linspace(0, 1, 8, endpoint=False)[:, None, None]
    dense = (boundary * (1 - fractions) + np.roll(boundary, -1, axis=0) * fractions).reshape(-1, 2)
    grid = grid[_inside(grid, boundary)]
    clear, _ = KDTree(dense).query(grid, distance_upper_bound=0.6 * spacing)
    points = np.concatenate([boundary, grid[np.isinf(clear)]])
    faces = Delaunay(points).simplices
    a, b, c = points[faces].transpose(1, 0, 2)
    u, v = b - a, c - a
    doubled_area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    faces[doubled_area < 0] = faces[doubled_area < 0][:, ::-1]
    solid = np.abs(doubled_area) > 1e-3 * spacing**2  # not a sliver of collinear outline points
    return points, faces[solid & _inside(points[faces].mean(axis=1), boundary)]


def _inside(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """Even-odd rule, (N,) bool."""
    inside = np.zeros(len(points), bool)
    x, y = points.T
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y0 != y1:
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def triangulate_mirrored(
    pattern: Pattern, boundaries: Sequence[np.ndarray], spacing: float, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points and triangles of every panel, as `triangulate` makes them, of a garment whose left is its right mirrored.

    A panel across the body's middle is cut in half and its other half is the mirror image; of a pair of panels, left
    and right, the second is that of the first.

    Args:
        boundaries: polygon of each panel, with a point wherever it crosses the panel's own middle.
    """
    done: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for panel, boundary in zip(pattern.panels, boundaries, strict=True):
        local, other = boundary - panel.origin, mirrored_name(panel.name)
        if other == panel.name:
            points, faces = _halved(local, spacing, rng)
        elif other in done:
            points, faces = _in_order(local, done[other][0] * MIRROR, done[other][1][:, ::-1])
        else:
            points, faces = triangulate(local, spacing, rng)
        done[panel.name] = points, faces
    return [(done[panel.name][0] + panel.origin, done[panel.name][1]) for panel in pattern.panels]


def _halved(boundary: np.ndarray, spacing: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a polygon that is its own mirror image about u = 0; its vertices come first."""
    on_axis = np.flatnonzero(np.abs(boundary[:, 0]) < COINCIDE_M)
    assert len(on_axis) == 2, f"the outline crosses its middle at {len(on_axis)} points"
    low, high = on_axis[np.argsort(boundary[on_axis, 1])]
    side = np.roll(boundary, -low, axis=0)[: (high - low) % len(boundary) + 1]  # counter-clockwise: up the +u side
    side[[0, -1], 0] = 0.0
    steps = max(1, round((side[-1, 1] - side[0, 1]) / spacing))
    axis = np.linspace(side[-1], side[0], steps + 1)[1:-1]
    points, faces = triangulate(np.concatenate([side, axis]), spacing, rng)
    return _in_order(
        boundary, np.concatenate([points, points * MIRROR]), np.concatenate([faces, faces[:, ::-1] + len(points)])
    )


def _in_order(boundary: np.ndarray, points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same triangles with the vertices of the polygon first, in its order, and every point once."""
    distance, _ = KDTree(boundary).query(points)
    inner = points[distance > COINCIDE_M]
    kept = inner[_first_of_each(inner)]
    everything = np.concatenate([boundary, kept])
    return everything, np.asarray(KDTree(everything).query(points)[1])[faces]


def _first_of_each(points: np.ndarray) -> np.ndarray:
    """Rows of points that are not within `COINCIDE_M` of an earlier one."""
    again = KDTree(points).query_pairs(COINCIDE_M, output_type="ndarray") if len(points) else np.zeros((0, 2), int)
    return np.setdiff1d(np.arange(len(points)), again.max(axis=1, initial=-1))


def mirrored_vertices(pattern: Pattern, panels: np.ndarray, points: np.ndarray) -> np.ndarray:
    """For each point of the plane domain its mirror image's row, (N,): of the panel on the other side.

    Args:
        panels: (N,) the panel of each point.
        points: (N, 2) metres.
    """
    names = [panel.name for panel in pattern.panels]
    result = np.empty(len(points), np.int64)
    for index, panel in enumerate(pattern.panels):
        other = names.index(mirrored_name(panel.name))
        rows, images = np.flatnonzero(panels == index), np.flatnonzero(panels == other)
        wanted = (points[rows] - panel.origin) * MIRROR + pattern.panels[other].origin
        distance, at = KDTree(points[images]).query(wanted)
        assert distance.max() < COINCIDE_M, "the panels are not each other's mirror images"
        result[rows] = images[at]
    return result
