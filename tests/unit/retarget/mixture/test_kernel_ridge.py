"""Kernels over a plane: any plane is learned, and goes on beyond what was learned; the width is chosen, not given."""

from __future__ import annotations

import numpy as np

from retarget.mixture.kernel_ridge import fit_kernel_ridge, fit_left_out


def test_a_plane_is_learned_and_goes_on():
    rng = np.random.default_rng(0)
    points, slope = rng.uniform(-1, 1, (20, 3)), rng.normal(size=(3, 4))
    found, off = fit_left_out(points, points @ slope + 5, lengths=(0.5, 2.0), ridges=(1e-3, 0.1))
    far = np.array([[3.0, -2.0, 4.0]])
    np.testing.assert_allclose(found.predict(far), far @ slope + 5, atol=0.02)
    assert off < 0.01


def test_the_width_that_foretells_best_is_taken():
    """A wave of length 2 needs a kernel narrower than it."""
    points = np.linspace(-2, 2, 41)[:, None]
    wave = np.sin(np.pi * points)
    found, _ = fit_left_out(points, wave, lengths=(0.05, 0.5, 20.0), ridges=(1e-3,))
    assert found.length == 0.5
    between = points[:-1] + 0.05
    np.testing.assert_allclose(found.predict(between), np.sin(np.pi * between), atol=0.02)


def test_without_a_line_it_falls_back_to_nothing():
    found = fit_kernel_ridge(np.array([[0.0], [1.0]]), np.ones((2, 1)), length=0.3, ridge=1e-6)
    np.testing.assert_allclose(found.predict(np.array([[0.0], [50.0]])), [[1], [0]], atol=1e-4)
