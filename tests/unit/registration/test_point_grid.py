"""Search by cells gives what a tree gives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from registration import point_grid
from registration.point_grid import PointGrid


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
