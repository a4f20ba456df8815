"""Colours around a point: exact where they change evenly, unknown where nothing is seen."""

import numpy as np
import pytest

from registration.cloth_colours import log_colours, sample_faces, see_colours
from registration.correspondences import prepare_scan

REACH = 0.007


def sheet(rows: int = 60, columns: int = 60, spacing: float = 0.002) -> tuple[np.ndarray, np.ndarray]:
    """A tilted plane of triangles."""
    row, column = np.indices((rows, columns)).reshape(2, -1) * spacing
    points = np.column_stack([column, row, 0.3 * column])
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    faces = np.concatenate([np.stack(each, axis=-1).reshape(-1, 3) for each in ((a, b, c), (b, d, c))])
    return points, faces.astype(np.int32)


@pytest.fixture
def seen():
    """Colours that change evenly over a plane, seen by one large triangle in it."""
    points, faces = sheet()
    steep = np.array([[40.0, 0.0], [0.0, -25.0], [10.0, 10.0]])
    surface = prepare_scan(points, faces, smoothing_passes=0)
    samples = sample_faces(np.array([[0, 1, 2]], np.int32), 4, np.zeros(1, bool))
    corners = np.array([[0.03, 0.03, 0.009], [0.09, 0.03, 0.027], [0.03, 0.09, 0.009]])
    colours = points[:, :2] @ steep.T
    return samples, corners, steep, see_colours(surface, colours, samples, corners, REACH)


def test_even_change_is_seen_exactly(seen) -> None:
    samples, corners, steep, found = seen
    assert found.known.all()
    np.testing.assert_allclose(found.values, samples.places(corners)[:, :2] @ steep.T, atol=2e-3)
    along = np.array([1.0, 0.0, 0.3])
    expected = np.linalg.norm(along)
    np.testing.assert_allclose(found.gradients[:, 0] @ along / expected, 40 / expected, rtol=2e-2)
    np.testing.assert_allclose(found.gradients[:, 1] @ [0.0, 1.0, 0.0], -25, rtol=2e-2)


def test_gradients_tell_the_colours_beside(seen) -> None:
    samples, corners, steep, found = seen
    moved = samples.places(corners) + np.array([0.001, -0.002, 0.0003])
    np.testing.assert_allclose(found.at(moved), moved[:, :2] @ steep.T, atol=5e-3)


def test_samples_are_spread_evenly_and_know_their_faces() -> None:
    faces = np.array([[0, 1, 2], [2, 1, 3]], np.int32)
    samples = sample_faces(faces, 3, np.array([False, True]))
    assert len(samples) == 18
    assert samples.inner.tolist() == [True] * 9 + [False] * 9
    np.testing.assert_allclose(samples.weights.sum(axis=1), 1)
    np.testing.assert_allclose(samples.weights[:9].mean(axis=0), 1 / 3)
    corners = np.arange(12.0).reshape(2, 3, 2)
    np.testing.assert_allclose(samples.of_corners(corners)[9:].mean(axis=0), corners[1].mean(axis=0))


def test_nothing_is_known_beside_the_scan_or_behind_it() -> None:
    points, faces = sheet()
    surface = prepare_scan(points, faces, smoothing_passes=0)
    samples = sample_faces(np.array([[0, 1, 2]], np.int32), 1, np.zeros(1, bool))
    beside = np.array([[0.3, 0.3, 0.09], [0.31, 0.3, 0.093], [0.3, 0.31, 0.09]])
    assert not see_colours(surface, points, samples, beside, REACH).known.any()
    on_it = np.array([[0.05, 0.05, 0.015], [0.06, 0.05, 0.018], [0.05, 0.06, 0.015]])
    assert see_colours(surface, points, samples, on_it, REACH).known.all()
    assert not see_colours(surface, points, samples, on_it[[0, 2, 1]], REACH).known.any()


def test_light_adds_to_logarithms() -> None:
    dim, bright = log_colours(np.array([[60, 80, 100], [120, 160, 200]], np.uint8))
    np.testing.assert_allclose(bright - dim, np.log(2))
