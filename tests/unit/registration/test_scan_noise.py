"""Noise is told from shape, and a template is held against as much of it as there is."""

import numpy as np
import pytest

from capture4d.types import Mesh
from registration.config import PAIR
from registration.scan_noise import held_against_noise, roughness
from tests.shapes import plane, tube

FINE = tube(120, 100, 0.1, 0.5)


def noisy(mesh: Mesh, sigma: float, seed: int = 0) -> np.ndarray:
    return mesh.vertices + sigma * np.random.default_rng(seed).standard_normal(mesh.vertices.shape)


@pytest.mark.parametrize("sigma", [0.0002, 0.001])
@pytest.mark.parametrize("seed", [0, 1])
def test_noise_is_measured(sigma: float, seed: int) -> None:
    assert roughness(noisy(FINE, sigma, seed), FINE.faces) == pytest.approx(sigma, rel=0.1)


def test_what_is_curved_is_not_rough() -> None:
    assert roughness(FINE.vertices, FINE.faces) < 1e-6
    waves = FINE.vertices.astype(float)
    waves[:, [0, 2]] *= 1.0 + 0.1 * np.sin(2 * np.pi * waves[:, 1:2] / 0.1)  # 10 mm high, 100 mm long
    assert roughness(waves, FINE.faces) < 0.0002


@pytest.mark.parametrize("spacing", [0.008, 0.012, 0.016])
@pytest.mark.parametrize("way", ["around", "along"])
def test_folds_of_a_clean_coarse_scan_are_not_rough(spacing: float, way: str) -> None:
    """6 mm high and about 60 mm long: twice the height over the neighbours alone leaves up to 1.2 mm of them."""
    mesh = tube(round(2 * np.pi * 0.1 / spacing), round(0.6 / spacing) + 1, 0.1, 0.6)
    folds = mesh.vertices.astype(float)
    turn = 10 * np.arctan2(folds[:, 0], folds[:, 2]) if way == "around" else 2 * np.pi * folds[:, 1] / 0.06
    folds[:, [0, 2]] *= 1.0 + 0.03 * np.sin(turn)[:, None]
    assert roughness(folds, mesh.faces) < 0.00015
    noise = 0.001 * np.random.default_rng(0).standard_normal(folds.shape)
    assert roughness(folds + noise, mesh.faces) == pytest.approx(0.001, rel=0.15)


def test_nothing_but_open_edges_tells_nothing() -> None:
    flat = plane(cells=1)
    assert roughness(flat.vertices, flat.faces) == 0.0


def test_only_noise_that_the_template_has_not_makes_it_stiffer() -> None:
    before = PAIR.dense.cold.smooth
    assert held_against_noise(PAIR, 0.0003, 0.0005).dense.cold.smooth == before
    a, b = (held_against_noise(PAIR, sigma, 0.0001).dense.cold.smooth for sigma in (0.0005, 0.001))
    assert before[1] < a[1] < b[1]
    assert a[0] == b[0] == before[0]
    most, more = (held_against_noise(PAIR, sigma, 0.0).dense.cold.smooth[1] for sigma in (0.0012, 0.003))
    assert more == most == pytest.approx(23.0, abs=0.5)
    many = held_against_noise(PAIR, 0.01, 0.0).dense.cold.smooth
    assert many[0] == many[1] > before[0]
