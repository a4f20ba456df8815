"""Refined disparities against textures that were shifted by known amounts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from data_synth.scanner.depth_noise import periodic_gaussian_field
from data_synth.scanner.disparity_refinement import refine_disparity

SIZE, EDGE = 96, 48


def pair(disparity: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Left and right image of speckles, 8 bit with noise, for a disparity that is linear along each row."""
    texture = 110 + 45 * periodic_gaussian_field(SIZE, 1.1, rng)
    rows, columns = np.indices(disparity.shape).astype(float)
    slope = (disparity[:, -1:] - disparity[:, :1]) / (SIZE - 1)
    seen_from = (columns + disparity[:, :1]) / (1 - slope)  # x - d(x) = column
    right = map_coordinates(texture, [rows, seen_from], order=5, mode="grid-wrap")
    left, right = (
        np.clip(np.rint(image + 2 * rng.standard_normal(image.shape)), 0, 255).astype(np.uint8)
        for image in (texture, right)
    )
    return left, right


def inner(values: np.ndarray) -> np.ndarray:
    return values[12:-12, 12:-12]


@pytest.mark.parametrize("seed", [0, 1])
def test_slanted_planes_come_out_slanted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, columns = np.indices((SIZE, SIZE)).astype(np.float32)
    truth = (4.3 + 0.03 * (columns - SIZE / 2) - 0.02 * (rows - SIZE / 2)).astype(np.float32)
    left, right = pair(truth, rng)
    whole = np.rint(truth).astype(np.float32)
    known = np.ones(truth.shape, bool)
    grey = np.full((SIZE, SIZE, 3), 0.5, np.float32)
    found = refine_disparity(whole, known, left, right, grey, steps=4)
    assert np.percentile(np.abs(inner(found - truth)), 95) < 0.12
    assert np.abs(np.median(inner(found - truth))) < 0.02
    none = refine_disparity(whole, known, left, right, grey, steps=0)
    np.testing.assert_array_equal(none, whole)


@pytest.mark.parametrize("seed", [0, 1])
def test_windows_keep_to_one_colour(seed: int) -> None:
    """At a step of less than a pixel, which the matches miss, colour tells the two surfaces apart."""
    rng = np.random.default_rng(seed)
    truth = np.full((SIZE, SIZE), 5.35, np.float32)
    truth[EDGE:] = 4.65
    left, right = pair(truth, rng)
    level, known = np.full_like(truth, 5), np.ones(truth.shape, bool)
    colours = np.full((SIZE, SIZE, 3), 0.5, np.float32)
    blind = refine_disparity(level, known, left, right, colours, steps=4)
    colours[EDGE:] = 0.9, 0.7, 0.1
    colours += 0.015 * rng.standard_normal(colours.shape).astype(np.float32)
    guided = refine_disparity(level, known, left, right, colours, steps=4)
    beside = np.abs(np.arange(SIZE) + 0.5 - EDGE) < 2
    errors = [np.abs(found - truth)[beside, 12:-12].mean() for found in (blind, guided)]
    assert errors[0] > 0.15
    assert errors[1] < min(0.12, 0.5 * errors[0])


def test_what_is_not_matched_is_neither_used_nor_changed() -> None:
    rng = np.random.default_rng(2)
    truth = np.full((SIZE, SIZE), 3.4, np.float32)
    left, right = pair(truth, rng)
    known = rng.random(truth.shape) > 0.2
    start = np.where(known, np.float32(3), np.float32(3.9))
    colours = np.full((SIZE, SIZE, 3), 0.5, np.float32)
    found = refine_disparity(start, known, left, right, colours, steps=4)
    np.testing.assert_array_equal(found[~known], start[~known])
    assert np.abs(np.median(inner(found)[inner(known)]) - 3.4) < 0.03
    nothing = refine_disparity(start, np.zeros_like(known), left, right, colours, steps=2)
    np.testing.assert_array_equal(nothing, start)
