"""Weights of prototypes: the released kernel's figures, and a bandwidth that is chosen by what it foretells."""

from __future__ import annotations

import numpy as np
import pytest

from retarget.mixture.prototype_weights import (
    RELEASED_BANDWIDTH,
    effective_number,
    left_out_bandwidth,
    prototype_weights,
    squared_distances,
)


@pytest.mark.parametrize(("rms_mm", "psi"), [(1, 0.905), (2, 0.670), (5, 0.082), (10, 4.5e-5)])
def test_the_released_kernel(rms_mm: float, psi: float):
    """As the released code weighs garments that are so far apart, before weights are made to sum to 1."""
    rng = np.random.default_rng(0)
    shift = rng.normal(size=(50, 3))
    shift *= 1e-3 * rms_mm / np.sqrt((shift**2).sum(axis=1).mean())
    distances = squared_distances(shift[None], np.zeros((1, 50, 3)))[0]
    found = prototype_weights(distances, RELEASED_BANDWIDTH, normalised=False)
    assert found[0] == pytest.approx(psi, rel=0.01)
    assert prototype_weights(distances, RELEASED_BANDWIDTH)[0] == 1.0


def test_weights_are_a_convex_combination_however_far_all_prototypes_are():
    distances = np.array([500.0, 501.0, 900.0])
    for bandwidth in (1e-6, 0.01, 1.0, 1e6):
        weights = prototype_weights(distances, bandwidth)
        assert weights.sum() == pytest.approx(1)
        assert weights.min() >= 0
        assert weights.argmax() == 0
    assert effective_number(prototype_weights(distances, 1e-6)) == pytest.approx(1)
    assert effective_number(prototype_weights(distances, 1e9)) == pytest.approx(3)


def line(spread: float, seed: int) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Prototypes on a line; what each says is a smooth function of its place, and noise of its own."""
    rng = np.random.default_rng(seed)
    places = np.arange(9.0)
    distances = (places[:, None] - places) ** 2
    truth = [np.repeat(np.sin(place)[None, None], 4, axis=0) for place in places]
    said = np.sin(places)[:, None, None] + spread * rng.normal(size=(9, 4, 1))
    return distances, [said] * 9, truth


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_bandwidth_is_narrow_where_neighbours_tell_and_wide_where_they_are_noise(seed: int):
    narrow, errors = left_out_bandwidth(*line(0.0, seed))
    wide, _ = left_out_bandwidth(*line(4.0, seed))
    assert narrow <= 2.0 < 4.0 <= wide
    by_hand = min(errors, key=lambda each: each[1])
    assert narrow == by_hand[0]


def test_too_few_prototypes_to_choose_by():
    assert left_out_bandwidth(np.zeros((1, 1)), [], [])[0] == RELEASED_BANDWIDTH
    assert left_out_bandwidth(np.array([[0.0, 3.0], [3.0, 0.0]]), [], [])[0] == 3.0
