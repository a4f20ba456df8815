"""The matrix-free step against the matrix it avoids."""

import numpy as np
import pytest

from registration.solver import BlockTerm, EdgeTerm, Rows, RowTerm, SmoothTerm, gauss_newton_step
from registration.solver_loops import (
    add_block_diagonal,
    invert_points,
    normal_product_affine,
    normal_product_points,
    rows_transpose,
    upper_triangles,
)

BLOCKS, ROWS = 7, 30


def random_term(rng: np.random.Generator, width: int) -> RowTerm:
    counts = rng.integers(1, 4, ROWS)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    columns = np.concatenate([rng.choice(BLOCKS, count, replace=False) for count in counts]).astype(np.int32)
    root = rng.standard_normal((ROWS, 3, 3))
    metric = root @ root.transpose(0, 2, 1)
    rows = Rows(offsets, columns, rng.standard_normal((len(columns), width)))
    return RowTerm(rows, metric, rng.standard_normal((ROWS, 3)))


def dense_jacobian(rows: Rows, width: int) -> np.ndarray:
    """One entry after the other: (3 rows, 3 width blocks)."""
    jacobian = np.zeros((3 * len(rows), BLOCKS * 3 * width))
    for row in range(len(rows)):
        for entry in range(rows.offsets[row], rows.offsets[row + 1]):
            for axis in range(3):
                for b in range(width):
                    column = (rows.columns[entry] * 3 + axis) * width + b
                    jacobian[3 * row + axis, column] += rows.coefficients[entry, b]
    return jacobian


def dense_metric(term: RowTerm) -> np.ndarray:
    metric = np.zeros((3 * ROWS, 3 * ROWS))
    for row in range(ROWS):
        metric[3 * row : 3 * row + 3, 3 * row : 3 * row + 3] = term.metric[row]
    return metric


def normal_product(term: RowTerm, blocks: np.ndarray) -> np.ndarray:
    """J^T M J X."""
    rows, image = term.rows, np.zeros_like(blocks)
    if blocks.shape[2] == 1:
        normal_product_points(
            rows.offsets, rows.columns, rows.coefficients[:, 0], upper_triangles(term.metric),
            blocks[:, :, 0], image[:, :, 0],
        )  # fmt: skip
    else:
        normal_product_affine(
            rows.offsets, rows.columns, rows.coefficients, upper_triangles(term.metric), blocks, image
        )
    return image


@pytest.mark.parametrize("width", [1, 4])
def test_products_equal_the_assembled_matrix(width: int) -> None:
    rng = np.random.default_rng(width)
    term = random_term(rng, width)
    jacobian, metric = dense_jacobian(term.rows, width), dense_metric(term)
    hessian = jacobian.T @ metric @ jacobian
    rows = (term.rows.offsets, term.rows.columns, term.rows.coefficients)

    x = rng.standard_normal((BLOCKS, 3, width))
    image = normal_product(term, x)
    np.testing.assert_allclose(image.ravel(), hessian @ x.ravel(), rtol=1e-12, atol=1e-12)

    gradient = np.zeros_like(x)
    rows_transpose(*rows, term.metric, term.residual, gradient)
    np.testing.assert_allclose(gradient.ravel(), jacobian.T @ metric @ term.residual.ravel(), rtol=1e-12, atol=1e-12)

    size = 3 * width
    diagonal = np.zeros((BLOCKS, size, size))
    add_block_diagonal(*rows, term.metric, diagonal)
    for n in range(BLOCKS):
        block = hessian[n * size : (n + 1) * size, n * size : (n + 1) * size]
        np.testing.assert_allclose(diagonal[n], block, rtol=1e-12, atol=1e-12)

    np.testing.assert_allclose(term.rows.apply(x).ravel(), jacobian @ x.ravel(), rtol=1e-12, atol=1e-12)


def test_normal_product_is_symmetric_and_never_negative() -> None:
    rng = np.random.default_rng(3)
    term = random_term(rng, 4)
    for _ in range(5):
        x, y = rng.standard_normal((2, BLOCKS, 3, 4))
        image_x, image_y = normal_product(term, x), normal_product(term, y)
        assert np.vdot(y, image_x) == pytest.approx(np.vdot(x, image_y), rel=1e-10)
        assert np.vdot(x, image_x) >= 0


@pytest.mark.parametrize("width", [1, 4])
def test_step_solves_the_normal_equations(width: int) -> None:
    rng = np.random.default_rng(10 + width)
    term = random_term(rng, width)
    size = 3 * width
    root = rng.standard_normal((BLOCKS, size, size))
    block = BlockTerm(root @ root.transpose(0, 2, 1) + np.eye(size), rng.standard_normal((BLOCKS, size)))

    step, _ = gauss_newton_step([term], block, BLOCKS, damping=0.0, tolerance=1e-12, max_iterations=500)

    jacobian, metric = dense_jacobian(term.rows, width), dense_metric(term)
    hessian = jacobian.T @ metric @ jacobian
    for n in range(BLOCKS):
        hessian[n * size : (n + 1) * size, n * size : (n + 1) * size] += block.hessian[n]
    gradient = jacobian.T @ metric @ term.residual.ravel() + block.gradient.ravel()
    np.testing.assert_allclose(step.ravel(), -np.linalg.solve(hessian, gradient), rtol=1e-6, atol=1e-8)


def test_terms_without_metrics_are_what_they_would_be_with_them() -> None:
    """Lengths of edges, and smoothness, beside the same as rows with metrics; data on single points beside rows."""
    rng = np.random.default_rng(20)
    edges = np.array([(a, b) for a in range(BLOCKS) for b in range(a)], np.int32)
    directions, length = rng.standard_normal((len(edges), 3)), rng.standard_normal(len(edges))
    both = Rows(
        np.arange(0, 2 * len(edges) + 1, 2, dtype=np.int32), edges.reshape(-1),
        np.tile([-1.0, 1.0], len(edges))[:, None],
    )  # fmt: skip
    squares = (directions**2).sum(axis=1)
    along = RowTerm(both, directions[:, :, None] * directions[:, None, :], (length / squares)[:, None] * directions)
    rough = random_term(rng, 1)
    even = RowTerm(rough.rows, np.tile(0.7 * np.eye(3), (ROWS, 1, 1)), rough.residual)
    smooth = SmoothTerm(rough.rows, rough.rows.transposed(BLOCKS), 0.7, rough.residual)
    some = np.array([5, 0, 3], np.int32)
    root = rng.standard_normal((3, 3, 3))
    metric, residual = root @ root.transpose(0, 2, 1), rng.standard_normal((3, 3))
    plain = Rows(np.arange(4, dtype=np.int32), some, np.ones((3, 1)))

    def solved(terms: list) -> np.ndarray:
        return gauss_newton_step(terms, None, BLOCKS, damping=1e-6, tolerance=1e-12, max_iterations=500)[0]

    quick = solved([RowTerm(Rows.of_points(some), metric, residual), EdgeTerm(edges, directions, length), smooth])
    slow = solved([RowTerm(plain, metric, residual), along, even])
    np.testing.assert_allclose(quick, slow, rtol=1e-8, atol=1e-9)
    assert np.abs(quick).max() > 0.01


def test_a_block_without_residuals_stays() -> None:
    rows = Rows(np.array([0, 1], np.int32), np.array([0], np.int32), np.ones((1, 1)))
    term = RowTerm(rows, np.eye(3)[None], np.array([[1.0, 2.0, 3.0]]))
    step, _ = gauss_newton_step([term], None, 2, damping=1e-9, tolerance=1e-10, max_iterations=10)
    np.testing.assert_allclose(step[0, :, 0], [-1, -2, -3], rtol=1e-6)
    np.testing.assert_array_equal(step[1], 0)


def test_point_inverses() -> None:
    root = np.random.default_rng(4).standard_normal((20, 3, 3))
    matrices = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)
    np.testing.assert_allclose(invert_points(matrices), np.linalg.inv(matrices), rtol=1e-8, atol=1e-10)
