"""Statistics of folds against surfaces whose folds are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.fold_statistics import BAND_M, fold_statistics, legs, smoothed
from data_synth.cloth.panels import Panel, Pattern
from data_synth.cloth.patterns import PanelMesh

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


def test_thigh_and_shin_lie_between_hems_and_crotch_of_their_own_panel() -> None:
    """Two legs, 0.1 to 1.1 high as drafted, sewn up to 0.7, laid out 0.3 and 0 lower."""
    drafted = 0.1 + 0.05 * np.arange(21)
    origins = np.array([[0.0, -0.3], [1.0, 0.0]])
    corners = np.stack([np.arange(19), np.arange(1, 20), np.arange(2, 21)], axis=1)
    sides = {"left": np.arange(21), "right": np.arange(21, 42)}
    uv = np.concatenate([np.column_stack([np.full(21, u), drafted + v]) for u, v in origins])
    faces = np.concatenate([corners, corners + 21]).astype(np.int32)
    mesh = PanelMesh(
        faces,
        uv[faces],
        np.repeat([0, 1], 19),
        uv,
        np.array([np.flatnonzero((faces == vertex).any(axis=1))[0] for vertex in range(42)]),
        {f"leg_{side}": rows[:1] for side, rows in sides.items()},
        {f"in_{side}": rows[drafted < 0.71] for side, rows in sides.items()},
    )
    chosen = legs(mesh, Pattern(tuple(Panel("leg", (), origin) for origin in origins), ("leg_left", "leg_right")))
    np.testing.assert_array_equal(chosen, np.tile((drafted > 0.13) & (drafted < 0.67), 2))


def test_smoothing_keeps_the_centre_of_mass_and_a_turn_of_the_world() -> None:
    vertices, faces = corrugated(0.003)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    (plain,), areas = smoothed(vertices, faces, (0.05,))
    (turned,), _ = smoothed(vertices @ turn.T, faces, (0.05,))
    np.testing.assert_allclose(turned, plain @ turn.T, atol=1e-12)
    np.testing.assert_allclose(areas @ plain, areas @ vertices, rtol=1e-10, atol=1e-15)
