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

from capture4d.heavy_imports import njit

__all__ = [
    "BlockTerm",
    "EdgeTerm",
    "RowTerm",
    "Rows",
    "SmoothTerm",
    "add_block_diagonal",
    "gauss_newton_step",
    "rows_product",
    "rows_transpose",
]


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


@njit(cache=True)
def conjugate_gradients(rows, edges, there, back, weight, hessian, inverse, gradient, tolerance, max_iterations):
    """(J^T M J + H) X = -g with block-Jacobi preconditioning; the step and the number of iterations."""
    step = np.zeros_like(gradient)
    residual = -gradient
    if dot(residual, residual) == 0.0:
        return step, 0
    conditioned, image = np.zeros_like(residual), np.zeros_like(residual)
    smoothed = np.zeros((len(there[0]) - 1, 3))
    block_products(inverse, residual, conditioned)
    direction = conditioned.copy()
    energy = dot(residual, conditioned)
    target = energy * tolerance**2
    along, pushed, moved = direction.ravel(), image.ravel(), step.ravel()
    left, ready = residual.ravel(), conditioned.ravel()
    for iteration in range(1, max_iterations + 1):
        block_products(hessian, direction, image)
        if direction.shape[2] == 1:
            normal_product_points(rows[0], rows[1], rows[2][:, 0], rows[3], direction[:, :, 0], image[:, :, 0])
            edges_product(edges[0], edges[1], direction[:, :, 0], image[:, :, 0])
            gathered(there, 1.0, direction[:, :, 0], smoothed, False)
            gathered(back, weight, smoothed, image[:, :, 0], True)
        else:
            normal_product_affine(rows[0], rows[1], rows[2], rows[3], direction, image)
        length = energy / dot(direction, image)
        for n in range(len(along)):
            moved[n] += length * along[n]
            left[n] -= length * pushed[n]
        block_products(inverse, residual, conditioned)
        previous, energy = energy, dot(residual, conditioned)
        if energy <= target:
            return step, iteration
        for n in range(len(along)):
            along[n] = along[n] * (energy / previous) + ready[n]
    return step, max_iterations


@njit(cache=True)
def edges_add(edges, directions, residual, diagonal, gradient):
    """The diagonal blocks of an edge term, and its gradient, on what is there."""
    for e in range(len(edges)):
        for end in range(2):
            block, sign = edges[e, end], 2 * end - 1
            for i in range(3):
                gradient[block, i, 0] += sign * directions[e, i] * residual[e]
                for j in range(3):
                    diagonal[block, i, j] += directions[e, i] * directions[e, j]


@njit(cache=True)
def edges_product(edges, directions, points, result):
    """result += J^T J X of an edge term."""
    for e in range(len(edges)):
        start, end = edges[e, 0], edges[e, 1]
        a, b, c = directions[e, 0], directions[e, 1], directions[e, 2]
        longer = (
            a * (points[end, 0] - points[start, 0])
            + b * (points[end, 1] - points[start, 1])
            + c * (points[end, 2] - points[start, 2])
        )
        a, b, c = a * longer, b * longer, c * longer
        result[start, 0] -= a
        result[start, 1] -= b
        result[start, 2] -= c
        result[end, 0] += a
        result[end, 1] += b
        result[end, 2] += c


@njit(cache=True)
def gathered(rows, factor, points, result, on_top):
    """factor sum_n x_n c_kn of points for every row k, added or set."""
    offsets, columns, coefficients = rows
    for row in range(len(offsets) - 1):
        a, b, c = 0.0, 0.0, 0.0
        for entry in range(offsets[row], offsets[row + 1]):
            n, share = columns[entry], coefficients[entry]
            a += points[n, 0] * share
            b += points[n, 1] * share
            c += points[n, 2] * share
        if on_top:
            result[row, 0] += factor * a
            result[row, 1] += factor * b
            result[row, 2] += factor * c
        else:
            result[row, 0], result[row, 1], result[row, 2] = factor * a, factor * b, factor * c


@njit(cache=True)
def dot(left, right):
    """Inner product in a fixed order; a threaded BLAS would let its thread count into the result."""
    flat_left, flat_right = left.ravel(), right.ravel()
    total = 0.0
    for n in range(len(flat_left)):
        total += flat_left[n] * flat_right[n]
    return total


@njit(cache=True)
def rows_product(offsets, columns, coefficients, blocks):
    """sum_n X_n c_kn."""
    rows, width = len(offsets) - 1, coefficients.shape[1]
    result = np.zeros((rows, 3))
    for row in range(rows):
        for entry in range(offsets[row], offsets[row + 1]):
            column = columns[entry]
            for axis in range(3):
                value = 0.0
                for b in range(width):
                    value += blocks[column, axis, b] * coefficients[entry, b]
                result[row, axis] += value
    return result


@njit(cache=True)
def rows_transpose(offsets, columns, coefficients, metric, residual, result):
    """result += sum_k J_k^T M_k r_k."""
    rows, width = len(offsets) - 1, coefficients.shape[1]
    for row in range(rows):
        m, r = metric[row], residual[row]
        p0 = m[0, 0] * r[0] + m[0, 1] * r[1] + m[0, 2] * r[2]
        p1 = m[1, 0] * r[0] + m[1, 1] * r[1] + m[1, 2] * r[2]
        p2 = m[2, 0] * r[0] + m[2, 1] * r[1] + m[2, 2] * r[2]
        if p0 == 0.0 and p1 == 0.0 and p2 == 0.0:
            continue
        for entry in range(offsets[row], offsets[row + 1]):
            column = columns[entry]
            for b in range(width):
                c = coefficients[entry, b]
                result[column, 0, b] += p0 * c
                result[column, 1, b] += p1 * c
                result[column, 2, b] += p2 * c


@njit(cache=True)
def normal_product_points(offsets, columns, coefficients, metric, points, result):
    """result += J^T M J X of blocks that are points, one row after the other: where the time goes."""
    for row in range(len(offsets) - 1):
        r0, r1, r2 = 0.0, 0.0, 0.0
        for entry in range(offsets[row], offsets[row + 1]):
            column, c = columns[entry], coefficients[entry]
            r0 += points[column, 0] * c
            r1 += points[column, 1] * c
            r2 += points[column, 2] * c
        p0 = metric[row, 0] * r0 + metric[row, 1] * r1 + metric[row, 2] * r2
        p1 = metric[row, 1] * r0 + metric[row, 3] * r1 + metric[row, 4] * r2
        p2 = metric[row, 2] * r0 + metric[row, 4] * r1 + metric[row, 5] * r2
        for entry in range(offsets[row], offsets[row + 1]):
            column, c = columns[entry], coefficients[entry]
            result[column, 0] += p0 * c
            result[column, 1] += p1 * c
            result[column, 2] += p2 * c


@njit(cache=True)
def normal_product_affine(offsets, columns, coefficients, metric, nodes, result):
    """The same of blocks that are affine maps."""
    for row in range(len(offsets) - 1):
        r0, r1, r2 = 0.0, 0.0, 0.0
        for entry in range(offsets[row], offsets[row + 1]):
            n = columns[entry]
            a, b, c, d = coefficients[entry, 0], coefficients[entry, 1], coefficients[entry, 2], coefficients[entry, 3]
            r0 += nodes[n, 0, 0] * a + nodes[n, 0, 1] * b + nodes[n, 0, 2] * c + nodes[n, 0, 3] * d
            r1 += nodes[n, 1, 0] * a + nodes[n, 1, 1] * b + nodes[n, 1, 2] * c + nodes[n, 1, 3] * d
            r2 += nodes[n, 2, 0] * a + nodes[n, 2, 1] * b + nodes[n, 2, 2] * c + nodes[n, 2, 3] * d
        p0 = metric[row, 0] * r0 + metric[row, 1] * r1 + metric[row, 2] * r2
        p1 = metric[row, 1] * r0 + metric[row, 3] * r1 + metric[row, 4] * r2
        p2 = metric[row, 2] * r0 + metric[row, 4] * r1 + metric[row, 5] * r2
        for entry in range(offsets[row], offsets[row + 1]):
            n = columns[entry]
            for k in range(4):
                c = coefficients[entry, k]
                result[n, 0, k] += p0 * c
                result[n, 1, k] += p1 * c
                result[n, 2, k] += p2 * c


@njit(cache=True)
def add_block_diagonal(offsets, columns, coefficients, metric, diagonal):
    """diagonal += the diagonal blocks of J^T M J. A row must not name a block twice."""
    rows, width = len(offsets) - 1, coefficients.shape[1]
    for row in range(rows):
        m = metric[row]
        if m[0, 0] == 0.0 and m[1, 1] == 0.0 and m[2, 2] == 0.0:
            continue
        for entry in range(offsets[row], offsets[row + 1]):
            block = diagonal[columns[entry]]
            for b in range(width):
                for d in range(width):
                    weight = coefficients[entry, b] * coefficients[entry, d]
                    for i in range(3):
                        for j in range(3):
                            block[i * width + b, j * width + d] += weight * m[i, j]


@njit(cache=True)
def upper_triangles(metric):
    """The six numbers of symmetric 3x3 matrices."""
    result = np.empty((len(metric), 6))
    for n in range(len(metric)):
        result[n, 0], result[n, 1], result[n, 2] = metric[n, 0, 0], metric[n, 0, 1], metric[n, 0, 2]
        result[n, 3], result[n, 4], result[n, 5] = metric[n, 1, 1], metric[n, 1, 2], metric[n, 2, 2]
    return result


@njit(cache=True)
def invert_points(matrices):
    """Inverses of symmetric positive 3x3 matrices, by their adjugates."""
    result = np.empty_like(matrices)
    for n in range(len(matrices)):
        a, b, c = matrices[n, 0, 0], matrices[n, 0, 1], matrices[n, 0, 2]
        d, e, f = matrices[n, 1, 1], matrices[n, 1, 2], matrices[n, 2, 2]
        aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
        scale = 1.0 / (a * aa + b * bb + c * cc)
        result[n, 0, 0] = aa * scale
        result[n, 0, 1] = result[n, 1, 0] = bb * scale
        result[n, 0, 2] = result[n, 2, 0] = cc * scale
        result[n, 1, 1] = (a * f - c * c) * scale
        result[n, 1, 2] = result[n, 2, 1] = (b * c - a * e) * scale
        result[n, 2, 2] = (a * d - b * b) * scale
    return result


@njit(cache=True)
def block_products(matrices, blocks, result):
    """H_n X_n, block by block, on the flattened blocks."""
    count, size = matrices.shape[0], matrices.shape[1]
    flat, out = blocks.reshape(count, size), result.reshape(count, size)
    for n in range(count):
        for i in range(size):
            value = 0.0
            for j in range(size):
                value += matrices[n, i, j] * flat[n, j]
            out[n, i] = value
