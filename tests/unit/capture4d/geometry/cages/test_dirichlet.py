"""Bases of a cage: they sum to one, keep within their values, and carry folds into the patch as the paper shows."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.cage_demos import BUMPS, FOLD_RATIO, SINE_HEIGHT, Patch, boundary, facing_down_percent, sine_exact
from capture4d.errors import InputError
from capture4d.geometry.cages.dirichlet import Extension, conductivity_along, dirichlet_form, flattened
from tests.shapes import tube


@pytest.mark.parametrize("seed", [0, 1])
def test_bases_sum_to_one_and_isotropic_ones_keep_within_their_values(seed: int) -> None:
    patch = Patch.jittered(24, np.random.default_rng(seed))
    for folds in (False, True):
        bases = patch.extension(folds=folds).bases()
        assert np.abs(bases.sum(axis=1) - 1).max() < 1e-12
        if not folds:
            assert bases.min() >= -1e-12
            assert bases.max() <= 1 + 1e-12


def test_the_isotropic_form_is_the_cotangent_laplacian() -> None:
    mesh = tube(9, 6)
    vertices = mesh.vertices.astype(float) + 0.004 * np.random.default_rng(0).standard_normal((54, 3))
    expected = np.zeros((54, 54))
    for face in mesh.faces:
        for k in range(3):
            a, b, c = face[[k, (k + 1) % 3, (k + 2) % 3]]
            first, second = vertices[b] - vertices[a], vertices[c] - vertices[a]
            cotangent = (first @ second) / np.linalg.norm(np.cross(first, second)) / 2
            expected[[b, c], [c, b]] -= cotangent
            expected[[b, c], [b, c]] += cotangent
    found = dirichlet_form(mesh.faces, flattened(vertices, mesh.faces), 54).toarray()
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("folds", [False, True])
def test_linear_values_are_carried_exactly(folds: bool) -> None:
    patch = Patch.jittered(12, np.random.default_rng(2))
    values = patch.points @ np.array([[1.0, -2.0], [0.5, 3.0]])
    np.testing.assert_allclose(patch.extension(folds=folds)(values[patch.border]), values, atol=1e-10)


@pytest.mark.parametrize(("folds", "limit"), [(False, 0.004), (True, 0.04)])
def test_a_sine_is_carried_as_the_differential_equation_has_it(folds: bool, limit: float) -> None:
    """z_xx + ratio z_yy = 0 has a closed solution; the error falls with the mesh."""
    errors = []
    for side in (28, 56):
        patch = Patch.jittered(side, np.random.default_rng(0))
        moved = patch.extension(folds=folds)(boundary("sine", patch.points[patch.border]))
        exact = sine_exact(patch.points, FOLD_RATIO if folds else 1.0)
        errors.append(float(np.sqrt(np.mean((moved[:, 2] - exact) ** 2))) / SINE_HEIGHT)
    assert errors[1] < limit
    assert errors[1] < 0.5 * errors[0]


def test_folds_run_across_the_patch_and_a_leaning_bump_turns_over() -> None:
    """Jin et al., Figs. 20, 21 and 23: what isotropic bases flatten, anisotropic ones carry from side to side."""
    patch = Patch.jittered(56, np.random.default_rng(3))
    places = patch.points[patch.border]
    plain, folds = patch.extension(folds=False), patch.extension(folds=True)
    for demo, side in BUMPS.items():
        middle = [patch.height_at(each(boundary(demo, places)), 0.5, 0.5) / side for each in (plain, folds)]
        assert middle[0] < 0.1
        assert middle[1] > 0.35
    turned = [
        facing_down_percent(patch.surface(each(boundary("wave", places))), patch.faces) for each in (plain, folds)
    ]
    assert turned[0] < 2
    assert 13 < turned[1] < 16


def test_conductivity_is_symmetric_and_stretches_one_direction() -> None:
    tensor = conductivity_along(np.array([3.0, 4.0]), 9.0)
    np.testing.assert_allclose(tensor, tensor.T)
    np.testing.assert_allclose(tensor @ [0.6, 0.8], [5.4, 7.2])
    np.testing.assert_allclose(tensor @ [-0.8, 0.6], [-0.8, 0.6])


def test_parts_without_a_cage_are_refused_and_faces_without_area_are_not() -> None:
    patch = Patch.jittered(6, np.random.default_rng(0))
    count = len(patch.points)
    twice = np.concatenate([patch.faces, patch.faces + count])
    form = dirichlet_form(twice, np.concatenate([patch.points, patch.points])[twice], 2 * count)
    with pytest.raises(InputError, match=f"found {count} vertices in parts without"):
        Extension(form, patch.border)
    flat = patch.points[patch.faces]
    flat[5] = flat[5, :1]
    values = Extension(dirichlet_form(patch.faces, flat, count), patch.border)(np.ones((len(patch.border), 1)))
    np.testing.assert_allclose(values, 1.0, atol=1e-12)
