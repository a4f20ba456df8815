"""Smoothing against transfer functions: exact on a cycle, right to a few percent on surfaces of any fineness."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.geometry.mesh import boundary_loops
from retarget.mixture.config import SplitConfig
from retarget.mixture.diffusion import Diffusion, umbrella
from tests.shapes import plane, tube


def lattice(rows: int, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """Equilateral triangles, (V, 3) and faces."""
    i, j = (each.ravel() for each in np.meshgrid(np.arange(rows), np.arange(rows), indexing="ij"))
    points = edge * np.column_stack([j + i / 2, i * np.sqrt(3) / 2, 0 * i])
    a = (i * rows + j)[(i < rows - 1) & (j < rows - 1)]
    faces = np.concatenate([np.stack([a, a + 1, a + rows], 1), np.stack([a + 1, a + rows + 1, a + rows], 1)])
    return points, faces.astype(np.int32)


def test_a_border_is_smoothed_as_a_cycle_of_its_own():
    """A wave of k periods on n vertices is left with (1 - 0.15 mu)^80, mu = 1 - cos(2 pi k / n)."""
    mesh = tube(32, 9)
    diffusion = Diffusion.create(mesh.faces, mesh.vertices, SplitConfig(printed=True))
    rng = np.random.default_rng(0)
    loop = boundary_loops(mesh.faces)[0]
    for k in (1, 2, 5):
        wave = np.cos(2 * np.pi * k * np.arange(32) / 32)
        values = rng.normal(size=(1, len(mesh.vertices), 3))  # whatever the cloth does
        values[0, loop, 0] = wave
        left = (1 - 0.15 * (1 - np.cos(2 * np.pi * k / 32))) ** 80
        np.testing.assert_allclose(diffusion.smooth(values)[0, loop, 0], left * wave, atol=1e-12)
    assert (1 - 0.15 * (1 - np.cos(2 * np.pi / 16))) ** 80 == pytest.approx(0.399, abs=1e-3)  # as the checklist has it


def test_rows_sum_to_zero_and_a_lonely_vertex_stays():
    mesh = plane(cells=3)
    laplacian = umbrella(mesh.faces, len(mesh.vertices) + 1)
    np.testing.assert_allclose(laplacian @ np.ones(len(mesh.vertices) + 1), 0, atol=1e-12)
    values = np.random.default_rng(0).normal(size=(2, len(mesh.vertices) + 1, 3))
    smooth = Diffusion(laplacian, 0.15, 80).smooth(values)
    np.testing.assert_array_equal(smooth[:, -1], values[:, -1])
    assert np.ptp(smooth[:, :-1], axis=1).max() < np.ptp(values[:, :-1], axis=1).min()


@pytest.mark.parametrize("edge", [0.012, 0.02])
@pytest.mark.parametrize("along", [(1.0, 0.0), (0.0, 1.0), (0.6, 0.8)])
def test_half_of_the_wave_of_the_cut_off_is_left_whatever_the_edges(edge: float, along: tuple[float, float]):
    points, faces = lattice(round(1.2 / edge), edge)
    diffusion = Diffusion.create(faces, points, SplitConfig(half_m=0.2))
    wave = np.cos(2 * np.pi * points[:, :2] @ along / 0.2)
    smooth = diffusion.smooth(np.repeat(wave[None, :, None], 3, axis=2))[0, :, 0]
    middle = points[:, :2].mean(axis=0)
    inner = np.linalg.norm(points[:, :2] - middle, axis=1) < 0.15  # out of reach of the border
    assert np.dot(smooth[inner], wave[inner]) / np.dot(wave[inner], wave[inner]) == pytest.approx(0.5, abs=0.02)


def test_printed_steps_smooth_a_fine_mesh_less():
    """Which is why the cut-off is held in metres."""
    kept = []
    for edge in (0.01, 0.03):
        points, faces = lattice(round(1.2 / edge), edge)
        diffusion = Diffusion.create(faces, points, SplitConfig(printed=True))
        assert (diffusion.rate, diffusion.steps) == (0.15, 80)
        wave = np.cos(2 * np.pi * points[:, 0] / 0.2)
        smooth = diffusion.smooth(np.repeat(wave[None, :, None], 3, axis=2))[0, :, 0]
        inner = np.linalg.norm(points - points.mean(axis=0), axis=1) < 0.15
        kept.append(np.dot(smooth[inner], wave[inner]) / np.dot(wave[inner], wave[inner]))
    assert kept[0] > 0.7 > 0.1 > kept[1]


def test_many_garments_are_smoothed_as_one_by_one():
    mesh = tube(8, 6)
    diffusion = Diffusion.create(mesh.faces, mesh.vertices, SplitConfig())
    values = np.random.default_rng(1).normal(size=(70, len(mesh.vertices), 3)).astype(np.float32)
    together = diffusion.smooth(values)
    assert together.dtype == np.float32
    np.testing.assert_array_equal(together[66], diffusion.smooth(values[66:67])[0])
