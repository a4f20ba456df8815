"""Gradients against finite differences; energies that vanish where they must."""

import numpy as np
from scipy.spatial.transform import Rotation

from registration.energies import plane_metric, rigid_term, stretch_metric, stretch_term, tangential_metric


def rigid_energy(nodes: np.ndarray, weight: float, spacing: float) -> float:
    """Half the energy, written as the definition reads."""
    linear = nodes[:, :, :3]
    excess = linear.transpose(0, 2, 1) @ linear - np.eye(3)
    return 0.5 * weight * spacing**2 * float((excess**2).sum()) / len(nodes)


def test_rigid_gradient_and_curvature() -> None:
    rng = np.random.default_rng(0)
    nodes = np.tile(np.eye(3, 4), (3, 1, 1)) + 0.2 * rng.standard_normal((3, 3, 4))
    term = rigid_term(nodes, weight=3.0, spacing=0.5)
    step = 1e-6
    for n, i, b in [(0, 0, 0), (1, 2, 1), (2, 1, 2), (0, 1, 3)]:
        more, less = nodes.copy(), nodes.copy()
        more[n, i, b] += step
        less[n, i, b] -= step
        slope = (rigid_energy(more, 3.0, 0.5) - rigid_energy(less, 3.0, 0.5)) / (2 * step)
        np.testing.assert_allclose(term.gradient[n, 4 * i + b], slope, atol=1e-7)
    np.testing.assert_allclose(term.hessian, term.hessian.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(term.hessian).min() > -1e-12


def test_rotations_cost_nothing() -> None:
    rotations = Rotation.random(5, random_state=1).as_matrix()
    nodes = np.concatenate([rotations, np.ones((5, 3, 1))], axis=2)
    np.testing.assert_allclose(rigid_term(nodes, weight=1.0, spacing=1.0).gradient, 0, atol=1e-12)


def test_stretch_gradient() -> None:
    rng = np.random.default_rng(2)
    ends, rest = rng.standard_normal((6, 3)), rng.uniform(0.5, 2.0, 6)

    def energy(vectors: np.ndarray) -> float:
        excess = np.linalg.norm(vectors, axis=1) - rest
        return 0.5 * 4.0 / 6 * float((np.where(excess > 0, 1.0, 0.3) * excess**2).sum())

    metric, residual = stretch_metric(ends, rest, weight=4.0, compression=0.3)
    gradient = np.einsum("eab,eb->ea", metric, residual)
    vertices = np.concatenate([np.zeros((6, 3)), ends])
    term = stretch_term(
        vertices, np.column_stack([np.arange(6), np.arange(6, 12)]).astype(np.int32), rest, weight=4.0, compression=0.3
    )
    np.testing.assert_allclose(term.directions * term.residual[:, None], gradient, rtol=1e-12)
    np.testing.assert_allclose(term.directions[:, :, None] * term.directions[:, None, :], metric, rtol=1e-12)
    for edge, axis in [(0, 0), (2, 1), (5, 2)]:
        more, less = ends.copy(), ends.copy()
        more[edge, axis] += 1e-6
        less[edge, axis] -= 1e-6
        np.testing.assert_allclose(gradient[edge, axis], (energy(more) - energy(less)) / 2e-6, rtol=1e-5, atol=1e-8)


def test_metrics_measure_what_they_are_called() -> None:
    normal, tangent = np.array([[0.0, 0.0, 1.0]]), np.array([3.0, 4.0, 0.0])
    weights = np.array([2.0])
    assert tangent @ plane_metric(normal, weights, 0.0)[0] @ tangent == 0
    assert tangent @ plane_metric(normal, weights, 1.0)[0] @ tangent == 50
    assert tangent @ tangential_metric(normal, weights)[0] @ tangent == 50
    assert normal[0] @ tangential_metric(normal, weights)[0] @ normal[0] == 0
