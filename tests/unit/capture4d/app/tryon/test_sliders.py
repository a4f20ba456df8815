"""Sliders pose people as they say, whatever skeleton they have."""

import numpy as np
import pytest

from capture4d.app.tryon.sliders import PoseSliders
from capture4d.body.anny import load_anny
from capture4d.body.skinning import with_pose, with_shape
from capture4d.errors import InputError
from capture4d.motions.anatomy import find_anatomy
from capture4d.types import Body
from tests.moving_garment import limb


@pytest.fixture(scope="module")
def person() -> Body:
    return load_anny()


def moved(body: Body, part: str, **degrees: float) -> np.ndarray:
    """How a joint has moved, metres."""
    anatomy, shaped = find_anatomy(body.joint_names, body.parents), with_shape(body, np.zeros(1))
    turned = PoseSliders.of(body).rotations({name.replace("_", " "): value for name, value in degrees.items()})
    joint = anatomy.head if part == "head" else anatomy.limbs[part]
    return with_pose(shaped, turned, np.zeros(3)).joint_centres()[joint] - shaped.joints[joint]


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(
    ("slider", "end", "axis", "sign"),
    [("arm raise", "wrist", 1, 1), ("arm forwards", "wrist", 2, 1), ("elbow", "wrist", 2, 1),
     ("leg forwards", "ankle", 2, 1), ("knee", "ankle", 2, -1)],
)  # fmt: skip
def test_limbs_go_where_their_sliders_say(person: Body, side: str, slider: str, end: str, axis: int, sign: int):
    way = moved(person, f"{side}_{end}", **{f"{side} {slider}": 30.0})
    assert sign * way[axis] > 0.05
    assert abs(moved(person, "head", **{f"{side} {slider}": 30.0})).max() < 1e-9


def test_legs_go_aside_and_the_two_sides_are_alike(person: Body):
    left, right = (moved(person, f"{side}_ankle", **{f"{side} leg aside": 20.0}) for side in ("left", "right"))
    assert left[0] > 0.1
    np.testing.assert_allclose(right, left * (-1, 1, 1), atol=0.01)


def test_the_spine_bends_forwards_and_leans_to_the_left(person: Body):
    assert moved(person, "head", spine_bend=30.0)[2] > 0.1
    assert moved(person, "head", spine_lean=20.0)[0] > 0.05
    np.testing.assert_allclose(moved(person, "head", spine_bend=30.0)[0], 0, atol=0.01)


def test_at_rest_nothing_is_turned(person: Body):
    sliders = PoseSliders.of(person)
    np.testing.assert_array_equal(sliders.rotations({}), np.tile(np.eye(3, dtype=np.float32), (36, 1, 1)))
    assert all(slider.low <= 0 <= slider.high for slider in sliders.sliders)


def test_what_is_no_person_has_three_sliders_a_joint():
    sliders = PoseSliders.of(limb())
    assert len(sliders.sliders) == 18
    turned = sliders.rotations({"joint_2 y": 90.0})
    np.testing.assert_allclose(turned[2], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-6)


def test_an_unknown_slider_is_one_line(person: Body):
    with pytest.raises(InputError, match=r"pose: expected one of the sliders .*, found 'tail'"):
        PoseSliders.of(person).rotations({"tail": 3.0})
