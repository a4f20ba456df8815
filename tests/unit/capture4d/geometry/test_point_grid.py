"""Search by cells gives what a tree gives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from capture4d.geometry import point_grid
from capture4d.geometry.point_grid import PointGrid


@pytest.mark.parametrize("cell", [0.003, 0.02, 0.5])
@pytest.mark.parametrize("bound", [0.05, np.inf])
def test_same_as_a_tree(cell: float, bound: float) -> None:
    rng = np.random.default_rng(int(1000 * cell))
    points = rng.normal(size=(3000, 3)) * [0.3, 0.5, 0.05]
    queries = np.concatenate([rng.normal(size=(500, 3)) * 0.4, rng.uniform(-4, 4, (100, 3)), points[:50]])
    distance, index = PointGrid.build(points, cell).query(queries, bound)
    wanted, wanted_index = KDTree(points).query(queries, distance_upper_bound=bound)
    assert np.allclose(distance, wanted, rtol=0, atol=1e-12)
    assert (index == wanted_index).all()


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.ones((20, 3)), np.outer(np.arange(9.0), [0, 0, 1])])
def test_flat_and_single_points(points: np.ndarray) -> None:
    distance, _ = PointGrid.build(points, 1.0).query(points + np.array([0.0, 0.25, 0.0]))
    assert np.allclose(distance, 0.25)


def test_a_stray_point_costs_no_memory() -> None:
    points = np.concatenate([np.random.default_rng(0).normal(size=(100, 3)), [[1e5, -1e5, 1e5]]])
    grid = PointGrid.build(points, 1e-3)
    assert len(grid.starts) <= point_grid.MAX_CELLS + 1
    assert (grid.query(points)[1] == np.arange(101)).all()


@pytest.mark.parametrize("cell", [0.01, 0.1, 0.5])
@pytest.mark.parametrize("min_cosine", [-0.5, 0.4, 0.95])
def test_the_nearest_that_faces_a_way_is_that_of_brute_force(cell: float, min_cosine: float) -> None:
    rng = np.random.default_rng(3)
    points, normals = rng.uniform(size=(400, 3)), rng.normal(size=(400, 3))
    queries, directions = rng.uniform(-0.3, 1.3, (200, 3)), rng.normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    bounds = rng.uniform(0.01, 0.5, 200)
    distance, index = PointGrid.build(points, cell).query_facing(queries, directions, bounds, normals, min_cosine)
    nothing = 0
    for query in range(200):
        away = np.linalg.norm(points - queries[query], axis=1)
        away[(normals @ directions[query] < min_cosine) | (away >= bounds[query])] = np.inf
        best = int(np.argmin(away))
        if np.isfinite(away[best]):
            assert index[query] == best
            assert distance[query] == pytest.approx(away[best], abs=1e-12)
        else:
            nothing += 1
            assert index[query] == len(points)
            assert np.isinf(distance[query])
    assert 0 < nothing < 200
