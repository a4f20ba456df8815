"""Edges are drawn together, and nothing else happens."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from capture4d.geometry.mesh import unique_edges
from retarget.animation.strain import SLACK, STAY, StrainLimit
from tests.shapes import tube

MESH = tube(16, 10, 0.1)
EDGES = unique_edges(MESH.faces)
REST = MESH.vertices.astype(np.float64)


def lengths(vertices: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vertices[EDGES[:, 0]] - vertices[EDGES[:, 1]], axis=1)


LIMIT = StrainLimit(EDGES, lengths(REST), len(REST), 1.2)


def test_cloth_that_is_not_too_long_stays() -> None:
    for factor in (0.5, 1.0, 1.19):
        np.testing.assert_array_equal(LIMIT(factor * REST), factor * REST)


@pytest.mark.parametrize("factor", [1.3, 2.0, 5.0])
def test_a_spike_is_drawn_in(factor: float) -> None:
    spiked = REST.copy()
    spiked[60] += factor * lengths(REST).max() * np.array([0.6, 0.0, 0.8])
    found = LIMIT(spiked)
    assert (lengths(found) / lengths(REST)).max() < 1.2 * (1 + 2 * SLACK)
    far = np.linalg.norm(REST - REST[60], axis=1) > 0.12
    assert np.linalg.norm(found - spiked, axis=1)[far].max() < 0.02


def test_it_turns_and_moves_with_the_cloth() -> None:
    spiked = REST * (1.0, 1.5, 1.0)
    turn, shift = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix(), np.array([0.2, 1.0, -3.0])
    np.testing.assert_allclose(LIMIT(spiked @ turn.T + shift), LIMIT(spiked) @ turn.T + shift, atol=1e-9)


def test_what_is_left_is_the_least_squares_it_says() -> None:
    """Two vertices: the edge that is too long meets its limit but for what holds both in place."""
    pair = StrainLimit(np.array([[0, 1]], np.int32), np.array([1.0]), 2, 1.0)
    start = np.array([[0.0, 0, 0], [3.0, 0, 0]])

    def energy(flat: np.ndarray) -> float:
        points = flat.reshape(2, 3)
        length = np.linalg.norm(points[0] - points[1])
        return max(length - 1.0, 0.0) ** 2 + STAY * ((points - start) ** 2).sum()

    wanted = minimize(energy, start.ravel(), tol=1e-12).x.reshape(2, 3)
    np.testing.assert_allclose(pair(start), wanted, atol=2e-3)
