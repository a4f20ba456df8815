"""Motions that no garment of ours was taught: a spin, a jump, a cartwheel, noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import ShapedBody
from capture4d.motions.retargeting import pose_sequence
from capture4d.types import PoseSequence

__all__ = ["unseen_motions"]

SPIN_HZ, CARTWHEEL_S = 1.5, 1.2
JUMP_S, JUMP_M = 0.7, 0.45
NOISE_DEG = 12.0
"""Standard deviation of every joint's angle, drawn anew for every frame."""
DOWN_DEG, UP_DEG = -40.0, 115.0
"""Arms lie against the trunk, or are overhead; 0 is the rest pose, whose arms point half downwards."""


def unseen_motions(person: ShapedBody, fps: float, frames: int) -> Mapping[str, PoseSequence]:
    """The motions by name, `frames` long each."""
    time = np.arange(frames) / fps
    still = np.zeros(frames)
    down = np.full(frames, DOWN_DEG)
    phase = np.clip((time % (2 * JUMP_S)) / JUMP_S, 0, 1)
    height = 4 * JUMP_M * phase * (1 - phase)
    swing = DOWN_DEG + (UP_DEG - DOWN_DEG) * np.sin(np.pi * phase) ** 2
    turn = 360.0 * np.clip(time / CARTWHEEL_S, 0, 1)
    path = np.stack([np.clip(time / CARTWHEEL_S, 0, 1) * 1.5, 0 * time, 0 * time], axis=1)
    rng = np.random.default_rng(0)
    wild = Rotation.from_rotvec(
        np.radians(NOISE_DEG) * rng.standard_normal((frames * len(person.joints), 3)) / np.sqrt(3)
    ).as_matrix()
    shaken = 0.02 * rng.standard_normal((frames, 3))
    return {
        "spin": _posed(person, fps, down, Rotation.from_euler("y", (360 * SPIN_HZ * time)[:, None], degrees=True)),
        "jump": _posed(person, fps, swing, Rotation.identity(frames), np.stack([still, height, still], axis=1)),
        "cartwheel": _posed(person, fps, still + UP_DEG, Rotation.from_euler("z", turn[:, None], degrees=True), path),
        "noise": pose_sequence(person, wild.reshape(frames, -1, 3, 3), fps, shaken),
    }


def _posed(
    person: ShapedBody, fps: float, arms_deg: np.ndarray, root: Rotation, path: np.ndarray | None = None
) -> PoseSequence:
    """Arms raised sideways to an angle, the whole body turned about the root."""
    names, frames = person.body.joint_names, len(arms_deg)
    rotations = np.tile(np.eye(3), (frames, len(names), 1, 1))
    for side, sign in (("L", 1), ("R", -1)):
        shoulder = names.index(f"upperarm01.{side}")
        rotations[:, shoulder] = Rotation.from_euler("z", sign * arms_deg[:, None], degrees=True).as_matrix()
    rotations[:, 0] = root.as_matrix()
    return pose_sequence(person, rotations, fps, path)
