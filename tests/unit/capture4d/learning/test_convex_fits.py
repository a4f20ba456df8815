"""Convex combinations against what geometry says, and greedy choices against looking at everything."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.learning.convex_fits import convex_weights, furthest_first


@pytest.mark.parametrize("dimensions", [2, 3, 40])
def test_a_convex_combination_gives_its_shares_back(dimensions: int):
    rng = np.random.default_rng(dimensions)
    points = rng.normal(size=(min(dimensions, 5) + 1, dimensions)) * 0.01 + 3.0
    shares = rng.dirichlet(np.ones(len(points)))
    np.testing.assert_allclose(convex_weights(points, shares @ points), shares, atol=1e-5)


def test_what_is_outside_goes_to_the_nearest_point_of_the_triangle():
    triangle = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    outside = {(-1.0, -1.0, 5.0): (1, 0, 0), (0.5, -2.0, 0.0): (0.5, 0.5, 0), (2.0, 2.0, -1.0): (0, 0.5, 0.5)}
    for target, wanted in outside.items():
        np.testing.assert_allclose(convex_weights(triangle, np.array(target)), wanted, atol=1e-6)


def test_no_other_shares_are_nearer():
    rng = np.random.default_rng(1)
    points, target = rng.normal(size=(5, 8)), rng.normal(size=8)
    best = np.linalg.norm(convex_weights(points, target) @ points - target)
    others = rng.dirichlet(np.ones(5), size=4000) @ points
    assert best <= np.linalg.norm(others - target, axis=1).min() + 1e-9


def test_corners_of_a_square_are_chosen_and_nothing_is_left():
    """Whatever lies inside is a convex combination of the corners."""
    rng = np.random.default_rng(2)
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
    points = np.concatenate([[[0.1, 0.2]], rng.uniform(-0.9, 0.9, (12, 2)), corners])
    chosen, errors = furthest_first(points, [0], 5, lambda one, other: float(np.linalg.norm(one - other)))
    assert chosen[0] == 0
    assert set(chosen[1:]) == {13, 14, 15, 16}
    assert errors[-1][0] < 1e-5
    assert [worst for worst, _ in errors] == sorted((worst for worst, _ in errors), reverse=True)
    assert len(errors) == 5
