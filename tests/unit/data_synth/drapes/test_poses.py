"""Drawn poses: within the ranges, as dense as they should be, limbs out of each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import ShapedBody, with_pose
from capture4d.errors import InputError
from data_synth.drapes.config import PoseConfig
from data_synth.drapes.poses import draw_pose, legs_enter, moved_joints, sample_pose

CONFIG = PoseConfig()


def joint(person: ShapedBody, name: str) -> int:
    return person.body.joint_names.index(name)


def test_a_shirt_is_moved_by_ten_joints_and_a_necktie_by_four():
    assert len(moved_joints(("spine", "arms"))) == 10
    assert len(moved_joints(("spine",))) == 4


@pytest.mark.parametrize("limbs", [("spine",), ("spine", "arms"), ("spine", "legs")])
def test_only_the_joints_that_are_named_turn(person: ShapedBody, limbs: tuple[str, ...]):
    uniform = replace(CONFIG, distribution="uniform")
    rotations = sample_pose(person, limbs, uniform, np.random.default_rng(0))
    turned = np.flatnonzero(np.abs(rotations - np.eye(3)).max(axis=(1, 2)) > 1e-12)
    assert {person.body.joint_names[i] for i in turned} == set(moved_joints(limbs))
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (len(rotations), 1, 1)), atol=1e-12
    )


@pytest.mark.parametrize("distribution", ["half-normal", "uniform"])
def test_angles_stay_in_their_ranges_and_are_spread_as_asked(person: ShapedBody, distribution: str):
    config, rng = replace(CONFIG, distribution=distribution), np.random.default_rng(1)
    knee = joint(person, "lowerleg01.L")
    bent = [
        Rotation.from_matrix(sample_pose(person, ("legs",), config, rng)[knee]).as_rotvec(degrees=True)[0]
        for _ in range(250)
    ]
    assert min(bent) > -1e-9
    assert max(bent) <= CONFIG.knee[1] + 1e-9
    shallow = np.mean(np.array(bent) < CONFIG.knee[1] / 4)
    # Uniform: a quarter. Half-normal of either sign of a range from 0: half are 0, and 0.38 of the rest.
    assert shallow == pytest.approx(0.25 if distribution == "uniform" else 0.5 + 0.5 * 0.38, abs=0.08)


def test_arms_point_as_often_into_equal_areas_of_the_sphere(person: ShapedBody):
    rng, config = np.random.default_rng(2), replace(CONFIG, spine_bend=(0, 0), spine_turn=(0, 0), spine_side=(0, 0))
    shoulder, elbow = (joint(person, f"{name}.L") for name in ("upperarm01", "lowerarm01"))
    height = []
    for _ in range(250):
        centres = with_pose(person, sample_pose(person, ("spine", "arms"), config, rng), np.zeros(3)).joint_centres()
        arm = centres[elbow] - centres[shoulder]
        height.append(arm[1] / np.linalg.norm(arm))
    low, high = np.sin(np.radians(CONFIG.arm_altitude))
    assert low - 1e-6 < min(height)
    assert max(height) < high + 1e-6
    share = (np.sort(height) - low) / (high - low)
    assert np.abs(share - np.linspace(0, 1, 250)).max() < 0.11  # Kolmogorov and Smirnov, one in a hundred


def test_crossed_legs_are_in_each_other_and_legs_at_rest_are_not(person: ShapedBody):
    rotations = np.repeat(np.eye(3)[None], len(person.joints), axis=0)
    assert not legs_enter(with_pose(person, rotations, np.zeros(3)))
    for side, sign in (("L", -1), ("R", 1)):
        crossed = Rotation.from_euler("z", sign * 25, degrees=True).as_matrix()
        rotations[joint(person, f"upperleg01.{side}")] = crossed
    assert legs_enter(with_pose(person, rotations, np.zeros(3)))


def test_a_pose_is_drawn_again_until_its_legs_are_apart(person: ShapedBody):
    wide = replace(CONFIG, hip_abduction=(-30.0, 10.0), distribution="uniform")
    drawn = []
    for seed in range(12):
        rotations, count = draw_pose(person, ("legs",), wide, np.random.default_rng(seed))
        assert not legs_enter(with_pose(person, rotations, np.zeros(3)))
        drawn.append(count)
    assert max(drawn) > 1


def test_ranges_without_a_possible_pose_are_refused(person: ShapedBody, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("data_synth.drapes.poses.MOST_DRAWN", 3)
    crossed = replace(CONFIG, hip_abduction=(-30.0, -29.0), distribution="uniform", hip_flexion=(0, 0), knee=(0, 0))
    with pytest.raises(InputError, match="limbs are apart"):
        draw_pose(person, ("legs",), crossed, np.random.default_rng(0))
