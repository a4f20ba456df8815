"""Principal directions of many long rows: exactly in memory, or block by block.

Letters: N rows (frames), D columns (3 V), K directions. Rows come from a function, a block at a time, so that a take
need not fit into memory and may be filled in on the way.

References: Halko, Martinsson, Tropp, Finding Structure with Randomness (SIAM Review 2011), algorithms 4.4 and 5.1;
subspace iterations go on until the directions stand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float, Float64
from scipy.linalg import svd

__all__ = ["blocks", "exact_directions", "main_directions", "randomised_directions"]

Rows = Callable[[slice], np.ndarray]
"""Rows (B, D) float64 of a slice of the frames, centred."""

OVERSAMPLING = 24
"""Directions in the random subspace beyond those wanted, at least; else half as many again. The last settle slowly."""
SETTLED = 1e-7
"""A direction v with singular value s stands when |A^T A v - s^2 v| is below this share of s^2, ..."""
ROUNDING = 1e-13
"""... or below this share of the largest square, where no digits are left."""
MOST_ITERATIONS = 100
BLOCK_NUMBERS = 8_000_000
"""Numbers of a block: 64 MB."""


def blocks(count: int, columns: int) -> Iterator[slice]:
    """Slices of the rows that are read together."""
    size = max(1, BLOCK_NUMBERS // max(columns, 1))
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))


def exact_directions(
    rows: Rows, count: int, columns: int, wanted: int
) -> tuple[Float64[np.ndarray, "shapes columns"], Float64[np.ndarray, " shapes"]]:
    """Right singular vectors and singular values of the rows, by a plain SVD.

    Directions without extent are left out, so that there may be fewer than wanted.
    """
    matrix = np.concatenate([rows(block) for block in blocks(count, columns)])
    _, values, vectors = svd(matrix, full_matrices=False, overwrite_a=True, check_finite=False)
    kept = min(wanted, _rank(values, count, columns))
    return _fixed_signs(vectors[:kept]), values[:kept]


def randomised_directions(
    rows: Rows, count: int, columns: int, wanted: int, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "shapes columns"], Float64[np.ndarray, " shapes"]]:
    """The same by subspace iteration; reads the rows once an iteration and holds O((D + N) K) numbers."""
    size = min(wanted + max(OVERSAMPLING, wanted // 2), count, columns)
    basis = np.linalg.qr(rng.standard_normal((columns, size)))[0]
    for _ in range(MOST_ITERATIONS):
        image, gram = np.zeros((columns, size)), np.zeros((size, size))
        for block in blocks(count, columns):
            part = rows(block)
            scores = part @ basis
            image += part.T @ scores
            gram += scores.T @ scores
        squares, rotation = np.linalg.eigh(gram)
        squares, rotation = squares[::-1], rotation[:, ::-1]
        image, ritz = image @ rotation, basis @ rotation
        residual = np.linalg.norm(image[:, :wanted] - ritz[:, :wanted] * squares[:wanted], axis=0)
        basis = np.linalg.qr(image)[0]
        if np.all(residual <= np.maximum(SETTLED * squares[:wanted], ROUNDING * squares[0])):
            break
    # The squares above lose half of the digits; a plain SVD of the rows in the subspace does not.
    scores = np.concatenate([rows(block) @ basis for block in blocks(count, columns)])
    _, values, rotation = svd(scores, full_matrices=False, overwrite_a=True, check_finite=False)
    kept = min(wanted, _rank(values, count, columns))
    return _fixed_signs(rotation[:kept] @ basis.T), values[:kept]


def main_directions(rows: Float64[np.ndarray, "rows columns"], kept: float) -> Float64[np.ndarray, "rows directions"]:
    """Rows along as many of their principal directions as hold a share of their square: about the same lengths and
    distances in fewer numbers."""
    left, values, _ = np.linalg.svd(rows, full_matrices=False)
    held = np.cumsum(values**2) / max(float((values**2).sum()), 1e-30)
    return (left * values)[:, : int(np.searchsorted(held, kept)) + 1]


def _rank(values: Float[np.ndarray, " values"], count: int, columns: int) -> int:
    """Directions that are not rounding errors."""
    floor = np.finfo(np.float64).eps * max(count, columns) * values.max(initial=0.0)
    return int((values > floor).sum())


def _fixed_signs(vectors: Float64[np.ndarray, "shapes columns"]) -> Float64[np.ndarray, "shapes columns"]:
    """The largest entry of each direction positive: a direction's sign means nothing, but should stay."""
    if not len(vectors):
        return vectors
    largest = np.argmax(np.abs(vectors), axis=1)
    return vectors * np.sign(vectors[np.arange(len(vectors)), largest])[:, None]
