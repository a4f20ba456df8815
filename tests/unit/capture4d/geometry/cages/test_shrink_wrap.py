"""The three steps of the shrink wrap: on bodies where it is known where cloth has to come to lie."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from capture4d.geometry.cages.cage import cage_of_edges
from capture4d.geometry.cages.dirichlet import Extension, dirichlet_form, flattened
from capture4d.geometry.cages.shrink_wrap import (
    edge_ratio_spread,
    equalise,
    flipped_faces,
    morph,
    on_surface,
    push_out,
    turned_in_faces,
)
from capture4d.geometry.mesh import boundary_edges, edge_lengths, unique_edges
from capture4d.geometry.ray_casting import TriangleScene
from tests.shapes import tube

RADIUS = 0.1


@pytest.fixture(scope="module")
def column() -> TriangleScene:
    """A closed cylinder about Y, from -0.2 to 0.8 m."""
    solid = trimesh.creation.cylinder(radius=RADIUS, height=1.0, sections=96)
    vertices = np.asarray(solid.vertices)[:, [1, 2, 0]] + [0, 0.3, 0]
    return TriangleScene((vertices, np.asarray(solid.faces)))


def none(faces: np.ndarray) -> np.ndarray:
    return np.zeros(len(faces), bool)


def around(vertices: np.ndarray, turn: np.ndarray, height: np.ndarray, radius: float) -> np.ndarray:
    """Points of a tube turned and shifted along it, at a radius."""
    angle = np.arctan2(vertices[:, 0], vertices[:, 2]) + turn
    return np.stack([radius * np.sin(angle), vertices[:, 1] + height, radius * np.cos(angle)], axis=1)


def test_the_inside_moves_with_an_affinely_moved_cage() -> None:
    mesh = tube(20, 8)
    flat = np.array(mesh.uv, float)
    plane = np.zeros((len(mesh.vertices), 3))
    plane[mesh.faces, :2] = flat  # the tube cut open has no seam in this test: leave out the faces that close it
    faces = mesh.faces[np.ptp(mesh.faces % 20, axis=1) < 10]
    cage = np.unique(boundary_edges(faces))
    extension = Extension(dirichlet_form(faces, flattened(plane, faces), len(plane)), cage)
    goal = plane @ np.array([[1.2, 0.1, 0.4], [0, 0.8, 0.2], [0, 0, 1]]) + [1, 2, 3]
    np.testing.assert_allclose(morph(plane, extension, goal[cage]), goal, atol=1e-9)


def test_only_what_is_inside_is_pushed_out(column: TriangleScene) -> None:
    points = np.random.default_rng(0).uniform([-0.2, 0, -0.2], [0.2, 0.5, 0.2], (400, 3))
    pushed = push_out(column, points)
    inside = np.hypot(points[:, 0], points[:, 2]) < RADIUS * np.cos(np.pi / 96)
    moved = (pushed != points).any(axis=1)
    assert moved[inside].all()
    assert not moved[np.hypot(points[:, 0], points[:, 2]) > RADIUS].any()
    radius = np.hypot(pushed[inside, 0], pushed[inside, 2])
    assert ((radius > RADIUS * 0.998) & (radius < RADIUS * 1.001)).all()


@pytest.mark.parametrize("wound", [1, -1])
def test_equalisation_evens_out_what_can_be_even(column: TriangleScene, wound: int) -> None:
    """A tube fits a column without distortion; crowded on one side and at one height it comes back near that."""
    mesh = tube(28, 16, radius=0.13)
    faces = mesh.faces[:, ::wound]
    rest = edge_lengths(mesh.vertices.astype(float), unique_edges(faces))
    angle, height = np.arctan2(mesh.vertices[:, 0], mesh.vertices[:, 2]), mesh.vertices[:, 1]
    crowded = around(mesh.vertices, 0.35 * np.sin(2 * angle), 0.035 * np.sin(2 * np.pi * height / 0.25), RADIUS)
    placed = equalise(column, crowded, faces, rest, turned_in=none(faces), iterations=300)
    before, after = (edge_ratio_spread(points, faces, rest) for points in (crowded, placed.points))
    assert after < 0.45 * before
    assert not flipped_faces(placed, faces).any()
    off = np.hypot(placed.points[:, 0], placed.points[:, 2]) - RADIUS
    assert np.abs(off).max() < 1e-3
    np.testing.assert_allclose(on_surface(column, placed.points).points, placed.points, atol=1e-6)
    np.testing.assert_allclose(placed.barycentric.sum(axis=1), 1.0, atol=1e-12)


def test_one_edge_torn_apart_does_not_stretch_all_others(column: TriangleScene) -> None:
    """The mean ratio at a vertex would follow a short edge that lies thirty times too long, and feed itself."""
    mesh = tube(28, 16, radius=RADIUS)
    vertices = mesh.vertices.astype(float)
    vertices[100] = vertices[101] + 0.03 * (vertices[100] - vertices[101])
    edges = unique_edges(mesh.faces)
    rest = edge_lengths(vertices, edges)
    placed = equalise(column, mesh.vertices.astype(float), mesh.faces, rest, turned_in=none(mesh.faces), iterations=100)
    ratios = edge_lengths(placed.points, edges) / rest
    assert 0.5 < np.median(ratios) < 1.2
    assert edge_ratio_spread(placed.points, mesh.faces, rest) < 0.5 * edge_ratio_spread(mesh.vertices, mesh.faces, rest)


def test_folded_faces_are_unfolded(column: TriangleScene) -> None:
    mesh = tube(28, 16, radius=RADIUS)
    rest = edge_lengths(mesh.vertices.astype(float), unique_edges(mesh.faces))
    folded = mesh.vertices.astype(float)
    folded[[200, 202]] = folded[[202, 200]]
    assert flipped_faces(on_surface(column, folded), mesh.faces).any()
    placed = equalise(column, folded, mesh.faces, rest, turned_in=none(mesh.faces), iterations=60)
    assert not flipped_faces(placed, mesh.faces).any()


def test_a_collar_lies_on_the_body_twice(column: TriangleScene) -> None:
    """Many to one: the turned-over layer and the cloth under it have the same body points, and stay two layers."""
    mesh = tube(28, 21, radius=0.11, height=0.4)
    along = mesh.vertices[:, 1].astype(float)
    turned = along > 0.3  # folds outwards and down over the cloth below
    cloth = mesh.vertices.astype(float)
    cloth[turned] = around(cloth[turned], np.zeros(turned.sum()), 0.6 - 2 * along[turned], 0.114)
    cage = cage_of_edges(mesh.faces, np.zeros((0, 2), np.int32))
    extension = Extension(dirichlet_form(mesh.faces, flattened(cloth, mesh.faces), len(cloth)), cage.vertices)
    inwards = turned_in_faces(column, cloth, mesh.faces)
    np.testing.assert_array_equal(inwards, along[mesh.faces].mean(axis=1) > 0.3)
    targets = on_surface(column, cloth[cage.vertices]).points
    rest = edge_lengths(cloth, unique_edges(mesh.faces))
    placed = equalise(
        column, push_out(column, morph(cloth, extension, targets)), mesh.faces, rest, turned_in=inwards, iterations=60
    )
    np.testing.assert_array_equal(flipped_faces(placed, mesh.faces), inwards)
    assert np.abs(placed.points[:, 1] - cloth[:, 1]).max() < 0.012
    under = np.flatnonzero((along > 0.21) & (along < 0.29))
    shared = set(placed.faces[under].tolist()) & set(placed.faces[turned].tolist())
    assert len(shared) > 5
