"""Curves through markers: they pass through them, as long in between as the cloth, and nearer to the truth for it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from capture4d.errors import InputError
from capture4d.geometry.cages.marker_curves import curve_through, fill_curve


def circle(count: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)


@pytest.mark.parametrize("count", [3, 4, 6])
def test_a_hoop_is_found_from_few_markers(count: int) -> None:
    """Its lengths say that it is a circle; a periodic spline through four points is 28 mm off a metre's radius."""
    curve = curve_through(circle(count), np.full(count, 2 * np.pi / count), closed=True)
    around = np.linalg.norm(curve(np.linspace(0, 2 * np.pi, 200)), axis=1)
    assert np.abs(around - 1).max() < {3: 4e-3, 4: 1e-3, 6: 5e-4}[count]
    np.testing.assert_allclose(curve.lengths(), 2 * np.pi / count, rtol=1e-3)
    np.testing.assert_allclose(curve(2 * np.pi / count * np.arange(count)), circle(count), atol=1e-12)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_lengths_help_where_markers_are_far_apart(seed: int) -> None:
    """A helix, whose markers lie as they may: the curve is nearer to it than the spline through the same markers."""
    turn = np.sort(np.random.default_rng(seed).uniform(0, 5, 4))
    turn = np.concatenate([[0], turn[np.append(True, np.diff(turn) > 0.3)], [5.5]])

    def helix(at: np.ndarray) -> np.ndarray:
        return np.stack([np.cos(at), np.sin(at), 0.3 * at], axis=1)

    per_turn, fine = np.hypot(1, 0.3), np.linspace(0, 5.5, 300)
    curve = curve_through(helix(turn), per_turn * np.diff(turn))
    spline = CubicSpline(per_turn * turn, helix(turn), bc_type="natural")
    errors = [np.linalg.norm(each(per_turn * fine) - helix(fine), axis=1).mean() for each in (curve, spline)]
    assert errors[0] < 0.5 * errors[1]


def test_slack_between_markers_in_a_line_bows_as_told() -> None:
    line = np.arange(4)[:, None] * np.array([1.0, 0, 0])
    curve = curve_through(line, np.full(3, 1.2), bow=np.array([0, 0, -1.0]))
    np.testing.assert_allclose(curve.lengths(), 1.2, rtol=1e-3)
    middle = curve(np.array([0.6, 1.8, 3.0]))
    assert np.abs(middle[:, 1]).max() < 1e-9
    assert middle[0, 2] < -0.2


def test_taut_cloth_stays_straight() -> None:
    line = np.arange(4)[:, None] * np.array([1.0, 0, 0])
    curve = curve_through(line, np.full(3, 0.9))
    assert np.abs(curve(np.linspace(0, 2.7, 50))[:, 1:]).max() < 1e-6


def test_all_vertices_of_a_curve_come_from_some() -> None:
    angle = 2 * np.pi * np.arange(40) / 40
    truth = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    marked = np.array([3, 13, 21, 34])
    filled = fill_curve(angle, marked, truth[marked], around=2 * np.pi)
    assert np.linalg.norm(filled - truth, axis=1).max() < 0.02
    open_marks = np.array([0, 9, 20, 29])
    half = fill_curve(angle[:30], open_marks, truth[open_marks])
    assert np.linalg.norm(half - truth[:30], axis=1).max() < 0.04  # nothing bends the ends
    with pytest.raises(InputError, match="with both its ends"):
        fill_curve(angle[:30], marked[:3], truth[marked[:3]])


def test_markers_that_make_no_curve_are_told() -> None:
    for markers, lengths, closed in (
        (circle(3)[:1], [], False),
        (circle(3)[:2], [1, 1], True),
        (circle(3), [1], False),
    ):
        with pytest.raises(InputError, match=r"expected . or more and a length for every segment"):
            curve_through(markers, np.array(lengths, float), closed=closed)
    with pytest.raises(InputError, match="positive lengths"):
        curve_through(circle(3), np.array([1.0, 0.0]))
