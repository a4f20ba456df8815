"""Kernel ridge regression whose width and penalty are given, or chosen by leaving out each row in turn.

References: `capture4d.learning.kernels`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from capture4d.learning.kernels import left_out_errors, likeness, ridge_answers

__all__ = ["KernelRidge", "fit_kernel_ridge", "fit_left_out"]

PLANE = 1e3
"""Weight of a linear kernel with an intercept that is to take any slope, beside 1 of the Gaussian one."""


@dataclass(frozen=True, slots=True, eq=False)
class KernelRidge:
    """A regression from `numbers` to `outputs`."""

    points: Float64[np.ndarray, "learned numbers"]
    """What was learned from, over the width of the kernel."""
    answers: Float64[np.ndarray, "learned outputs"]
    """What each contributes."""
    length: float
    line: float
    """Weight of the linear kernel, which goes on where nothing was learned."""

    def predict(self, asked: Float[np.ndarray, "rows numbers"]) -> Float64[np.ndarray, "rows outputs"]:
        return _alike(asked.astype(np.float64) / self.length, self.points, self.line) @ self.answers


def _alike(
    ours: Float64[np.ndarray, "rows numbers"], theirs: Float64[np.ndarray, "others numbers"], line: float
) -> Float64[np.ndarray, "rows others"]:
    """A Gaussian kernel, and a linear one with an intercept: a column of ones, which no distance sees."""
    ours, theirs = (np.column_stack([each, np.ones(len(each))]) for each in (ours, theirs))
    return likeness([ours], [theirs], np.ones(1), line)


def fit_kernel_ridge(
    points: Float[np.ndarray, "learned numbers"],
    wanted: Float[np.ndarray, "learned outputs"],
    *,
    length: float,
    ridge: float,
    line: float = 0.0,
) -> KernelRidge:
    """Learn a regression.

    Args:
        wanted: about its mean, if there is no line.
        length: width of the Gaussian kernel.
    """
    scaled = points.astype(np.float64) / length
    (answers,) = ridge_answers(_alike(scaled, scaled, line), wanted.astype(np.float64), (ridge,))
    return KernelRidge(scaled, answers, length, line)


def fit_left_out(
    points: Float[np.ndarray, "learned numbers"],
    wanted: Float[np.ndarray, "learned outputs"],
    *,
    lengths: Sequence[float],
    ridges: Sequence[float],
) -> tuple[KernelRidge, float]:
    """Learn a regression over a plane, with the width and the penalty that foretell each row best from the others.

    Returns:
        It, and the root of the mean squared error of a row, all its outputs together, when it was left out.
    """
    choices = [(length, ridge) for length in lengths for ridge in ridges]

    def error(choice: tuple[float, float]) -> float:
        scaled = points.astype(np.float64) / choice[0]
        off = left_out_errors(_alike(scaled, scaled, PLANE), wanted.astype(np.float64), choice[1])
        return float((off**2).sum(axis=1).mean())

    errors = [error(choice) for choice in choices]
    length, ridge = choices[int(np.argmin(errors))]
    return fit_kernel_ridge(points, wanted, length=length, ridge=ridge, line=PLANE), float(np.sqrt(min(errors)))
