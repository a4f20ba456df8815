"""Parameters of SMPL bodies on a body of ours, and back: which axis of their world is up, and where the pelvis is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from capture4d.body.skinning import with_shape
from capture4d.motions.anatomy import find_anatomy
from capture4d.motions.clips import AXES, Clip, MotionWords, axis_name, axis_turn, world_frame
from capture4d.motions.retargeting import SMPL_ORIGIN, SMPL_TREE, as_smpl, is_smpl, retarget
from capture4d.motions.smpl_parameters import SmplParameters
from capture4d.types import Body, PoseSequence

__all__ = ["AMASS_AXES", "on_body", "smpl_up", "to_smpl"]

AMASS_AXES = axis_turn(AXES["z"])
"""AMASS's world, Z up: its axes that are our X, Y and Z, as columns."""
_STANDS = 0.7
"""Length of the mean direction of the trunk along an axis of which nobody doubts that it is up."""
_LIES_M = (0.02, 0.45)
"""Height over the floor of the pelvis of someone who lies or crawls."""


def smpl_up(found: SmplParameters, words: MotionWords) -> tuple[Float64[np.ndarray, "3 3"], list[str]]:
    """Axes of the parameters' world that become ours, as columns, and what is to be told of them.

    AMASS has Z up, most estimators Y, some the camera's -Y: nothing in the files says which. It is the axis along which
    trunks stand.
    """
    trunk = found.rotations[:, 0, :, 1]
    if found.about_origin is not None:
        trunk = np.einsum("tab,tb->ta", found.about_origin, trunk)
    mean = trunk.mean(axis=0)
    seen = max(AXES.values(), key=lambda axis: float(axis @ mean))
    usual = AXES["z"]
    if words.up:
        return world_frame(AXES[words.up], words), []
    if (seen == usual).all() or seen @ mean < _STANDS or _lies(found, seen):
        doubt = seen @ mean < _STANDS or not (seen == usual).all()
        notes = ["Z up, as AMASS has it; the trunk does not show it, --up says which it is"] if doubt else []
        return world_frame(usual, words), notes or ["Z up"]
    return world_frame(seen, words), [f"{axis_name(seen)} up, found from the trunk; --up says if it is not"]


def _lies(found: SmplParameters, seen: np.ndarray) -> bool:
    """Whether Z is up and the subject lies along another axis: low over Z's floor all the time, not high over the
    other's."""
    low, high = _LIES_M
    heights, others = found.places[:, 2], found.places @ seen
    return bool(low < heights.min() and heights.max() < high) and not 0.6 < np.median(others) < 1.5


def on_body(
    path: Path,
    body: Body,
    found: SmplParameters,
    axes: Float64[np.ndarray, "3 3"],
    fps: float,
    *,
    shape: Float[np.ndarray, " shapes"] | None = None,
) -> PoseSequence:
    """Parameters on a body, Y up.

    Args:
        axes: of the parameters' world that are our X, Y and Z, as columns.
        shape: of the body, instead of the parameters' own.
    """
    origin = body.joints[0].astype(np.float64) if is_smpl(body.joint_names) else np.array(SMPL_ORIGIN)
    rotations, pelvis = found.rotations.copy(), found.places + origin
    if found.about_origin is not None:
        pelvis = found.places + np.einsum("tab,b->ta", found.about_origin, origin)
        rotations[:, 0] = found.about_origin @ rotations[:, 0]
    rotations[:, 0] = axes.T @ rotations[:, 0]
    pelvis = pelvis @ axes
    if is_smpl(body.joint_names):
        betas = found.betas if shape is None else shape
        return _for_smpl(body, rotations, pelvis - origin, betas, fps)
    parents = [parent for parent, _ in SMPL_TREE.values()]
    world, rest = rotations, np.array([offset for _, offset in SMPL_TREE.values()])
    for joint, parent in enumerate(parents):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ world[:, joint]
            rest[joint] += rest[parent]
    anatomy = find_anatomy(tuple(SMPL_TREE), np.array(parents))
    clip = Clip(path, anatomy, rest, world, pelvis, 1 / fps)
    return retarget(with_shape(body, np.zeros(0, np.float32)), clip, fps, place="world")


def _for_smpl(
    body: Body, rotations: np.ndarray, translations: np.ndarray, betas: np.ndarray | None, fps: float
) -> PoseSequence:
    """Poses of SMPL's 22 shared joints on a body of that family; hands stay at rest."""
    everything = np.tile(np.eye(3), (len(rotations), len(body.joint_names), 1, 1))
    everything[:, :22] = rotations
    shape = np.zeros(0) if betas is None else betas.reshape(-1)[: len(body.shape_directions)]
    return PoseSequence(
        everything.astype(np.float32),
        translations.astype(np.float32),
        shape.astype(np.float32),
        np.arange(len(rotations), dtype=np.int32),
        fps,
        body.joint_names,
    )


def to_smpl(body: Body, poses: PoseSequence) -> SmplParameters:
    """Poses as parameters in AMASS's world."""
    if is_smpl(body.joint_names):
        origin = body.joints[0].astype(np.float64)
        rotations = poses.rotations[:, :22].astype(np.float64)
        pelvis = poses.translations + origin
    else:
        origin = np.array(SMPL_ORIGIN)
        rotations, pelvis = as_smpl(with_shape(body, poses.shape), poses)
    rotations[:, 0] = AMASS_AXES @ rotations[:, 0]
    return SmplParameters(rotations, pelvis @ AMASS_AXES.T - origin, None, None, poses.fps, ())
