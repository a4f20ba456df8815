"""The control vector: what it is, and that it does not look ahead."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from retarget.config import ControlConfig
from retarget.regression.controls import ControlLayout, ControlStream, control_vectors, garment_joints

NAMES = ("root", "middle", "top")


def layout(**settings) -> ControlLayout:
    return ControlLayout(NAMES, (1, 2), 60.0, ControlConfig(**settings), (-1, 0, 1))


def test_joints_are_those_that_carry_the_garment_and_those_above_them() -> None:
    parents = np.array([-1, 0, 1, 2, 0], np.int32)
    weights = np.zeros((10, 5), np.float32)
    weights[:, 0], weights[0, 0] = 1.0, 0.0
    weights[0, 3] = 1.0
    assert garment_joints(weights, parents, 0.05) == (1, 2, 3)
    assert garment_joints(weights, parents, 0.2) == ()


@pytest.mark.parametrize("frames", [3, 5, 9])
def test_derivatives_of_a_parabola_are_exact_in_the_root_frame(motion, frames: int) -> None:
    poses = motion(30, 0)
    time = (poses.frame_ids - 1) / 60.0
    speed, push = np.array([0.4, -0.2, 1.0]), np.array([0.0, -9.81, 2.0])
    path = speed * time[:, None] + 0.5 * push * time[:, None] ** 2
    turned = Rotation.from_euler("y", 70, degrees=True).as_matrix()
    rotations = poses.rotations.copy()
    rotations[:, 0] = turned
    moving = replace(poses, translations=path.astype(np.float32), rotations=rotations)
    found = control_vectors(layout(derivative_frames=frames), moving)[frames:, -6:]
    expected = np.concatenate([(speed + push * time[:, None]) @ turned, np.tile(push @ turned, (30, 1))], axis=1)
    np.testing.assert_allclose(found[:, :3], expected[frames:, :3], atol=1e-3)
    np.testing.assert_allclose(found[:, 3:], expected[frames:, 3:], atol=0.05)


def test_a_missing_frame_does_not_change_the_speed(motion) -> None:
    poses = motion(20, 0)
    steady = replace(poses, translations=(poses.frame_ids[:, None] / 60.0 * np.ones(3)).astype(np.float32))
    kept = np.array([0, 1, 2, 3, 5, 8, 9, 10])
    gappy = replace(
        steady,
        rotations=steady.rotations[kept],
        translations=steady.translations[kept],
        frame_ids=poses.frame_ids[kept],
    )
    speed = np.linalg.norm(control_vectors(layout(), gappy)[1:, -6:-3], axis=1)
    np.testing.assert_allclose(speed, np.sqrt(3), rtol=1e-4)


def test_whole_rotations_are_products_and_lags_are_differences_to_earlier_frames(motion) -> None:
    poses = motion(12, 0)
    chosen = layout(whole_rotations=True, lags=(2, 30), root_motion=False)
    rows = control_vectors(chosen, poses)
    assert rows.shape == (12, chosen.size) == (12, 3 * 24)
    top = poses.rotations[:, 1].astype(float) @ poses.rotations[:, 2] - np.eye(3)
    np.testing.assert_allclose(rows[:, 18:24], top[:, :, :2].reshape(12, 6), atol=1e-6)
    np.testing.assert_allclose(rows[2:, 24:48], rows[2:, :24] - rows[:-2, :24], atol=1e-6)
    np.testing.assert_allclose(rows[:2, 24:48], rows[:2, :24] - rows[0, :24], atol=1e-6)
    np.testing.assert_allclose(rows[:, 48:], rows[:, :24] - rows[0, :24], atol=1e-6)


@pytest.mark.parametrize(
    "settings",
    [{}, {"up": True, "joint_velocity": True}, {"root_motion": False}, {"whole_rotations": True, "lags": (3, 9)}],
)
def test_streaming_equals_batch_and_never_looks_ahead(motion, settings) -> None:
    poses, chosen = motion(25, 1), layout(**settings)
    whole = control_vectors(chosen, poses)
    assert whole.shape == (25, chosen.size)
    cut = replace(
        poses, rotations=poses.rotations[:10], translations=poses.translations[:10], frame_ids=poses.frame_ids[:10]
    )
    np.testing.assert_array_equal(control_vectors(chosen, cut), whole[:10])
    stream = ControlStream(chosen)
    for row in range(25):
        said = stream.push(poses.rotations[row], poses.translations[row], float(poses.frame_ids[row] / 60.0))
        np.testing.assert_allclose(said, whole[row], rtol=1e-6, atol=1e-6)


def test_turning_the_world_changes_nothing_but_where_up_is(motion) -> None:
    poses = motion(12, 2)
    turn = Rotation.from_euler("y", 40, degrees=True).as_matrix()
    rotations = poses.rotations.copy()
    rotations[:, 0] = turn @ rotations[:, 0]
    turned = replace(poses, rotations=rotations, translations=(poses.translations @ turn.T).astype(np.float32))
    chosen = layout(up=True, joint_velocity=True)
    np.testing.assert_allclose(control_vectors(chosen, turned), control_vectors(chosen, poses), atol=2e-2)


def test_other_skeletons_and_rates_are_refused(motion) -> None:
    poses = motion(5, 0)
    with pytest.raises(InputError, match="found 3 \\(a, b, c"):
        control_vectors(layout(), replace(poses, joint_names=("a", "b", "c")))
    with pytest.raises(InputError, match="expected 60 frames a second"):
        control_vectors(layout(), replace(poses, fps=30.0))
