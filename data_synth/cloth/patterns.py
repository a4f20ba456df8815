"""Meshes of a sewing pattern, welded along its seams, and what is known of a point of cloth by its place on it.

The pattern is a plane domain in metres, one outline per panel, laid out side by side. Every mesh of the garment, the
coarse simulated one, the fine wrinkled one and the registration template, triangulates the same domain, so a point of
cloth is a UV, and a map between two meshes is a point location in the plane.

Letters: panel coordinates (u, v) in metres; u across the body, v along the grain, up. Seams join panel edges sampled at
equal fractions of arc length, so that vertices of both sides coincide one to one and are welded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from capture4d.geometry.mesh import boundary_loops
from data_synth.cloth.panels import Edge, Pattern, curve_length, polygon_area, resample
from data_synth.cloth.triangulation import mirrored_vertices, triangulate, triangulate_mirrored

__all__ = ["PanelMesh", "grade", "locate", "mesh_pattern", "smooth_noise"]

NOISE_PIXEL_M = 0.003
GRADE_SEGMENTS = 40
"""Sides of each edge of a panel for grading."""
ON_OUTLINE_M = 5e-4
"""Nearer than this to the outline a point lies on it: curves are cut into straight sides."""


@dataclass(frozen=True, slots=True, eq=False)
class PanelMesh:
    """A triangulated pattern with its seams welded."""

    faces: np.ndarray
    """(F, 3) int32, counter-clockwise seen from outside the garment."""
    uv: np.ndarray
    """(F, 3, 2) float64 plane coordinates per face corner, metres."""
    face_panels: np.ndarray
    """(F,) index of the panel of each face."""
    vertex_uv: np.ndarray
    """(V, 2) plane coordinates of each vertex; at a seam, those of the panel that comes first."""
    vertex_faces: np.ndarray
    """(V,) a face of that panel that holds the vertex."""
    loops: Mapping[str, np.ndarray]
    """Border loops: vertex indices in order."""
    seams: Mapping[str, np.ndarray]
    """Vertices along each seam."""
    drafted_uv: np.ndarray | None = None
    """(V, 2) `vertex_uv` before the pattern was graded to somebody else."""
    mirror: np.ndarray | None = None
    """(V,) the mirror image of each vertex, on the body's other side; None where the mesh is not symmetric."""

    @property
    def noise_uv(self) -> np.ndarray:
        """(V, 2) where the cloth's irregularities are drawn: grading moves them along."""
        return self.vertex_uv if self.drafted_uv is None else self.drafted_uv

    @property
    def vertex_count(self) -> int:
        """Number of welded vertices."""
        return len(self.vertex_uv)


def mesh_pattern(
    pattern: Pattern, vertex_count: int, rng: np.random.Generator, *, symmetric: bool = False
) -> PanelMesh:
    """Triangulate every panel at one edge length and weld the seams.

    A jittered hexagonal grid inside, equal arc-length samples along the outline, Delaunay, clipped to the panel.

    Args:
        vertex_count: wanted number of vertices; met to a few percent.
        rng: jitters the grid, so that two seeds give two connectivities.
        symmetric: the triangles of the body's left are those of its right, mirrored.
    """
    outlines = [np.concatenate([edge.curve for edge in panel.edges]) for panel in pattern.panels]
    area = sum(polygon_area(outline) for outline in outlines)
    spacing = np.sqrt(2 * area / (np.sqrt(3) * vertex_count))
    segments = _segments(pattern, spacing, symmetric=symmetric)
    boundaries = [
        np.concatenate([resample(edge.curve, segments[edge.name])[:-1] for edge in panel.edges])
        for panel in pattern.panels
    ]
    triangulated = (
        triangulate_mirrored(pattern, boundaries, spacing, rng)
        if symmetric
        else [triangulate(boundary, spacing, rng) for boundary in boundaries]
    )
    points, faces, face_panels, point_panels, offset = [], [], [], [], 0
    edge_vertices: dict[str, list[np.ndarray]] = {}
    for index, (panel_points, panel_faces) in enumerate(triangulated):
        start = 0
        for edge in pattern.panels[index].edges:
            ids = offset + (start + np.arange(segments[edge.name] + 1)) % len(boundaries[index])
            edge_vertices.setdefault(edge.name, []).append(ids[::-1] if edge.reverse else ids)
            start += segments[edge.name]
        points.append(panel_points)
        faces.append(panel_faces + offset)
        face_panels.append(np.full(len(panel_faces), index))
        point_panels.append(np.full(len(panel_points), index))
        offset += len(panel_points)
    plane, corners = np.concatenate(points), np.concatenate(faces)

    sewn = [np.stack(sides, axis=1) for sides in edge_vertices.values() if len(sides) == 2]
    pairs = np.concatenate([np.zeros((0, 2), int), *sewn])
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(offset, offset))
    _, welded = connected_components(graph, directed=False)
    _, first, welded = np.unique(welded, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))  # number vertices by their first appearance
    welded = order[welded]
    first = np.sort(first)
    panel_faces = np.concatenate(face_panels)
    some_face = np.empty(offset, np.int64)
    some_face[corners.ravel()] = np.repeat(np.arange(len(corners)), 3)
    loops: dict[str, np.ndarray] = {}
    for loop in boundary_loops(welded[corners].astype(np.int32)):
        members = set(loop.tolist())
        names = {
            name.split("|")[0]
            for name, sides in edge_vertices.items()
            if "|" in name and all(int(v) in members for v in welded[sides[0]])
        }
        assert len(names) == 1, f"an open loop belongs to {sorted(names)}"
        loops[names.pop()] = loop
    assert set(loops) == set(pattern.borders), f"the pattern leaves {sorted(loops)} open"
    return PanelMesh(
        faces=welded[corners].astype(np.int32),
        uv=plane[corners],
        face_panels=panel_faces,
        vertex_uv=plane[first],
        vertex_faces=some_face[first],
        loops={name: loops[name] for name in pattern.borders},
        seams={name: welded[sides[0]] for name, sides in edge_vertices.items() if len(sides) == 2},
        mirror=welded[mirrored_vertices(pattern, np.concatenate(point_panels), plane)[first]] if symmetric else None,
    )


def _segments(pattern: Pattern, spacing: float, *, symmetric: bool) -> dict[str, int]:
    """Into how many sides the edges of each name are cut."""
    lengths: dict[str, list[float]] = {}
    across: set[str] = set()
    for panel in pattern.panels:
        for edge in panel.edges:
            lengths.setdefault(edge.name, []).append(curve_length(edge.curve))
            if symmetric and _crosses_middle(edge, panel.origin):
                across.add(edge.name)
    cut = {name: max(1, round(float(np.mean(each)) / spacing)) for name, each in lengths.items()}
    return {name: count + count % 2 if name in across else count for name, count in cut.items()}


def _crosses_middle(edge: Edge, origin: np.ndarray) -> bool:
    """Whether an edge lies on both sides of its panel's middle, and so needs a vertex on it."""
    u = edge.curve[:, 0] - origin[0]
    return bool(u.min() < -1e-6 and u.max() > 1e-6)


def grade(mesh: PanelMesh, drafted: Pattern, graded: Pattern) -> PanelMesh:
    """The same triangles on the pattern drafted for somebody else: outlines go to outlines, at equal arc length.

    Inside, mean value coordinates (Floater, 2003) carry the vertices along; they reproduce affine maps.
    """
    uv, vertex_uv = np.empty_like(mesh.uv), np.empty_like(mesh.vertex_uv)
    vertex_panels = mesh.face_panels[mesh.vertex_faces]
    for index, (start, end) in enumerate(zip(drafted.panels, graded.panels, strict=True)):
        outlines = [
            np.concatenate([resample(edge.curve, GRADE_SEGMENTS)[:-1] for edge in panel.edges])
            for panel in (start, end)
        ]
        faces, vertices = mesh.face_panels == index, vertex_panels == index
        points, where = np.unique(mesh.uv[faces].reshape(-1, 2), axis=0, return_inverse=True)
        uv[faces] = _carried(points, *outlines)[where.ravel()].reshape(-1, 3, 2)
        vertex_uv[vertices] = _carried(mesh.vertex_uv[vertices], *outlines)
    return replace(mesh, uv=uv, vertex_uv=vertex_uv, drafted_uv=mesh.vertex_uv)


def _carried(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Points (N, 2) inside the polygon `start`, (P, 2), in the polygon `end`, by mean value coordinates."""
    result = np.empty_like(points)
    along = np.roll(start, -1, axis=0) - start
    for chunk in np.array_split(np.arange(len(points)), len(points) * len(start) // 2_000_000 + 1):
        spokes = start - points[chunk, None]
        radius = np.maximum(np.linalg.norm(spokes, axis=2), 1e-12)
        after, after_radius = np.roll(spokes, -1, axis=1), np.roll(radius, -1, axis=1)
        cross = spokes[..., 0] * after[..., 1] - spokes[..., 1] * after[..., 0]
        dot = np.einsum("npx,npx->np", spokes, after)
        half_tangent = cross / np.maximum(radius * after_radius + dot, 1e-15)
        weights = (half_tangent + np.roll(half_tangent, 1, axis=1)) / radius
        inner = (weights @ end) / weights.sum(axis=1, keepdims=True)
        # On the outline the coordinates are those along its side.
        share = np.clip(-np.einsum("npx,px->np", spokes, along) / np.einsum("px,px->p", along, along), 0, 1)
        distance = np.linalg.norm(spokes + share[..., None] * along, axis=2)
        side, rows = np.argmin(distance, axis=1), np.arange(len(chunk))
        part = share[rows, side][:, None]
        border = (1 - part) * end[side] + part * np.roll(end, -1, axis=0)[side]
        result[chunk] = np.where((distance[rows, side] < ON_OUTLINE_M)[:, None], border, inner)
    return result


def locate(mesh: PanelMesh, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find plane points in a triangulation of the same pattern.

    Returns:
        Faces (N,) int32 and barycentric coordinates (N, 3) float64. A point just outside, behind the chord of a curved
        edge, gets the nearest face and slightly negative coordinates, which extrapolate.
    """
    candidates = np.asarray(KDTree(mesh.uv.mean(axis=1)).query(uv, k=12)[1])
    a, b, c = (mesh.uv[candidates, corner] for corner in range(3))
    u, v, w = b - a, c - a, uv[:, None] - a
    area = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    second = (w[..., 0] * v[..., 1] - w[..., 1] * v[..., 0]) / area
    third = (u[..., 0] * w[..., 1] - u[..., 1] * w[..., 0]) / area
    barycentric = np.stack([1 - second - third, second, third], axis=-1)
    best = np.argmax(barycentric.min(axis=-1), axis=1)
    rows = np.arange(len(uv))
    return candidates[rows, best].astype(np.int32), barycentric[rows, best]


def smooth_noise(
    uv: np.ndarray, amplitude_m: float, width_m: tuple[float, float], rng: np.random.Generator
) -> np.ndarray:
    """Gaussian noise on the plane domain at some of its points, (N,) float32 metres.

    Args:
        uv: (N, 2) metres.
        amplitude_m: standard deviation.
        width_m: of the bumps, across and along the grain. Cloth folds along its grain under its own weight; noise that
            is as short along as across gives lumps.
    """
    low, high = uv.min(axis=0) - NOISE_PIXEL_M, uv.max(axis=0) + NOISE_PIXEL_M
    shape = np.ceil((high - low) / NOISE_PIXEL_M).astype(int) + 1
    noise = gaussian_filter(rng.standard_normal(shape), np.array(width_m) / NOISE_PIXEL_M, mode="wrap")
    values = map_coordinates(noise / noise.std(), ((uv - low) / NOISE_PIXEL_M).T, order=1)
    return (amplitude_m * values).astype(np.float32)
