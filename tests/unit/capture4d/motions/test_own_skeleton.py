"""A body's own skeleton comes back from BVH in any unit, with any axes, and below joints of other tools."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.motions.bvh import read_bvh
from capture4d.motions.motion_files import read_motion, write_motion
from capture4d.types import Body, PoseSequence
from tests.bvh_files import Layout, Source, text
from tests.unit.capture4d.motions.conftest import joints_of

SHAPES = [np.zeros(0), np.array([1.5, -2.0, 0.5, 1.0])]


def standing(body: Body, shape: np.ndarray, frames: int = 4) -> PoseSequence:
    rng = np.random.default_rng(3)
    turns = Rotation.from_rotvec(0.2 * rng.standard_normal((frames * len(body.joint_names), 3))).as_matrix()
    places = np.outer(np.linspace(0, 1, frames), (0.5, 0.0, 0.3))
    return PoseSequence(
        turns.reshape(frames, -1, 3, 3).astype(np.float32), places.astype(np.float32), shape.astype(np.float32),
        np.arange(frames, dtype=np.int32), 50.0, body.joint_names,
    )  # fmt: skip


def written(body: Body, poses: PoseSequence, folder: Path) -> Source:
    """What our writer writes, in centimetres."""
    write_motion(folder / "own.bvh", body, poses)
    clip = read_bvh(folder / "own.bvh")
    local = clip.rotations.as_matrix().reshape(len(clip.translations), -1, 3, 3)
    parents = tuple(int(parent) for parent in clip.parents)
    return Source(clip.joint_names, parents, clip.offsets, local, clip.translations[:, 0])


@pytest.mark.parametrize("shape", SHAPES, ids=["mean", "another"])
@pytest.mark.parametrize("factor", [1.0, 0.01, 10.0, 1 / 2.54, 0.1, 1 / 30.48])
def test_any_unit(shape: np.ndarray, factor: float, light_body: Body, tmp_path: Path) -> None:
    poses = standing(light_body, shape)
    source = written(light_body, poses, tmp_path).scaled(factor)
    (tmp_path / "clip.bvh").write_text(text(source, Layout(frame_time="Frame Time: 0.02")))
    back = read_motion(tmp_path / "clip.bvh", light_body)
    assert back.fps == 50.0
    np.testing.assert_allclose(back.shape[: len(shape)], shape, atol=1e-3)
    assert np.linalg.norm(joints_of(light_body, back) - joints_of(light_body, poses), axis=2).max() < 1e-3


@pytest.mark.parametrize("turn", range(24))
def test_other_axes(turn: int, light_body: Body, tmp_path: Path) -> None:
    poses = standing(light_body, SHAPES[1])
    axes = Rotation.create_group("O").as_matrix().round()[turn]
    source = written(light_body, poses, tmp_path).in_axes(axes)
    (tmp_path / "clip.bvh").write_text(text(source.below("Armature") if turn % 2 else source, Layout(moved=turn % 2)))
    back = read_motion(tmp_path / "clip.bvh", light_body)
    np.testing.assert_allclose(back.shape[:4], SHAPES[1], atol=1e-3)
    assert np.linalg.norm(joints_of(light_body, back) - joints_of(light_body, poses), axis=2).max() < 1e-3


def test_a_file_of_ours_is_never_turned(light_body: Body, tmp_path: Path) -> None:
    """Its world is ours, however the subject lies in it."""
    poses = standing(light_body, SHAPES[0])
    poses.rotations[:, 0] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    poses.translations[:, 1] = -0.8
    write_motion(tmp_path / "own.bvh", light_body, poses)
    back = read_motion(tmp_path / "own.bvh", light_body)
    assert np.linalg.norm(joints_of(light_body, back) - joints_of(light_body, poses), axis=2).max() < 1e-4


@pytest.mark.parametrize("factor", [0.3, 3.7, 0.0004, 0.05])
def test_a_unit_of_its_own_is_told(factor: float, light_body: Body, tmp_path: Path) -> None:
    """Nothing but the right scale makes the bones those of a shape."""
    poses, notes = standing(light_body, SHAPES[1]), []
    source = written(light_body, poses, tmp_path).scaled(factor)
    (tmp_path / "clip.bvh").write_text(text(source))
    back = read_motion(tmp_path / "clip.bvh", light_body, say=notes.append)
    assert f"in units of {10 / factor:.4g} mm" in notes[-1]
    np.testing.assert_allclose(back.shape[:4], SHAPES[1], atol=0.01)
    assert np.linalg.norm(joints_of(light_body, back) - joints_of(light_body, poses), axis=2).max() < 1e-3


def test_another_skeleton_under_our_names_is_retargeted(light_body: Body, tmp_path: Path) -> None:
    """Shorter arms than any shape has: bones are not taken for a shape."""
    poses = standing(light_body, SHAPES[0])
    between = ["02" in name or "pelvis" in name for name in light_body.joint_names]  # which no other skeleton has
    poses.rotations[:, between] = np.eye(3)
    source = written(light_body, poses, tmp_path)
    arms = np.array(["arm" in name or "wrist" in name for name in source.names])
    source = replace(source, offsets=np.where(arms[:, None], 0.4 * source.offsets, source.offsets))
    (tmp_path / "clip.bvh").write_text(text(source))
    back = read_motion(tmp_path / "clip.bvh", light_body)
    assert not back.shape.any()
    here, there = joints_of(light_body, back), joints_of(light_body, poses)
    assert np.linalg.norm((here - there)[:, 1:6] - (here - there)[:, :1], axis=2).max() < 0.01
