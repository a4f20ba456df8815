"""Matrix-free Gauss-Newton steps: knows residuals and unknown blocks, and no meshes.

Unknowns are N blocks X_n of shape (3, B): B = 1 for a free point, B = 4 for an affine map [A | t]. A residual row is a
3-vector that is linear in the blocks,

    r_k(X) = sum_n X_n c_kn + const,        c_kn of length B,

measured by a symmetric 3x3 metric M_k: a point-to-plane distance has M = w n n^T, a point-to-point one M = w I. Terms
that touch one block only and are not of this form come as a ready Hessian and gradient per block. `Rows` holds the
sparsity and is analysed once per template; a step never assembles J^T M J but its diagonal blocks, which precondition.

All loops run in a fixed order on one thread: results do not depend on the number of workers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32

from capture4d.heavy_imports import njit

__all__ = ["BlockTerm", "RowTerm", "Rows", "add_block_diagonal", "gauss_newton_step", "rows_product", "rows_transpose"]


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """The sparse linear map from blocks to 3-vectors, in compressed rows."""

    offsets: Int32[np.ndarray, " rows_plus_1"]
    columns: Int32[np.ndarray, " entries"]
    """Block of each entry."""
    coefficients: Float64[np.ndarray, "entries width"]
    """c_kn of each entry."""

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
class BlockTerm:
    """A quadratic model per block: x^T H x / 2 + g^T x, with H and g of the flattened block."""

    hessian: Float64[np.ndarray, "blocks size size"]
    gradient: Float64[np.ndarray, "blocks size"]


def gauss_newton_step(
    terms: Sequence[RowTerm],
    block_term: BlockTerm | None,
    block_count: int,
    *,
    damping: float,
    tolerance: float,
    max_iterations: int,
) -> tuple[Float64[np.ndarray, "blocks 3 width"], int]:
    """Solve (sum J^T M J + H + damping D) X = -(sum J^T M r + g), D the diagonal, by block-Jacobi conjugate gradients.

    Args:
        damping: relative to the diagonal; keeps blocks that no residual touches in place.
    Returns:
        The step and the number of iterations.
    """
    width = terms[0].rows.coefficients.shape[1]
    size = 3 * width
    diagonal = np.zeros((block_count, size, size))
    gradient = np.zeros((block_count, 3, width))
    for term in terms:
        add_block_diagonal(term.rows.offsets, term.rows.columns, term.rows.coefficients, term.metric, diagonal)
        rows_transpose(
            term.rows.offsets, term.rows.columns, term.rows.coefficients, term.metric, term.residual, gradient
        )
    hessian = np.zeros((0, size, size))
    if block_term is not None:
        hessian = block_term.hessian
        diagonal += hessian
        gradient += block_term.gradient.reshape(gradient.shape)
    axis = np.arange(size)
    floor = max(float(diagonal[:, axis, axis].max(initial=0.0)) * 1e-12, 1e-300)
    extra = damping * diagonal[:, axis, axis] + floor
    diagonal[:, axis, axis] += extra
    inverse = invert_points(diagonal) if size == 3 else np.linalg.inv(diagonal)

    def product(direction: np.ndarray) -> np.ndarray:
        result = extra.reshape(direction.shape) * direction
        if len(hessian):
            block_products(hessian, direction, result)
        for term in terms:
            rows_normal_product(
                term.rows.offsets, term.rows.columns, term.rows.coefficients, term.metric, direction, result
            )
        return result

    step = np.zeros_like(gradient)
    residual = -gradient
    start = dot(residual, residual)
    if start == 0.0:
        return step, 0
    conditioned = np.zeros_like(residual)
    block_products(inverse, residual, conditioned)
    direction = conditioned.copy()
    energy = dot(residual, conditioned)
    target = energy * tolerance**2
    for iteration in range(1, max_iterations + 1):
        image = product(direction)
        length = energy / dot(direction, image)
        step += length * direction
        residual -= length * image
        conditioned[:] = 0.0
        block_products(inverse, residual, conditioned)
        previous, energy = energy, dot(residual, conditioned)
        if energy <= target:
            return step, iteration
        direction *= energy / previous
        direction += conditioned
    return step, max_iterations


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


def rows_normal_product(offsets, columns, coefficients, metric, blocks, result):
    """result += J^T M J X, one row after the other: where the time goes, so each width has its own loop."""
    if coefficients.shape[1] == 1:
        normal_product_points(offsets, columns, coefficients[:, 0], metric, blocks[:, :, 0], result[:, :, 0])
    else:
        normal_product_affine(offsets, columns, coefficients, metric, blocks, result)


@njit(cache=True)
def normal_product_points(offsets, columns, coefficients, metric, points, result):
    """`rows_normal_product` of blocks that are points."""
    for row in range(len(offsets) - 1):
        r0, r1, r2 = 0.0, 0.0, 0.0
        for entry in range(offsets[row], offsets[row + 1]):
            column, c = columns[entry], coefficients[entry]
            r0 += points[column, 0] * c
            r1 += points[column, 1] * c
            r2 += points[column, 2] * c
        p0 = metric[row, 0, 0] * r0 + metric[row, 0, 1] * r1 + metric[row, 0, 2] * r2
        p1 = metric[row, 1, 0] * r0 + metric[row, 1, 1] * r1 + metric[row, 1, 2] * r2
        p2 = metric[row, 2, 0] * r0 + metric[row, 2, 1] * r1 + metric[row, 2, 2] * r2
        for entry in range(offsets[row], offsets[row + 1]):
            column, c = columns[entry], coefficients[entry]
            result[column, 0] += p0 * c
            result[column, 1] += p1 * c
            result[column, 2] += p2 * c


@njit(cache=True)
def normal_product_affine(offsets, columns, coefficients, metric, nodes, result):
    """`rows_normal_product` of blocks that are affine maps."""
    for row in range(len(offsets) - 1):
        if metric[row, 0, 0] == 0.0 and metric[row, 1, 1] == 0.0 and metric[row, 2, 2] == 0.0:
            continue
        r0, r1, r2 = 0.0, 0.0, 0.0
        for entry in range(offsets[row], offsets[row + 1]):
            n = columns[entry]
            a, b, c, d = coefficients[entry, 0], coefficients[entry, 1], coefficients[entry, 2], coefficients[entry, 3]
            r0 += nodes[n, 0, 0] * a + nodes[n, 0, 1] * b + nodes[n, 0, 2] * c + nodes[n, 0, 3] * d
            r1 += nodes[n, 1, 0] * a + nodes[n, 1, 1] * b + nodes[n, 1, 2] * c + nodes[n, 1, 3] * d
            r2 += nodes[n, 2, 0] * a + nodes[n, 2, 1] * b + nodes[n, 2, 2] * c + nodes[n, 2, 3] * d
        p0 = metric[row, 0, 0] * r0 + metric[row, 0, 1] * r1 + metric[row, 0, 2] * r2
        p1 = metric[row, 1, 0] * r0 + metric[row, 1, 1] * r1 + metric[row, 1, 2] * r2
        p2 = metric[row, 2, 0] * r0 + metric[row, 2, 1] * r1 + metric[row, 2, 2] * r2
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
    """result += H_n X_n, block by block, on the flattened blocks."""
    count, size = matrices.shape[0], matrices.shape[1]
    flat, out = blocks.reshape(count, size), result.reshape(count, size)
    for n in range(count):
        for i in range(size):
            value = 0.0
            for j in range(size):
                value += matrices[n, i, j] * flat[n, j]
            out[n, i] += value
