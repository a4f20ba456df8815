"""Nearest points against a search over the triangle, and faces that cut each other against solving for the crossing."""

import numpy as np
from scipy.optimize import nnls

from capture4d.geometry.triangles import (
    closest_in_triangle,
    closest_on_faces,
    count_intersecting_faces,
    fan_distances,
    intersecting_pairs,
)


def slow_closest(point: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates by non-negative least squares; a heavy row makes them sum to one."""
    heavy = 1e4
    return nnls(np.vstack([corners.T, np.full(3, heavy)]), np.append(point, heavy))[0]


def test_the_nearest_point_of_a_triangle_is_that_of_least_squares() -> None:
    rng = np.random.default_rng(0)
    regions = set()
    for _ in range(400):
        corners, point = rng.standard_normal((3, 3)), 1.5 * rng.standard_normal(3)
        found = np.array(closest_in_triangle(tuple(point), *map(tuple, corners)))
        regions.add(tuple(found > 0))
        np.testing.assert_allclose(found, slow_closest(point, corners), atol=1e-5)
        assert found.sum() == 1.0 or abs(found.sum() - 1) < 1e-12
    assert len(regions) == 7  # three corners, three sides, the face


def test_triangles_without_area_divide_by_nothing() -> None:
    for corners in (np.ones((3, 3)), np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0]]), np.eye(3)[[0, 0, 1]]):
        for point in np.random.default_rng(1).standard_normal((50, 3)):
            found = np.array(closest_in_triangle(tuple(point), *map(tuple, corners)))
            assert (found >= 0).all()
            np.testing.assert_allclose(found.sum(), 1)


def some_mesh(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    vertices = rng.standard_normal((40, 3))
    return vertices, np.array([rng.choice(40, 3, replace=False) for _ in range(60)], np.int32)


def test_the_nearest_of_some_faces_is_the_nearest_one_by_one() -> None:
    rng = np.random.default_rng(2)
    vertices, faces = some_mesh(rng)
    points, candidates = rng.standard_normal((30, 3)), rng.integers(0, 60, (30, 5))
    found, barycentric = closest_on_faces(points, candidates, vertices, faces)
    for n, point in enumerate(points):
        distances = [np.linalg.norm(slow_closest(point, vertices[faces[f]]) @ vertices[faces[f]] - point)
                     for f in candidates[n]]  # fmt: skip
        assert found[n] in candidates[n]
        reached = np.linalg.norm(barycentric[n] @ vertices[faces[found[n]]] - point)
        np.testing.assert_allclose(reached, min(distances), atol=1e-6)


def test_the_distance_to_a_fan_is_that_to_its_nearest_face() -> None:
    rng = np.random.default_rng(3)
    vertices, faces = some_mesh(rng)
    points, hubs = rng.standard_normal((30, 3)), rng.integers(0, 40, 30)
    around = [np.flatnonzero((faces == vertex).any(axis=1)) for vertex in range(40)]
    offsets = np.cumsum([0, *map(len, around)])
    found = fan_distances(points, hubs, vertices, faces, offsets, np.concatenate(around))
    for n, point in enumerate(points):
        slow = [np.linalg.norm(slow_closest(point, vertices[faces[f]]) @ vertices[faces[f]] - point)
                for f in around[hubs[n]]]  # fmt: skip
        np.testing.assert_allclose(found[n], min(slow, default=np.inf), atol=1e-6)


def test_intersections_equal_brute_force() -> None:
    """Random triangles: an edge of one passes through the other, by solving for the crossing."""
    rng = np.random.default_rng(0)
    count = 60
    vertices = (rng.random((count, 1, 3)) + 0.25 * rng.standard_normal((count, 3, 3))).reshape(-1, 3)
    faces = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)

    def pierces(face: int, other: int) -> bool:
        a, b, c = vertices[faces[other]]
        for i in range(3):
            start, end = vertices[faces[face, i]], vertices[faces[face, (i + 1) % 3]]
            t, u, v = np.linalg.solve(np.column_stack([start - end, b - a, c - a]), start - a)
            if 0 <= t <= 1 and u >= 0 and v >= 0 and u + v <= 1:
                return True
        return False

    cut = {f for f in range(count) for g in range(count) if f != g and (pierces(f, g) or pierces(g, f))}
    assert 5 < len(cut) < count
    assert count_intersecting_faces(vertices, faces) == len(cut)
    pairs = {(f, g) for f in range(count) for g in range(f) if pierces(f, g) or pierces(g, f)}
    found = intersecting_pairs(vertices, faces)
    assert len(found) == len(pairs)
    assert {(max(pair), min(pair)) for pair in found.tolist()} == pairs


def test_no_pair_is_lost_where_there_are_many() -> None:
    """Each of forty slats across forty others."""
    across = np.arange(40)[:, None, None] * [1.0, 0, 0] + [[0.0, -2, 0], [0, 90, 0.1], [0, -2, 0.2]]
    along = np.arange(40)[:, None, None] * [0, 1.0, 0] + [[-2.0, 0, -0.5], [-2, 0, 0.7], [90, 0, 0.1]]
    vertices = np.concatenate([across, along]).reshape(-1, 3)
    assert len(intersecting_pairs(vertices, np.arange(240).reshape(-1, 3))) == 1600
