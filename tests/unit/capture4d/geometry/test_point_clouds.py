"""Faces between points: on the surface, seen from outside, none across a hole."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.geometry.mesh import boundary_loops, doubled_area_vectors, edge_uses, face_areas
from capture4d.geometry.point_clouds import faces_between
from tests.shapes import plane, tube

COUNT = 4000
SPACING = np.sqrt(4 * np.pi / COUNT)


def sphere(noise: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(0)
    points = rng.standard_normal((COUNT, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return (points * (1 + noise * rng.standard_normal((COUNT, 1)))).astype(np.float32)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.25])
def test_a_sphere_is_closed_and_seen_from_outside(noise: float):
    points = sphere(noise * SPACING)
    faces = faces_between(points)
    assert face_areas(points.astype(float), faces).sum() == pytest.approx(4 * np.pi, rel=0.02 + noise / 2)
    outward = np.einsum("fi,fi->f", doubled_area_vectors(points, faces), points[faces].mean(axis=1))
    assert (outward > 0).mean() > 0.99
    assert (edge_uses(faces)[1] <= 2).all()
    assert (edge_uses(faces)[1] == 1).mean() < 0.02


@pytest.mark.parametrize("spacings", [8.0, 15.0])
def test_a_hole_stays_a_hole_of_its_size(spacings: float):
    points = sphere()
    radius = spacings * SPACING / 2
    points = points[np.linalg.norm(points - [0, 0, 1], axis=1) > radius]
    faces = faces_between(points)
    edges = np.linalg.norm(points[faces] - points[np.roll(faces, 1, axis=1)], axis=2)
    assert edges.max() < 4.5 * SPACING
    centre = np.linalg.norm(points[faces].mean(axis=1) - [0, 0, 1], axis=1)
    assert centre.min() > radius - 1.5 * SPACING
    rim = boundary_loops(faces)[0]
    assert np.linalg.norm(points[rim] - [0, 0, 1], axis=1).mean() < radius + 1.5 * SPACING


def test_the_borders_of_a_tube_are_its_borders():
    mesh = tube(60, 40)
    points = (mesh.vertices @ Rotation.from_euler("xyz", [0.4, 1.0, 0.2]).as_matrix()).astype(np.float32)
    loops = boundary_loops(faces_between(points))[:2]
    assert {frozenset(loop.tolist()) for loop in loops} == {frozenset(range(60)), frozenset(range(39 * 60, 40 * 60))}


def test_even_grids_have_no_gaps_flat_ones_neither():
    assert len(faces_between(tube(60, 40).vertices)) > 0.995 * 2 * 60 * 39
    assert face_areas(plane(cells=30).vertices, faces_between(plane(cells=30).vertices)).sum() == pytest.approx(1, 0.01)


def test_units_and_places_do_not_matter_and_points_keep_their_numbers():
    mesh = tube(60, 40)
    faces = faces_between(mesh.vertices)
    moved = (1000 * mesh.vertices + [5000, 0, -3000]).astype(np.float32)
    assert abs(len(faces_between(moved)) - len(faces)) < 0.005 * len(faces)
    doubled = np.concatenate([mesh.vertices, mesh.vertices[:700]])
    assert abs(len(faces_between(doubled)) - len(faces)) < 0.01 * len(faces)


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (sphere()[:50], "a cloud of at least 100 points; found no faces, and 50 points"),
        (np.zeros((500, 3), np.float32), "found no faces, and 1 points"),
        (np.linspace(0, 1, 400, dtype=np.float32)[:, None] * np.float32([1, 2, 3]), "in a line"),
    ],
)
def test_what_is_no_surface_is_said(points: np.ndarray, said: str):
    with pytest.raises(InputError, match=said):
        faces_between(points)


def test_points_that_crowd_around_places_are_passed_over_and_others_are_not():
    """The ball would try every two of hundreds that it touches: minutes for what some 100 kB say."""
    points = np.random.default_rng(0).standard_cauchy((6000, 3)).astype(np.float32)
    assert len(np.unique(faces_between(points))) < len(points) / 2
    dense = sphere()[sphere()[:, 0] > 0]
    uneven = np.concatenate([dense, sphere()[:500] * [-1, 1, 1]]).astype(np.float32)  # half of it four times as dense
    front = np.unique(faces_between(uneven))
    assert np.isin(np.arange(len(dense)), front).mean() > 0.97
