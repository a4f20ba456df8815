"""Nearest points and hits against every triangle, one after the other."""

import numpy as np
import pytest
import trimesh

from capture4d.geometry.ray_casting import TriangleScene, barycentric
from capture4d.geometry.triangles import closest_in_triangle

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
BOX = trimesh.creation.box((1.0, 0.2, 0.6)).apply_translation((0, 0.8, 0))
SURFACES = [(np.array(mesh.vertices), np.array(mesh.faces)) for mesh in (BALL, BOX)]


@pytest.fixture(scope="module")
def scene() -> TriangleScene:
    return TriangleScene(*SURFACES)


def corners_of(surface: int, face: int) -> np.ndarray:
    vertices, faces = SURFACES[surface]
    return vertices[faces[face]]


def test_nearest_points_are_those_of_every_triangle(scene: TriangleScene) -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3))
    found = scene.nearest(points)
    assert set(found.surfaces.tolist()) == {0, 1}
    for n, point in enumerate(points):
        slow = []
        for surface, (_, faces) in enumerate(SURFACES):
            for face in range(len(faces)):
                corners = corners_of(surface, face)
                at = np.array(closest_in_triangle(tuple(point), *map(tuple, corners))) @ corners
                slow.append(np.linalg.norm(at - point))
        np.testing.assert_allclose(np.linalg.norm(found.points[n] - point), min(slow), atol=1e-6)
        corners = corners_of(found.surfaces[n], found.faces[n])
        np.testing.assert_allclose(barycentric(found.uv[n : n + 1])[0] @ corners, found.points[n], atol=1e-6)
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        np.testing.assert_allclose(found.normals[n], normal / np.linalg.norm(normal), atol=1e-5)


def test_rays_meet_the_first_triangle_that_they_pass_through(scene: TriangleScene) -> None:
    rng = np.random.default_rng(1)
    rays = np.concatenate([rng.uniform(-1, 1, (60, 3)), rng.standard_normal((60, 3))], axis=1)
    hits = scene.cast(rays)
    for n, ray in enumerate(rays):
        slow = [np.inf]
        for surface, (_, faces) in enumerate(SURFACES):
            for face in range(len(faces)):
                a, b, c = corners_of(surface, face)
                t, u, v = np.linalg.solve(np.column_stack([-ray[3:], b - a, c - a]), ray[:3] - a)
                if t >= 0 and u >= 0 and v >= 0 and u + v <= 1:
                    slow.append(t)
        np.testing.assert_allclose(hits.distance[n], min(slow), rtol=1e-4)
        assert (hits.faces[n] == -1) == (hits.surfaces[n] == -1) == np.isinf(min(slow))
    missed = np.isinf(hits.distance)
    assert 5 < missed.sum() < 55
    np.testing.assert_array_equal(scene.is_met(rays), ~missed)
    np.testing.assert_array_equal(scene.is_met(rays, far=0.3), hits.distance < 0.3)


def test_inside_of_closed_surfaces_is_negative() -> None:
    ball = TriangleScene(SURFACES[0])
    found = ball.signed_distances(np.array([[0.0, 0, 0], [0.9, 0, 0], [0, 0, 0.4]]))
    np.testing.assert_allclose(found, [-0.5, 0.4, -0.1], atol=0.02)


def test_any_number_of_threads_answers_alike() -> None:
    points = np.random.default_rng(2).uniform(-1, 1, (500, 3))
    one, many = (TriangleScene(*SURFACES, threads=threads).nearest(points) for threads in (1, 0))
    np.testing.assert_array_equal(one.points, many.points)
