"""Light is Lambert's: what faces a lamp is bright, and dividing by the light gives the paint back."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.types import Mesh, Rig
from data_synth.outfits import OUTFITS
from data_synth.scanner.config import ShadingConfig
from data_synth.scanner.lighting import flicker, light
from data_synth.scanner.raycast import Surface
from data_synth.scanner.rig import capture_rig

CENTRE = np.array([0.3, 1.1, -0.2])


@pytest.fixture
def rig() -> Rig:
    return capture_rig(centre=CENTRE, radius=0.6, cameras=20, image_size=32)


def patch(rig: Rig, normal: tuple[float, float, float], colour: tuple[int, int, int], distance: float) -> Surface:
    """A small triangle that faces `normal`, so far from the middle of the rig along it."""
    n = np.array(normal) / np.linalg.norm(normal)
    a = np.cross(n, (0.3, 1.0, 0.2))
    a /= np.linalg.norm(a)
    b = np.cross(n, a)
    middle = rig.centres.mean(axis=0) + distance * n
    corners = middle + 0.001 * np.array([a, -0.5 * a + 0.8 * b, -0.5 * a - 0.8 * b])
    mesh = Mesh(corners.astype(np.float32), np.array([[0, 1, 2]], np.int32))
    return Surface(mesh, np.tile(np.array(colour, np.uint8), (3, 1)), 1, 0.005)


def linear(surface: Surface, rig: Rig, lighting) -> np.ndarray:
    return light(surface, rig, shading=ShadingConfig(lighting=lighting)).mean(axis=0) ** 2.2


def test_a_side_lamp_leaves_the_other_side_dim_and_falls_off(rig: Rig) -> None:
    left, right = (linear(patch(rig, (x, 0, 0), (180, 180, 180), 0.2), rig, "side") for x in (1, -1))
    assert (left > 4 * right).all()
    near, far = (linear(patch(rig, (0.8, 0.25, 0.3), (180, 180, 180), d), rig, "side") - right for d in (0.4, 0.1))
    reach = np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1).mean() * np.linalg.norm((0.8, 0.25, 0.3))
    np.testing.assert_allclose(near / far, ((reach - 0.1) / (reach - 0.4)) ** 2, rtol=0.01)


def test_two_lamps_tint_the_two_sides_differently(rig: Rig) -> None:
    left, right = (linear(patch(rig, (x, 0, 0.2), (150, 150, 150), 0.2), rig, "two-temperature") for x in (1, -1))
    assert left[0] > 1.3 * left[2]
    assert right[2] > 1.2 * right[0]


@pytest.mark.parametrize("lighting", ["side", "two-temperature"])
def test_light_multiplies_the_paint(rig: Rig, lighting) -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        normal, (one, other) = tuple(rng.normal(size=3).tolist()), rng.integers(20, 250, (2, 3)).tolist()
        ratios = [
            linear(patch(rig, normal, tuple(c), 0.2), rig, lighting) / (np.array(c) / 255) ** 2.2 for c in (one, other)
        ]
        np.testing.assert_allclose(ratios[0], ratios[1], rtol=1e-3)


def test_outfits_are_told_apart_by_eye() -> None:
    for outfit in OUTFITS.values():
        colours = np.array([outfit.garment, outfit.border, outfit.suit, outfit.skin], float)
        apart = np.linalg.norm(colours[:, None] - colours, axis=2)
        assert apart[np.triu_indices(4, 1)].min() > 40


def test_only_the_overhead_lamp_flickers(rig: Rig) -> None:
    rng, untouched = np.random.default_rng(2), np.random.default_rng(2)
    assert flicker(ShadingConfig(lighting="side"), rng).tolist() == [1, 1, 1]
    assert rng.random() == untouched.random()
    gains = np.array([flicker(ShadingConfig(lighting="overhead"), rng) for _ in range(400)])
    np.testing.assert_allclose(gains.std(axis=0), 0.03, rtol=0.15)
    above, below = (linear(patch(rig, (0, y, 0), (180, 180, 180), 0.2), rig, "overhead") for y in (1, -1))
    assert (above > 1.5 * below).all()
