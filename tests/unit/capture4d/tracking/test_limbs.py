"""Limbs that nobody scanned are named, whatever the skeleton calls its joints."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.body.anny import load_anny
from capture4d.motions.retargeting import SMPL_TREE
from capture4d.tracking.limbs import guessed_limbs, unseen_limbs

SKELETONS = (load_anny().joint_names, tuple(SMPL_TREE))


def but(names: tuple[str, ...], *unseen: str) -> np.ndarray:
    return np.array([not any(part in name for part in unseen) for name in names])


@pytest.mark.parametrize("names", SKELETONS)
def test_every_part_of_every_limb_is_known_to_a_skeleton(names: tuple[str, ...]):
    limbs = ["upper arm", "forearm", "hand"], ["thigh", "lower leg", "foot"]
    wanted = ["head"] + [f"{side} {part}" for limb in limbs for side in ("left", "right") for part in limb]
    assert list(unseen_limbs(names, np.zeros(len(names), bool))) == wanted
    assert unseen_limbs(names, np.ones(len(names), bool)) == ()


@pytest.mark.parametrize(
    ("names", "unseen"),
    [(SKELETONS[0], ("lowerarm01.L", "lowerarm02.L", "wrist.L")), (SKELETONS[1], ("left_elbow", "left_wrist"))],
)
def test_a_missing_forearm_is_named_and_one_under_a_sleeve_is_not(names: tuple[str, ...], unseen: tuple[str, ...]):
    assert unseen_limbs(names, but(names, *unseen)) == ("left forearm", "left hand")
    assert unseen_limbs(names, but(names, *unseen[:-1])) == (), "the hand tells where the forearm is"
    assert unseen_limbs(names, but(names, unseen[-1])) == ("left hand",)


def test_legs_that_no_frame_shows_are_no_fault_of_a_frame_and_arms_are():
    legs, hand = ("left lower leg", "left foot"), ("left hand",)
    assert guessed_limbs([(*hand, *legs)] * 20) == [hand] * 20
    assert guessed_limbs([legs] * 5 + [()] * 15) == [legs] * 5 + [()] * 15
    assert guessed_limbs([]) == []
