"""Kernels against a double loop, and ridge regression against its normal equations."""

import numpy as np

from capture4d.learning.kernels import left_out_errors, likeness, ridge_answers


def test_likeness_is_the_sum_of_its_kernels() -> None:
    rng = np.random.default_rng(0)
    ours = [rng.standard_normal((5, 3)), rng.standard_normal((5, 2))]
    theirs = [rng.standard_normal((4, 3)), rng.standard_normal((4, 2))]
    shares, line = np.array([0.7, 0.2]), 0.1
    found = likeness(ours, theirs, shares, line)
    for row in range(5):
        for other in range(4):
            apart = [np.sum((a[row] - b[other]) ** 2) for a, b in zip(ours, theirs, strict=True)]
            slow = sum(share * np.exp(-square / 2) for share, square in zip(shares, apart, strict=True))
            np.testing.assert_allclose(found[row, other], slow + line * ours[0][row] @ theirs[0][other], atol=1e-12)


def test_a_small_ridge_gives_back_what_was_learned_and_a_large_one_nothing() -> None:
    rng = np.random.default_rng(1)
    known, wanted = [rng.standard_normal((12, 3))], rng.standard_normal((12, 2))
    alike = likeness(known, known, np.ones(1), 0.0)
    small, middle, large = ridge_answers(alike, wanted, (1e-12, 0.3, 1e9))
    np.testing.assert_allclose(alike @ small, wanted, atol=1e-6)
    np.testing.assert_allclose(middle, np.linalg.solve(alike + 0.3 * np.eye(12), wanted))
    assert np.abs(alike @ large).max() < 1e-6


def test_rows_left_out_are_foretold_as_by_a_regression_on_the_others():
    rng = np.random.default_rng(5)
    points, wanted = rng.normal(size=(9, 2)), rng.normal(size=(9, 3))
    alike = likeness([points], [points], np.ones(1), 0.5)
    off = left_out_errors(alike, wanted, 0.1)
    for row in range(9):
        others = np.arange(9) != row
        (answers,) = ridge_answers(alike[np.ix_(others, others)], wanted[others], (0.1,))
        np.testing.assert_allclose(off[row], wanted[row] - alike[row, others] @ answers, atol=1e-10)
