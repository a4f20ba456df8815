"""Edge lengths under folds: against corrugated sheets whose arc lengths are known."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.geometry.mesh import unique_edges
from capture4d.geometry.point_grid import PointGrid
from registration.correspondences import ScanSurface
from registration.fold_lengths import edge_faces, folded_lengths


def _sheet(size: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    column, row = np.meshgrid(np.arange(size), np.arange(size))
    vertices = np.column_stack([column.ravel() * spacing, row.ravel() * spacing, np.zeros(size * size)])
    a = (row[:-1, :-1] * size + column[:-1, :-1]).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + size + 1], 1), np.stack([a, a + size + 1, a + size], 1)])
    return vertices, faces.astype(np.int32)


def _corrugated(amplitude: float, wavelength: float, extent: float, tilt: np.ndarray) -> ScanSurface:
    """z = A sin(2 pi x / L), turned by `tilt`."""
    x, y = np.meshgrid(np.arange(0.0, extent, 0.001), np.arange(0.0, extent, 0.002))
    x, y = x.ravel(), y.ravel()
    k = 2 * np.pi / wavelength
    normals = np.column_stack([-amplitude * k * np.cos(k * x), np.zeros(len(x)), np.ones(len(x))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.column_stack([x, y, amplitude * np.sin(k * x)]) @ tilt.T
    return ScanSurface(points, normals @ tilt.T, PointGrid.build(points, 0.003), 0.001)


@pytest.mark.parametrize("amplitude", [0.0, 0.0005, 0.001])
def test_edges_across_folds_shorten_by_the_arc_and_edges_along_them_keep_their_length(amplitude: float) -> None:
    turn = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    vertices, faces = _sheet(12, 0.01)
    edges = unique_edges(faces)
    along = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    rest = np.linalg.norm(along, axis=1)
    surface = _corrugated(amplitude, 0.01, 0.11, turn)
    found = folded_lengths(surface, vertices @ turn.T, faces, edges, edge_faces(faces, edges), rest) / rest
    slope = 2 * np.pi * amplitude / 0.01
    across = np.abs(along[:, 1]) < 1e-9
    np.testing.assert_allclose(found[across].mean(), 1 / np.sqrt(1 + slope**2 / 2), rtol=2e-3)
    np.testing.assert_allclose(found[np.abs(along[:, 0]) < 1e-9], 1.0, atol=1e-9)


def test_where_nothing_is_scanned_edges_keep_their_length() -> None:
    vertices, faces = _sheet(5, 0.01)
    edges = unique_edges(faces)
    rest = np.full(len(edges), 0.01)
    surface = _corrugated(0.001, 0.01, 0.05, np.eye(3))
    found = folded_lengths(surface, vertices + 1.0, faces, edges, edge_faces(faces, edges), rest)
    np.testing.assert_array_equal(found, rest)


def test_every_edge_knows_its_faces() -> None:
    _, faces = _sheet(4, 1.0)
    edges = unique_edges(faces)
    for edge, (first, second) in zip(edges, edge_faces(faces, edges), strict=True):
        holders = np.flatnonzero((np.isin(faces, edge).sum(axis=1)) == 2)
        assert {first, second} == set(holders.tolist())
