"""Ridge regression by kernels: an answer is a sum over what was learned, each weighted by its likeness to the question.

Likeness is a sum of Gaussian kernels, each of which compares what one view sees, and of a linear one. What the views
are, and how much each weighs, is the caller's.

References: Rasmussen and Williams, Gaussian Processes for Machine Learning (MIT Press, 2006), section 2.2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Float64
from scipy.linalg import cho_factor, cho_solve

__all__ = ["left_out_errors", "likeness", "ridge_answers"]


def likeness(
    ours: Sequence[Float64[np.ndarray, "rows _"]],
    theirs: Sequence[Float64[np.ndarray, "others _"]],
    shares: Float[np.ndarray, " views"],
    line: float,
) -> Float64[np.ndarray, "rows others"]:
    """How much alike rows are to others: the sum of all kernels.

    Args:
        ours: what each view sees of the rows; those a distance of 1 apart are alike by exp(-1/2).
        theirs: and of the others.
        shares: weights of the Gaussian kernels.
        line: weight of the linear kernel, which compares what the first view sees.
    """
    total = line * ours[0] @ theirs[0].T
    for one, other, share in zip(ours, theirs, shares, strict=True):
        squares = (one**2).sum(axis=1)[:, None] + (other**2).sum(axis=1) - 2 * one @ other.T
        total += float(share) * np.exp(-0.5 * np.maximum(squares, 0))
    return total


def ridge_answers(
    alike: Float64[np.ndarray, "learned learned"],
    wanted: Float64[np.ndarray, "learned outputs"],
    ridges: Sequence[float],
) -> Iterator[Float64[np.ndarray, "learned outputs"]]:
    """What each learned row contributes, for each ridge: `likeness @ answers` is the regression.

    Args:
        alike: how much alike the learned rows are to each other.
        wanted: what each should give, about its mean.
    """
    for ridge in ridges:
        factor = cho_factor(alike + ridge * np.eye(len(alike)), check_finite=False)
        yield cho_solve(factor, wanted, check_finite=False)


def left_out_errors(
    alike: Float64[np.ndarray, "learned learned"], wanted: Float64[np.ndarray, "learned outputs"], ridge: float
) -> Float64[np.ndarray, "learned outputs"]:
    """How far off each learned row is foretold by a regression on all the others, exactly and without fitting them.

    References: Rasmussen and Williams, section 5.4.2, equation 5.12.
    """
    inverse = cho_solve(cho_factor(alike + ridge * np.eye(len(alike))), np.eye(len(alike)))
    return (inverse @ wanted) / np.diag(inverse)[:, None]
