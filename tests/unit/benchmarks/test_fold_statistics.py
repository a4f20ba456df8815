"""Statistics of folds against surfaces whose folds are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.fold_statistics import BAND_M, fold_statistics, smoothed

WIDTH_M, STEP_M = 0.04, 0.004


def corrugated(height_m: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """A sheet of 0.48 x 0.2 m with folds 40 mm wide of some height, and its faces."""
    x, y = np.meshgrid(np.arange(121) * STEP_M, np.arange(51) * STEP_M, indexing="ij")
    z = height_m * np.sin(2 * np.pi * x / WIDTH_M)
    corner = (np.arange(120)[:, None] * 51 + np.arange(50)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 51, corner + 52], 1), np.stack([corner, corner + 52, corner + 1], 1)]
    )
    return np.stack([x, y, z], axis=2).reshape(-1, 3), faces.astype(np.int32)


def middle(vertices: np.ndarray) -> np.ndarray:
    return (vertices[:, 0] > 0.1) & (vertices[:, 0] < 0.38) & (vertices[:, 1] > 0.05) & (vertices[:, 1] < 0.15)


def test_a_shallow_wave_loses_what_the_filter_takes() -> None:
    """A wave of width w keeps 1 / (1 + (s / w)^2) of its height at scale s."""
    vertices, faces = corrugated(0.0005)
    kept = [1 / (1 + (scale / WIDTH_M) ** 2) for scale in BAND_M]
    height = (kept[0] - kept[1]) * 0.0005 / np.sqrt(2)
    assert fold_statistics(vertices, faces, middle(vertices)).height_rms_mm == pytest.approx(1e3 * height, rel=0.04)


def test_folds_everywhere_are_even_and_folds_here_and_there_are_not() -> None:
    vertices, faces = corrugated(0.003)
    even = fold_statistics(vertices, faces, middle(vertices))
    vertices, faces = corrugated(0.003 * (np.arange(121) * STEP_M < 0.2)[:, None])
    uneven = fold_statistics(vertices, faces, middle(vertices))
    assert even.p90_to_median < 1.6
    assert even.calm_percent < 15
    assert uneven.p90_to_median > 2 * even.p90_to_median
    assert 45 < uneven.calm_percent < 70


def test_smoothing_keeps_the_centre_of_mass_and_a_turn_of_the_world() -> None:
    vertices, faces = corrugated(0.003)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    (plain,), areas = smoothed(vertices, faces, (0.05,))
    (turned,), _ = smoothed(vertices @ turn.T, faces, (0.05,))
    np.testing.assert_allclose(turned, plain @ turn.T, atol=1e-12)
    np.testing.assert_allclose(areas @ plain, areas @ vertices, rtol=1e-10, atol=1e-15)
