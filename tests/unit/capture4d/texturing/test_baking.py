"""Colours of a scan's vertices are sharpened by what interpolation blurs, and noise is left as it is."""

import numpy as np

from capture4d.geometry.mesh import boundary_edges
from capture4d.texturing.baking import sharpened
from tests.shapes import plane

CELLS = 60
MESH = plane(1.0, CELLS)
INNER = (np.abs(MESH.vertices[:, [0, 2]] - 0.5) < 0.45).all(axis=1)


def as_levels(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def test_a_print_that_each_vertex_gathers_around_it_is_seen_as_it_is_between_them():
    """Waves of eight spacings, gathered over each vertex' share; then interpolated, to the middle of each edge."""
    rng, wave = np.random.default_rng(0), 2 * np.pi * CELLS / 8

    def true(places: np.ndarray) -> np.ndarray:
        return 128 + 80 * np.sin(wave * places[:, 0]) * np.cos(wave * places[:, 2])

    around = (rng.uniform(-0.5, 0.5, (60, 3)) / CELLS)[:, None] + MESH.vertices.astype(np.float64)
    gathered = np.stack([true(each) for each in around]).mean(axis=0) + rng.normal(0, 2, len(MESH.vertices))
    levels = as_levels(np.repeat(gathered[:, None], 3, axis=1))
    ends = MESH.faces[INNER[MESH.faces].all(axis=1)][:, :2]
    wanted = true(MESH.vertices[ends].mean(axis=1).astype(np.float64))
    before, after = (
        float(np.abs(each.astype(np.float64)[ends].mean(axis=1)[:, 0] - wanted).mean())
        for each in (levels, sharpened(levels, MESH.faces))
    )
    assert after < 0.6 * before


def test_noise_is_not_taken_for_a_print_though_a_stripe_is_painted_on():
    painted = (MESH.vertices[:, :1] > 0.9) * np.array([100.0, 60.0, -90.0])
    levels = as_levels(128 + painted + 8 * np.random.default_rng(1).standard_normal((len(MESH.vertices), 3)))
    assert np.abs(sharpened(levels, MESH.faces) - levels)[INNER].max() < 0.01


def test_beside_open_borders_nothing_is_sharpened():
    """There a scan mixes cloth with what is beside it."""
    levels = as_levels(128 + 60 * np.sin(MESH.vertices[:, [0, 0, 2]] * 40))
    border = np.zeros(len(levels), bool)
    border[boundary_edges(MESH.faces)] = True
    levels[border] = 255
    found = sharpened(levels, MESH.faces)
    beside = MESH.faces[border[MESH.faces].any(axis=1)]
    assert np.array_equal(found[beside], levels[beside])
    assert not np.array_equal(found, levels)
