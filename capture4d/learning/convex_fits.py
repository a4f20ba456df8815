"""Convex combinations: what lies nearest to a point among all means of some others, weighted by shares that sum to 1.

Letters: N points, K of them to combine, D numbers of a point.

References: the greedy choice of prototypes is that of TailorNet (CVPR 2020), section 4.4; the fits are exact here, by
non-negative least squares (Lawson and Hanson, Solving Least Squares Problems, 1974, chapter 23).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Float64
from scipy.optimize import nnls

__all__ = ["convex_weights", "furthest_first"]

HEAVY = 1e3
"""Weight of the row that makes shares sum to 1, over the largest coordinate."""


def convex_weights(points: Float[np.ndarray, "K D"], target: Float[np.ndarray, " D"]) -> Float64[np.ndarray, " K"]:
    """Shares of the points, none negative, all together 1, whose weighted mean lies nearest to the target."""
    origin = points.mean(axis=0, dtype=np.float64)
    rows, wanted = points - origin, target - origin
    if rows.shape[1] > len(rows):  # the same problem within the span of the points
        turned, _ = np.linalg.qr(rows.T)
        rows, wanted = rows @ turned, wanted @ turned
    scale = max(float(np.abs(rows).max(initial=0.0)), float(np.abs(wanted).max(initial=0.0)), 1e-12)
    system = np.vstack([rows.T / scale, np.full(len(rows), HEAVY)])
    shares, _ = nnls(system, np.append(wanted / scale, HEAVY))
    return shares / shares.sum()


def furthest_first(
    points: Float[np.ndarray, "N D"],
    start: Sequence[int],
    count: int,
    distance: Callable[[np.ndarray, np.ndarray], float],
) -> tuple[list[int], list[tuple[float, float]]]:
    """Choose points so that convex combinations of them come near all others: always the worst fitted one is added.

    Args:
        start: indices of those that are chosen from the beginning.
        count: to choose in all.
        distance: between a point and what was fitted to it.
    Returns:
        Indices in the order of choice; and the worst and the mean distance of all points with the first `len(start)` of
        them, with one more, and so on.
    """
    assert start, "a greedy choice begins with something"
    centred = points - points.mean(axis=0, dtype=np.float64)
    left, values, _ = np.linalg.svd(centred, full_matrices=False)
    coordinates = left * values  # lengths and distances are kept, in N numbers instead of D
    chosen, errors = list(start), []
    while True:
        fits = (convex_weights(coordinates[chosen], each) for each in coordinates)
        off = np.array([distance(point, shares @ points[chosen]) for point, shares in zip(points, fits, strict=True)])
        errors.append((float(off.max()), float(off.mean())))
        left_over = np.setdiff1d(np.arange(len(points)), chosen)
        if len(chosen) >= count or not len(left_over):
            return chosen, errors
        chosen.append(int(left_over[np.argmax(off[left_over])]))
