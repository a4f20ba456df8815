"""The compiled loops of `registration.solver`, in a fixed order on one thread; they take plain arrays."""

from __future__ import annotations

import numpy as np

from capture4d.heavy_imports import njit

__all__ = [
    "add_block_diagonal",
    "block_products",
    "conjugate_gradients",
    "dot",
    "edges_add",
    "edges_product",
    "gathered",
    "invert_points",
    "normal_product_affine",
    "normal_product_points",
    "rows_product",
    "rows_transpose",
    "upper_triangles",
]


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
