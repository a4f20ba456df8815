"""Light that is known is found, whatever is printed on the cloth; what nobody can tell stays in the colours."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.texturing.light import Light, fit_light, harmonics

AREA_M2 = 0.5


def turning(frames: int, places: int, rng: np.random.Generator, reach_deg: float) -> np.ndarray:
    """(T, n, 3) normals of places on a person who turns to and fro, with folds."""
    still = rng.standard_normal((places, 3))
    still /= np.linalg.norm(still, axis=1, keepdims=True)
    angles = np.radians(reach_deg) * np.sin(np.linspace(0, 3, frames))
    turned = np.stack([Rotation.from_rotvec([0, angle, 0]).apply(still) for angle in angles])
    turned = turned + 0.15 * rng.standard_normal(turned.shape)
    return (turned / np.linalg.norm(turned, axis=2, keepdims=True)).astype(np.float32)


def lamps(normals: np.ndarray) -> np.ndarray:
    """A warm lamp in front, and light from everywhere."""
    lambert = np.clip(normals @ np.array([0.3, 0.6, 0.74]), 0, None)
    return np.array([0.55, 0.6, 0.62]) + lambert[..., None] * np.array([0.5, 0.4, 0.3])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_lamp_is_divided_out_though_front_and_back_are_of_different_cloth(seed: int):
    rng = np.random.default_rng(seed)
    normals = turning(8, 3000, rng, 50)
    albedo = rng.uniform(60, 200, (3000, 3))
    albedo[normals[0, :, 2] > 0] *= 0.7  # what a lamp from behind would make of it
    noisy = normals + 0.15 * rng.standard_normal(normals.shape).astype(np.float32)
    noisy /= np.linalg.norm(noisy, axis=2, keepdims=True)
    gains = np.exp(0.03 * rng.standard_normal((8, 1, 3)))
    colours = albedo * lamps(normals) * gains + rng.normal(0, 2, (8, 3000, 3))
    weights = (rng.uniform(size=(8, 3000)) > 0.3).astype(np.float32)
    colours[5, :200], weights[5, :200] = 20, 1.0  # something dark in between
    light, found = fit_light(colours.astype(np.float32), noisy, normals, weights, area_m2=AREA_M2)
    true = np.log(lamps(normals[weights > 0]))
    away = np.log(light.at(normals[weights > 0])) - true
    assert np.abs(away - away.mean(axis=0)).mean() < 0.25 * np.abs(true - true.mean(axis=0)).mean()
    wanted = np.log(gains[:, 0] / np.exp(np.log(gains).mean(axis=0)))
    assert np.abs(found - wanted).mean() < 0.01


def test_nobody_turns_and_different_cloth_is_not_taken_for_light():
    """Front and back differ, and always face the same way: half of it may be light, but not all of it."""
    rng = np.random.default_rng(4)
    normals = np.repeat(turning(1, 3000, rng, 0), 4, axis=0)
    albedo = np.where(normals[0, :, 2:] > 0, 150.0, 75.0) * np.ones(3) * rng.uniform(0.8, 1.2, (3000, 1))
    colours = (albedo + rng.normal(0, 2, (4, 3000, 3))).astype(np.float32)
    light, _ = fit_light(colours, normals, normals, np.ones((4, 3000), np.float32), area_m2=AREA_M2)
    factors = light.at(np.array([[0, 0, 1.0], [0, 0, -1.0]]))
    assert np.isfinite(factors).all()
    assert (factors[0] / factors[1] < 150 / 75 * 1.5).all()


def hue_of(light: Light, normals: np.ndarray) -> float:
    """By how much channels differ in their logarithms over directions, in the mean."""
    found = np.log(light.at(normals.reshape(-1, 3)))
    return float(np.abs(found - found.mean(axis=1, keepdims=True)).mean())


@pytest.mark.parametrize("seed", [1, 2])
def test_lamps_of_one_hue_keep_it_whatever_is_printed_and_those_of_two_do_not(seed: int):
    rng = np.random.default_rng(seed)
    normals = turning(6, 400, rng, 15)
    albedo = np.repeat(rng.uniform(50, 190, (40, 3)), 10, axis=0)[rng.permutation(400)]
    weights = np.ones((6, 400), np.float32)
    lambert = np.clip(normals @ np.array([0.3, 0.6, 0.74]), 0, None)[..., None]
    for warm, least, most in ((0.0, 0.0, 0.001), (0.3, 0.04, 0.08)):
        lit = albedo * (0.6 + lambert * np.array([0.4 + warm, 0.4, 0.4 - warm])) + rng.normal(0, 1, (6, 400, 3))
        light, _ = fit_light(lit.astype(np.float32), normals, normals, weights, area_m2=AREA_M2)
        assert least < hue_of(light, normals) < most


def test_even_light_changes_nothing():
    normals = np.random.default_rng(0).standard_normal((10, 3))
    assert np.array_equal(Light.even().at(normals), np.ones((10, 3)))


def test_harmonics_have_no_mean_over_the_sphere():
    normals = np.random.default_rng(0).standard_normal((200_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert np.abs(harmonics(normals).mean(axis=0)).max() < 0.01


def worn(albedo: tuple[float, float, float], seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cloth of one colour under a lamp, brightness 1 in the mean, 8 bit; its normals and that lamp."""
    rng = np.random.default_rng(seed)
    normals = turning(6, 400, rng, 40)
    lit = lamps(normals) / np.exp(np.log(lamps(normals)).mean(axis=(0, 1)))
    colours = np.array(albedo) * rng.uniform(0.9, 1.1, (400, 1)) * lit + rng.normal(0, 1, lit.shape)
    return np.clip(colours, 0, 255).astype(np.float32), normals, lit


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("unclipped", [0, 1, 100])
def test_a_channel_that_clipped_nearly_everywhere_is_left_alone_and_the_others_are_not(unclipped: int, seed: int):
    colours, normals, lit = worn((600, 120, 90), seed)
    assert colours[..., 0].min() == 255
    colours.reshape(-1, 3)[:unclipped, 0] = 240
    light, gains = fit_light(colours, normals, normals, np.ones((6, 400), np.float32), area_m2=AREA_M2)
    assert not light.terms[:, 0].any()
    assert not gains[:, 0].any()
    assert (light.at(normals.reshape(-1, 3))[:, 0] == 1).all()
    away = np.log(light.at(normals.reshape(-1, 3)).reshape(lit.shape) / lit)[..., 1:]
    assert (away.std(axis=(0, 1)) < 0.25 * np.log(lit).std(axis=(0, 1))[1:]).all()


@pytest.mark.parametrize(("level", "weight"), [(255, 1), (120, 0)], ids=["overexposed", "nothing seen"])
def test_where_nothing_tells_of_light_it_is_even(level: int, weight: int):
    normals = turning(4, 100, np.random.default_rng(0), 40)
    colours, weights = np.full((4, 100, 3), level, np.float32), np.full((4, 100), weight, np.float32)
    light, gains = fit_light(colours, normals, normals, weights, area_m2=AREA_M2)
    assert not light.terms.any()
    assert not light.mean.any()
    assert not gains.any()


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("red", [600, 300, 250])
def test_what_clipped_in_one_channel_changes_the_brightness_of_no_other(red: float, seed: int):
    """From everywhere to the half that faces the lamp: green and blue are as bright as if red were dark."""
    colours, normals, lit = worn((red, 120, 90), seed)
    colours[0, normals[0, :, 2].argmin(), 0] = 240  # one place that all channels show
    assert 0 < (colours[..., 0] < 250).mean() < 0.7
    light, _ = fit_light(colours, normals, normals, np.ones((6, 400), np.float32), area_m2=AREA_M2)
    away = np.log(light.at(normals.reshape(-1, 3)).reshape(lit.shape) / lit)[..., 1:]
    assert np.abs(away.mean(axis=(0, 1))).max() < 0.01
