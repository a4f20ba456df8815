"""Similarities are recovered, reflections are not invented."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from capture4d.types import Mesh
from registration.alignment import align, fit_similarity


@pytest.mark.parametrize("seed", range(4))
def test_pairs_give_the_similarity_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, rotation, shift = rng.standard_normal((20, 3)), Rotation.random(random_state=seed), rng.standard_normal(3)
    found = fit_similarity(points, 2.5 * rotation.apply(points) + shift, with_scale=True)
    assert found.scale == pytest.approx(2.5)
    np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-10)
    np.testing.assert_allclose(found.translation, shift, atol=1e-10)


def test_a_mirrored_cloud_is_met_by_a_rotation() -> None:
    points = np.random.default_rng(0).standard_normal((30, 3))
    found = fit_similarity(points, points * [-1, 1, 1], with_scale=False)
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    assert found.scale == 1


@pytest.mark.parametrize("seed", range(3))
def test_alignment_from_any_pose(tube: Callable[[int, int], Mesh], seed: int) -> None:
    """A tube with an uneven section, and a cone's taper to tell its ends apart."""

    def tapered(mesh: Mesh) -> np.ndarray:
        taper = 1 + mesh.vertices[:, 1:2]
        return mesh.vertices.astype(float) * np.concatenate([taper, np.ones_like(taper), taper], axis=1)

    motion = Rotation.random(random_state=seed)
    scan = 1.3 * motion.apply(tapered(tube(90, 45))) + [3.0, -1.0, 0.5]
    found = align(tapered(tube(36, 18)), scan, with_scale=True)
    assert found.scale == pytest.approx(1.3, rel=0.02)
    distance = KDTree(scan).query(found.apply(tapered(tube(36, 18))))[0]
    assert distance.mean() < 0.008


def test_an_aligned_pair_stays(tube: Callable[[int, int], Mesh]) -> None:
    mesh = tube(36, 18).vertices.astype(float)
    found = align(mesh, tube(36, 18).vertices.astype(float), with_scale=False)
    np.testing.assert_allclose(found.apply(mesh), mesh, atol=1e-6)


def test_what_turns_less_counts_where_both_lie_as_near() -> None:
    angle, height = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 2 * np.pi, 60), np.linspace(0, 0.7, 30)))
    tube = np.stack([0.25 * np.cos(angle), height, 0.12 * np.sin(angle)], axis=1)
    dent = 0.003 * np.clip(np.sin(angle), 0, 1)[:, None] * np.array([0, 0, 1.0])
    behind = 0.003 * np.clip(-np.sin(angle), 0, 1)[:, None] * np.array([0, 0, -1.0])  # turned by 180 degrees it fits
    folds = 0.015 * np.sin(9 * angle + 20 * height)[:, None] * (tube * [1, 0, 1]) / 0.2

    moved = align(tube + dent, tube + behind + folds + np.array([0.2, 0.3, 0.0]), with_scale=False)

    assert np.trace(moved.rotation) > 2.9
