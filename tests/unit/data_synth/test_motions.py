"""Motions: scripted, sampled within limits, and read from BVH."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import ShapedBody, pose_frame
from capture4d.errors import InputError
from capture4d.motions.bvh import read_bvh
from capture4d.motions.clips import understood
from capture4d.motions.retargeting import retarget
from capture4d.types import PoseSequence
from data_synth.config import MotionConfig
from data_synth.motions import SPINE_LIMITS, arms_enter_trunk, make_motion

BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
%s}
MOTION
Frames: %d
Frame Time: 0.0083333
%s
"""
CHAINS = (
    ("LeftUpLeg", "LeftLeg", "LeftFoot"),
    ("RightUpLeg", "RightLeg", "RightFoot"),
    ("LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head"),
    ("LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand"),
    ("RightShoulder", "RightArm", "RightForeArm", "RightHand"),
)


def rest_offset(name: str) -> str:
    """T-pose: legs down, arms sideways, spine up."""
    if name.endswith(("Leg", "Foot")) and not name.endswith("UpLeg"):
        return "0 -7 0"
    return {"L": "5 0 0", "R": "-5 0 0"}[name[0]] if name.startswith(("Left", "Right")) else "0 5 0"


def write_bvh(path: Path, rows: list[list[float]]) -> Path:
    """A clip in the naming of the CMU database; rows give the root's six channels, all other joints are at rest."""
    body = ""
    for chain in CHAINS:
        for name in chain:
            body += f"JOINT {name}\n{{\nOFFSET {rest_offset(name)}\nCHANNELS 3 Zrotation Yrotation Xrotation\n"
        body += "End Site\n{\nOFFSET 0 1 0\n}\n" + "}\n" * len(chain)
    others = [0.0] * 3 * sum(len(chain) for chain in CHAINS)
    lines = "\n".join(" ".join(f"{value:g}" for value in [*row, *others]) for row in rows)
    path.write_text(BVH % (body, len(rows), lines))
    return path


def retargeted(person: ShapedBody, path: Path) -> PoseSequence:
    return retarget(person, understood(read_bvh(path))[0], 60.0)


@pytest.mark.parametrize("clip", ["range-of-motion", "twist", "reach", "side-bend", "sampled"])
def test_clips_are_smooth_rotations_on_the_floor(person: ShapedBody, clip) -> None:
    poses = make_motion(person, MotionConfig(clip), 60.0, 90, np.random.default_rng(0))
    assert len(poses.frame_ids) == 90
    identity = poses.rotations @ np.swapaxes(poses.rotations, 2, 3)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-5)
    turns = Rotation.from_matrix((poses.rotations[1:] @ np.swapaxes(poses.rotations[:-1], 2, 3)).reshape(-1, 3, 3))
    assert np.degrees(turns.magnitude()).max() < 12, "a joint turns faster than 720 degrees a second"
    lowest = min(pose_frame(person, poses, t).vertices()[:, 1].min() for t in range(0, 90, 10))
    assert abs(lowest) < 0.02


def test_skipping_frames_is_cutting_the_same_motion(person: ShapedBody) -> None:
    whole = make_motion(person, MotionConfig("twist"), 60.0, 60, np.random.default_rng(3))
    tail = make_motion(person, MotionConfig("twist", skip_frames=25), 60.0, 35, np.random.default_rng(3))
    np.testing.assert_array_equal(whole.rotations[25:], tail.rotations)


def test_sampled_poses_keep_limits_and_stay_out_of_the_trunk(person: ShapedBody) -> None:
    poses = make_motion(person, MotionConfig("sampled"), 60.0, 400, np.random.default_rng(1))
    names = person.body.joint_names
    for joint, limits in SPINE_LIMITS.items():
        angles = Rotation.from_matrix(poses.rotations[:, names.index(joint)]).as_euler("xzy", degrees=True)[
            :, [0, 2, 1]
        ]
        for axis, (low, high) in enumerate(limits):
            assert angles[:, axis].min() > low - 4  # between two poses the interpolation may lean out a little
            assert angles[:, axis].max() < high + 4
    assert not any(arms_enter_trunk(person, poses.rotations[t]) for t in range(0, 400, 42))


def test_arms_in_the_trunk_are_noticed(person: ShapedBody) -> None:
    names = person.body.joint_names
    rotations = np.repeat(np.eye(3)[None], len(names), axis=0)
    assert not arms_enter_trunk(person, rotations)
    rotations[names.index("lowerarm01.L")] = Rotation.from_euler("z", -120, degrees=True).as_matrix()
    rotations[names.index("upperarm01.L")] = Rotation.from_euler("z", -40, degrees=True).as_matrix()
    assert arms_enter_trunk(person, rotations)


def test_bvh_of_a_t_pose_holds_the_arms_out(person: ShapedBody, tmp_path: Path) -> None:
    poses = retargeted(person, write_bvh(tmp_path / "t.bvh", [[0.0] * 6] * 7))
    assert len(poses.frame_ids) == 4  # seven frames at 120 a second
    posed = pose_frame(person, poses, 0)
    names = person.body.joint_names
    at = {n: posed.transforms[j, :3, :3] @ person.joints[j] + posed.transforms[j, :3, 3] for j, n in enumerate(names)}
    arm = at["wrist.L"] - at["upperarm01.L"]
    np.testing.assert_allclose(arm / np.linalg.norm(arm), [1, 0, 0], atol=1e-5)
    leg = at["foot.L"] - at["upperleg01.L"]
    np.testing.assert_allclose(leg / np.linalg.norm(leg), [0, -1, 0], atol=1e-5)


def test_bvh_is_turned_to_face_forward_and_scaled(person: ShapedBody, tmp_path: Path) -> None:
    walk = [[0.0, 15.0, 0.1 * t, 0.0, 0.0, 0.0] for t in range(61)]
    turned = [[row[2], row[1], -row[0], 0.0, 90.0, 0.0] for row in walk]  # the same walk, towards +X
    poses = [retargeted(person, write_bvh(tmp_path / "w.bvh", rows)) for rows in (walk, turned)]
    np.testing.assert_allclose(poses[0].translations, poses[1].translations, atol=1e-5)
    np.testing.assert_allclose(poses[0].rotations, poses[1].rotations, atol=1e-5)
    names, joints = person.body.joint_names, person.joints
    hip, knee, foot = (joints[names.index(f"{part}.L")] for part in ("upperleg01", "lowerleg01", "foot"))
    leg = np.linalg.norm(knee - hip) + np.linalg.norm(foot - knee)
    assert poses[0].translations[-1, 2] == pytest.approx(6.0 * leg / 14.0, rel=0.01)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: text.replace("MOTION", "NOTION"), "expected a MOTION section"),
        (lambda text: text.rsplit(" ", 3)[0], "line"),
        (lambda text: text.replace("LeftArm", "Tentacle"), "none for left shoulder (arm)"),
        (lambda text: text.replace("OFFSET 0 0 0", "OFFSET 0 zero 0", 1), "line 4"),
    ],
)
def test_damaged_bvh_is_refused_by_name(person: ShapedBody, tmp_path: Path, damage, message: str) -> None:
    path = write_bvh(tmp_path / "bad.bvh", [[0.0] * 6] * 3)
    path.write_text(damage(path.read_text()))
    with pytest.raises(InputError, match=r"bad\.bvh") as caught:
        retargeted(person, path)
    assert message in str(caught.value)


def test_a_clip_that_is_too_short_says_so(person: ShapedBody, tmp_path: Path) -> None:
    path = write_bvh(tmp_path / "short.bvh", [[0.0] * 6] * 9)
    with pytest.raises(InputError, match="expected at least 40 frames at 60 fps, found 5"):
        make_motion(person, MotionConfig(bvh=str(path)), 60.0, 40, np.random.default_rng(0))


def test_a_reversed_clip_is_the_clip_from_its_end(person: ShapedBody) -> None:
    forwards, backwards = (
        make_motion(person, MotionConfig("twist", reverse=reverse), 60.0, 40, np.random.default_rng(0))
        for reverse in (False, True)
    )
    np.testing.assert_array_equal(backwards.rotations, forwards.rotations[::-1])
    np.testing.assert_array_equal(backwards.frame_ids, forwards.frame_ids)


@pytest.mark.parametrize(
    "clip",
    ["walk", "hop", "arm-circles", "reach-twist", "lunge", "squat", "sit", "reach-down", "range-of-legs"],
)
def test_clips_stay_on_the_floor_and_move_no_faster_than_people(person: ShapedBody, clip: str) -> None:
    poses = make_motion(person, MotionConfig(clip), 60.0, 150, np.random.default_rng(0))
    turned = np.swapaxes(poses.rotations[:-1], -1, -2) @ poses.rotations[1:]
    speed = Rotation.from_matrix(turned.reshape(-1, 3, 3)).magnitude() * 60
    assert np.degrees(speed).max() < 720
    assert np.linalg.norm(np.diff(poses.translations, axis=0), axis=1).max() * 60 < 3.0
    lowest = [pose_frame(person, poses, frame).vertices()[:, 1].min() for frame in range(0, 150, 10)]
    assert -0.03 < min(lowest) < 0.03
    assert max(lowest) < 0.35


@pytest.mark.parametrize(("clip", "lowest_m"), [("squat", 0.25), ("sit", 0.25), ("lunge", 0.15), ("reach-down", 0.02)])
def test_knees_bend_over_feet_that_stay_where_they_are(person: ShapedBody, clip, lowest_m: float) -> None:
    poses = make_motion(person, MotionConfig(clip), 60.0, 90, np.random.default_rng(0))
    feet = [person.body.joint_names.index(f"foot.{side}") for side in "LR"]
    bodies = [pose_frame(person, poses, frame) for frame in range(0, 90, 6)]
    middles = np.array([body.joint_centres()[feet].mean(axis=0) for body in bodies])
    assert np.ptp(middles[:, [0, 2]], axis=0).max() < 1e-4
    assert max(abs(body.vertices()[:, 1].min()) for body in bodies) < 1e-4
    assert np.ptp(poses.translations[:, 1]) > lowest_m
