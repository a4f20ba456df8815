"""How long the template's edges may be where the scan is folded finer than the template.

Cloth hardly stretches, so an edge that crosses small folds is shorter than the cloth beneath it. How much shorter can
be seen: over the chord, the scan's surface rises and falls with a slope s, and its arc is longer than the chord by
sqrt(1 + mean s^2). The scan's normals around a face give the second moments of the slope against the face's plane,
S = mean of s s^T, and for an edge of direction d

    arc / chord = sqrt(1 + d^T S d).

Edges are then held to (length on the pattern) * chord / arc instead of an unfolded length that they cannot have. That
keeps the template from creeping along the cloth. The idea is ours; the papers hold edges to the template's lengths.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int32

from capture4d.geometry.mesh import edges_of_faces
from capture4d.geometry.point_grid import PointGrid
from capture4d.heavy_imports import njit
from registration.correspondences import ScanSurface

__all__ = ["edge_faces", "folded_lengths"]

MAX_POINTS = 40_000
"""Scan points that are looked at: four to a face of a template of 5,000 vertices."""
REACH = 1.2
"""Scan points farther from a face's centre than this many mean edges belong to no face."""
MIN_COSINE = 0.35
"""Normals that lean farther from the face's show another layer."""
MIN_POINTS = 3
"""With fewer scan points beside an edge nothing is known of its folds, and it keeps its length."""


def edge_faces(
    faces: Int32[np.ndarray, "faces 3"], edges: Int32[np.ndarray, "edges 2"]
) -> Int32[np.ndarray, "edges 2"]:
    """The faces on both sides of each edge; on the border the one face twice.

    Args:
        edges: unique and in ascending order, as `capture4d.geometry.mesh.unique_edges` returns them.
    """
    edge = edges_of_faces(faces, edges).reshape(-1)
    order = np.argsort(edge, kind="stable")
    first = np.searchsorted(edge[order], np.arange(len(edges)))
    last = np.searchsorted(edge[order], np.arange(len(edges)), side="right") - 1
    return np.column_stack([order[first] // 3, order[last] // 3]).astype(np.int32)


def folded_lengths(
    surface: ScanSurface,
    vertices: Float64[np.ndarray, "verts 3"],
    faces: Int32[np.ndarray, "faces 3"],
    edges: Int32[np.ndarray, "edges 2"],
    faces_of_edges: Int32[np.ndarray, "edges 2"],
    rest_lengths: Float64[np.ndarray, " edges"],
) -> Float64[np.ndarray, " edges"]:
    """Rest lengths, metres, shortened by the folds that the scan shows around each edge.

    Args:
        vertices: the template near its place on the scan.
        faces_of_edges: from `edge_faces`.
    """
    stride = max(1, len(surface.points) // MAX_POINTS)
    points, normals = surface.points[::stride], surface.normals[::stride]
    centres = vertices[faces].mean(axis=1)
    reach = REACH * float(rest_lengths.mean())
    _, face = PointGrid.build(centres, reach).query(points, reach)
    moments, counts = slope_moments(vertices, faces, face, normals, MIN_COSINE)
    return shortened(vertices, edges, faces_of_edges, rest_lengths, moments, counts, MIN_POINTS)


@njit(cache=True)
def slope_moments(vertices, faces, face_of_point, normals, min_cosine):
    """Sums of s s^T over the points of each face, (F, 3, 3), and their numbers; points of no face have index F."""
    moments, counts = np.zeros((len(faces), 3, 3)), np.zeros(len(faces), np.int64)
    planes = np.zeros((len(faces), 3))
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        x = (b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1])
        y = (b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2])
        z = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        size = np.sqrt(x * x + y * y + z * z)
        if size > 0.0:
            planes[f, 0], planes[f, 1], planes[f, 2] = x / size, y / size, z / size
    slope = np.zeros(3)
    for p in range(len(face_of_point)):
        f = face_of_point[p]
        if f >= len(faces):
            continue
        cosine = normals[p, 0] * planes[f, 0] + normals[p, 1] * planes[f, 1] + normals[p, 2] * planes[f, 2]
        if cosine < min_cosine:
            continue
        for i in range(3):
            slope[i] = normals[p, i] / cosine - planes[f, i]
        counts[f] += 1
        for i in range(3):
            for j in range(3):
                moments[f, i, j] += slope[i] * slope[j]
    return moments, counts


@njit(cache=True)
def shortened(vertices, edges, faces_of_edges, rest_lengths, moments, counts, min_points):
    """rest / sqrt(1 + d^T S d), S from the faces on both sides of the edge."""
    result = rest_lengths.copy()
    direction = np.zeros(3)
    for e in range(len(edges)):
        length = 0.0
        for i in range(3):
            direction[i] = vertices[edges[e, 1], i] - vertices[edges[e, 0], i]
            length += direction[i] ** 2
        first, second = faces_of_edges[e, 0], faces_of_edges[e, 1]
        seen = counts[first] + counts[second]
        if seen < min_points or length == 0.0:
            continue
        total = 0.0
        for i in range(3):
            for j in range(3):
                total += direction[i] * direction[j] * (moments[first, i, j] + moments[second, i, j])
        result[e] = rest_lengths[e] / np.sqrt(1.0 + total / (length * seen))
    return result
