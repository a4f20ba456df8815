"""Matrix-free Gauss-Newton steps: knows residuals and unknown blocks, and no meshes.

Unknowns are N blocks X_n of shape (3, B): B = 1 for a free point, B = 4 for an affine map [A | t]. A residual row is a
3-vector that is linear in the blocks,

    r_k(X) = sum_n X_n c_kn + const,        c_kn of length B,

measured by a symmetric 3x3 metric M_k: a point-to-plane distance has M = w n n^T, a point-to-point one M = w I. Terms
that touch one block only and are not of this form come as a ready Hessian and gradient per block. Of points there are
two kinds of terms that need no metric, and so a third of the time: lengths of edges, and differences whose metric is
the same number for all. `Rows` holds the sparsity and is analysed once per template; a step never assembles J^T M J
but its diagonal blocks, which precondition.

All loops run in a fixed order on one thread: results do not depend on the number of workers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32, Integer

from registration.solver_loops import (
    add_block_diagonal,
    conjugate_gradients,
    edges_add,
    invert_points,
    rows_product,
    rows_transpose,
    upper_triangles,
)

__all__ = ["BlockTerm", "EdgeTerm", "RowTerm", "Rows", "SmoothTerm", "Term", "gauss_newton_step"]


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """The sparse linear map from blocks to 3-vectors, in compressed rows."""

    offsets: Int32[np.ndarray, " rows_plus_1"]
    columns: Int32[np.ndarray, " entries"]
    """Block of each entry."""
    coefficients: Float64[np.ndarray, "entries width"]
    """c_kn of each entry."""
    is_identity: bool = False
    """Every row is a block of width 1 by itself, and no block has two."""

    @staticmethod
    def of_points(points: Integer[np.ndarray, " rows"]) -> Rows:
        """Some points as they are, none of them twice."""
        count = len(points)
        return Rows(
            np.arange(count + 1, dtype=np.int32), points.astype(np.int32), np.ones((count, 1)), is_identity=True
        )

    def transposed(self, blocks: int) -> Rows:
        """The map from 3-vectors to so many blocks of width 1."""
        row = np.repeat(np.arange(len(self)), np.diff(self.offsets))
        order = np.argsort(self.columns, kind="stable")
        offsets = np.concatenate([[0], np.cumsum(np.bincount(self.columns, minlength=blocks))])
        return Rows(offsets.astype(np.int32), row[order].astype(np.int32), self.coefficients[order])

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def apply(self, blocks: Float64[np.ndarray, "blocks 3 width"]) -> Float64[np.ndarray, "rows 3"]:
        """sum_n X_n c_kn for every row k."""
        return rows_product(self.offsets, self.columns, self.coefficients, blocks)


@dataclass(frozen=True, slots=True, eq=False)
class RowTerm:
    """sum_k r_k^T M_k r_k at the current state."""

    rows: Rows
    metric: Float64[np.ndarray, "rows 3 3"]
    residual: Float64[np.ndarray, "rows 3"]


@dataclass(frozen=True, slots=True, eq=False)
class EdgeTerm:
    """sum_e (a_e . (x_end - x_start) + r_e)^2 of points, at the current state."""

    edges: Int32[np.ndarray, "edges 2"]
    """Start and end."""
    directions: Float64[np.ndarray, "edges 3"]
    """a_e, with the root of the weight in it."""
    residual: Float64[np.ndarray, " edges"]
    """r_e, with the same."""

    def with_others(self, others: EdgeTerm, chosen: Bool[np.ndarray, " edges"]) -> EdgeTerm:
        """The same with some of its edges from another term of the same edges."""
        directions = np.where(chosen[:, None], others.directions, self.directions)
        return EdgeTerm(self.edges, directions, np.where(chosen, others.residual, self.residual))


@dataclass(frozen=True, slots=True, eq=False)
class SmoothTerm:
    """w sum_k |r_k|^2 of points, at the current state."""

    rows: Rows
    columns: Rows
    """The same map, transposed."""
    weight: float
    residual: Float64[np.ndarray, "rows 3"]


Term = RowTerm | EdgeTerm | SmoothTerm


@dataclass(frozen=True, slots=True, eq=False)
class BlockTerm:
    """A quadratic model per block: x^T H x / 2 + g^T x, with H and g of the flattened block."""

    hessian: Float64[np.ndarray, "blocks size size"]
    gradient: Float64[np.ndarray, "blocks size"]


def gauss_newton_step(
    terms: Sequence[Term],
    block_term: BlockTerm | None,
    block_count: int,
    *,
    damping: float,
    tolerance: float,
    max_iterations: int,
) -> tuple[Float64[np.ndarray, "blocks 3 width"], int]:
    """Solve (sum J^T M J + H + damping D) X = -(sum J^T M r + g), D the diagonal, by block-Jacobi conjugate gradients.

    Args:
        terms: of one width; at most one of them smooths.
        damping: relative to the diagonal; keeps blocks that no residual touches in place.
    Returns:
        The step and the number of iterations.
    """
    row_terms = [term for term in terms if isinstance(term, RowTerm)]
    edge_terms = [term for term in terms if isinstance(term, EdgeTerm)]
    smooth_terms = [term for term in terms if isinstance(term, SmoothTerm)]
    rows = _stacked([term for term in row_terms if not term.rows.is_identity])
    width = 1 if edge_terms or smooth_terms or not len(rows.coefficients) else rows.coefficients.shape[1]
    size = 3 * width
    hessian, gradient = np.zeros((block_count, size, size)), np.zeros((block_count, 3, width))
    for term in row_terms:
        if term.rows.is_identity:
            hessian[term.rows.columns] += term.metric
            gradient[term.rows.columns, :, 0] += np.einsum("rab,rb->ra", term.metric, term.residual)
    if block_term is not None:
        hessian += block_term.hessian
        gradient += block_term.gradient.reshape(gradient.shape)
    diagonal = hessian.copy()
    add_block_diagonal(rows.offsets, rows.columns, rows.coefficients, rows.metric, diagonal)
    rows_transpose(rows.offsets, rows.columns, rows.coefficients, rows.metric, rows.residual, gradient)
    edges, directions = _NO_EDGES, _NO_DIRECTIONS
    if edge_terms:
        edges = np.concatenate([term.edges for term in edge_terms])
        directions = np.concatenate([term.directions for term in edge_terms])
        edges_add(edges, directions, np.concatenate([term.residual for term in edge_terms]), diagonal, gradient)
    there = back = Rows.of_points(np.zeros(0, np.int32))
    weight = 0.0
    for term in smooth_terms:
        there, back, weight = term.rows, term.columns, term.weight
        gradient[:, :, 0] += weight * back.apply(term.residual[:, :, None])
        own = np.add.reduceat(back.coefficients[:, 0] ** 2, back.offsets[:-1]) * (np.diff(back.offsets) > 0)
        diagonal += (weight * own)[:, None, None] * np.eye(3)
    axis = np.arange(size)
    floor = max(float(diagonal[:, axis, axis].max(initial=0.0)) * 1e-12, 1e-300)
    extra = damping * diagonal[:, axis, axis] + floor
    diagonal[:, axis, axis] += extra
    hessian[:, axis, axis] += extra
    inverse = invert_points(diagonal) if size == 3 else np.linalg.inv(diagonal)
    return conjugate_gradients(
        (rows.offsets, rows.columns.view(np.uint32), rows.coefficients, upper_triangles(rows.metric)),
        (edges.view(np.uint32), directions),
        (there.offsets, there.columns.view(np.uint32), there.coefficients[:, 0].copy()),
        (back.offsets, back.columns.view(np.uint32), back.coefficients[:, 0].copy()),
        weight, hessian, inverse, gradient, tolerance, max_iterations,
    )  # fmt: skip


_NO_EDGES, _NO_DIRECTIONS = np.zeros((0, 2), np.int32), np.zeros((0, 3))


@dataclass(frozen=True, slots=True, eq=False)
class _StackedRows:
    """The rows of several terms, those that measure something."""

    offsets: Int32[np.ndarray, " rows_plus_1"]
    columns: Int32[np.ndarray, " entries"]
    coefficients: Float64[np.ndarray, "entries width"]
    metric: Float64[np.ndarray, "rows 3 3"]
    residual: Float64[np.ndarray, "rows 3"]


def _stacked(terms: Sequence[RowTerm]) -> _StackedRows:
    """The rows of some terms after each other, without those whose metric is 0."""
    if not terms:
        nothing = np.zeros((0, 3))
        metric = np.zeros((0, 3, 3))
        return _StackedRows(np.zeros(1, np.int32), np.zeros(0, np.int32), nothing[:, :1], metric, nothing)
    rows = [term.rows for term in terms]
    metric = np.concatenate([term.metric for term in terms])
    residual = np.concatenate([term.residual for term in terms])
    columns = np.concatenate([each.columns for each in rows])
    coefficients = np.concatenate([each.coefficients for each in rows])
    lengths = np.concatenate([np.diff(each.offsets) for each in rows])
    kept = metric.reshape(-1, 9)[:, ::4].any(axis=1)
    if not kept.all():
        entries = np.repeat(kept, lengths)
        columns, coefficients, lengths = columns[entries], coefficients[entries], lengths[kept]
        metric, residual = metric[kept], residual[kept]
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    return _StackedRows(offsets, columns, coefficients, metric, residual)
