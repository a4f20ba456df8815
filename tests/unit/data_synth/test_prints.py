"""Prints: features of the size asked for, nothing that looks like the paint, the picture where the cloth is."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from capture4d.colours.spaces import colour_angles
from data_synth.cloth.patterns import mesh_pattern
from data_synth.cloth.tshirt import tshirt_pattern
from data_synth.config import PRESETS, GarmentStyle
from data_synth.outfits import OUTFITS, PrintName
from data_synth.prints import draw_print, logo_circle, picture_over, printed_cloth

SHAPE, CHEST = (200, 300), np.array([150.0, 120.0])


def drawn(name: PrintName, feature_px: float, outfit: str = "blue") -> np.ndarray:
    return draw_print(name, SHAPE, OUTFITS[outfit], feature_px=feature_px, chest_px=CHEST, rng=np.random.default_rng(0))


@pytest.mark.parametrize("name", get_args(PrintName))
@pytest.mark.parametrize("outfit", OUTFITS)
def test_no_print_resembles_the_paint_beside_it(name: PrintName, outfit: str) -> None:
    image = np.rint(255 * drawn(name, 10, outfit)).astype(np.uint8).reshape(-1, 3)
    assert colour_angles(image[image.max(axis=1) > 60], OUTFITS[outfit].border).min() > 0.27


@pytest.mark.parametrize("feature", [8, 16])
def test_stripes_and_squares_are_as_wide_as_asked_for(feature: int) -> None:
    changes = np.flatnonzero(np.abs(np.diff(drawn("stripes", feature)[100, :, 0])) > 0.05)
    starts = changes[np.r_[True, np.diff(changes) > 3]]
    np.testing.assert_allclose(np.diff(starts), feature, atol=1)
    checks = drawn("checks", feature)
    assert np.abs(np.diff(checks, axis=0)).max() > 0.1
    assert np.ptp(drawn("stripes", feature), axis=0).max() < 1e-6


def test_blobs_are_as_large_as_asked_for() -> None:
    """The correlation of a print with itself, shifted by one feature, is nearly gone, by a quarter of it is not."""
    image = drawn("random", 12)[..., 0]
    image = image - image.mean()

    def alike(shift: int) -> float:
        return float((image[:, shift:] * image[:, : image.shape[1] - shift]).mean() / (image**2).mean())

    assert alike(3) > 0.6
    assert abs(alike(18)) < 0.2


def test_a_logo_lies_on_its_circle_alone() -> None:
    image = drawn("logo", 6)
    rows, columns = np.indices(SHAPE)
    away = np.hypot(columns - CHEST[0], rows - CHEST[1])
    assert np.ptp(image[away > 45 + 5].reshape(-1, 3), axis=0).max() < 1e-6
    assert image[away < 40].std() > 0.15


def test_the_picture_lies_where_the_cloth_does(person) -> None:
    pattern = tshirt_pattern(person, GarmentStyle())
    fine, template = (mesh_pattern(pattern, count, np.random.default_rng(1)) for count in (900, 300))
    painted = np.zeros(fine.vertex_count, bool)
    ink = printed_cloth(fine, "random", OUTFITS["blue"], feature_mm=20, painted=painted, seed=4)
    picture = picture_over(ink, fine, template.uv) / 255
    low, high = template.uv.reshape(-1, 2).min(axis=0), template.uv.reshape(-1, 2).max(axis=0)
    corner = fine.uv.reshape(-1, 2)
    inside = ((corner > low + 0.002) & (corner < high - 0.002)).all(axis=1)
    share = (corner[inside] - low) / (high - low)
    rows, columns = picture.shape[:2]
    seen = picture[((1 - share[:, 1]) * rows).astype(int), (share[:, 0] * columns).astype(int)]
    column, row = np.rint(ink.places.reshape(-1, 2)[inside]).astype(int).T
    assert np.abs(seen - ink.image[row, column]).mean() < 0.03
    middle, radius = logo_circle(fine, 20)
    assert radius == pytest.approx(0.14)
    assert ((middle > fine.uv.reshape(-1, 2).min(axis=0)) & (middle < fine.uv.reshape(-1, 2).max(axis=0))).all()


def test_takes_without_a_print_are_what_they_were() -> None:
    """Settings that are absent do not tell a take from one that was made before there were prints."""
    assert PRESETS["tiny"].print is None
    assert replace(PRESETS["tiny"], print="checks") != PRESETS["tiny"]
