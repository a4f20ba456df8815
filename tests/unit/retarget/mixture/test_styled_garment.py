"""A style told in other ways is the same style; a live frame is nearly the exact one."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.body.limbs import WornBody
from capture4d.body.skinning import with_pose
from capture4d.captures.drapes.style_sets import Ranges, StyleSet
from capture4d.errors import InputError
from capture4d.geometry.intersection_removal import Penetration
from retarget.mixture.config import StylesConfig
from retarget.mixture.learning import learn_styles
from retarget.mixture.lesson import style_lesson
from retarget.mixture.styled_garment import StyledGarment
from tests.unit.retarget.mixture.conftest import bent, motion

RANGES = Ranges({"longer": (-1.5, 1.5), "size": (0.9, 1.2)}, [(-2.0, 2.0), (0.0, 0.0), (-1.0, 3.0)])


@pytest.fixture(scope="module")
def garment(style_set: StyleSet, tmp_path_factory: pytest.TempPathFactory) -> StyledGarment:
    return learn_styles(style_lesson(style_set), StylesConfig(members=0), tmp_path_factory.mktemp("learned"))[0]


@pytest.mark.parametrize("seed", range(5))
def test_numbers_and_values_are_each_others_inverse(seed: int):
    numbers = np.random.default_rng(seed).uniform(-1, 1, RANGES.size)
    style, shape = RANGES.values(numbers)
    assert [*style] == ["longer", "size"]
    assert shape[1] == 0.0
    np.testing.assert_allclose(RANGES.numbers(style, shape), numbers, atol=1e-12)


def test_numbers_in_their_order_have_names():
    assert RANGES.named([0.5, 1.0]) == {"longer": 0.5, "size": 1.0}
    assert RANGES.named([0.5]) == {"longer": 0.5}
    with pytest.raises(InputError, match="style: expected at most 2 numbers, longer, size; found 3"):
        RANGES.named([0, 1, 2])


def test_a_style_in_its_order_is_the_style_by_name(garment: StyledGarment):
    pose = motion([0.3])
    np.testing.assert_array_equal(
        garment.vertices(pose, (0.2,), [0.7]), garment.vertices(pose, (0.2,), {"length": 0.7})
    )


@pytest.mark.parametrize("angle", [0.2, 0.9])
def test_a_live_frame_is_nearly_the_exact_one(garment: StyledGarment, angle: float):
    """The narrowest style on the thickest person sits in the skin here and there."""
    worn, rotations, place = garment.worn((1.0,), {"length": 0.4}), bent(np.array([angle]))[0], np.array([0.1, 0.2, 0])
    live, exact = worn.live(rotations, place), worn.outside(rotations, place)
    weights = garment.garment.skin_weights
    assert weights is not None
    body = WornBody(worn.person, worn.in_a_pose, weights)
    left = Penetration.of(body.posed(with_pose(worn.person, rotations, place).vertices()).contacts(live))
    assert left.depth_max_mm <= max(0.25 * exact.before.depth_max_mm, 0.5)
    assert np.linalg.norm(live - exact.vertices, axis=1).mean() < 0.01
