"""How each limb of ours, at rest, lies in the frame of the joint that moves it.

Two rest poses that are both of a standing person differ by little: the smallest turn from our limb to theirs is it.
Some tools write skeletons whose every bone lies along one axis when nothing is turned (LAFAN1, some Maya and Max rigs):
no person stands like that, and how limbs are rolled about themselves shows in their motion only. Knees and elbows bend
to one side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.motions.clips import UPRIGHT_DEG, Clip

__all__ = ["aligned", "rest_turns", "trunk_turns"]

_FOOT = np.array([0.0, -0.05, 0.12])
"""From ankle to toes of someone who stands."""
_BENT = 0.05
"""Mean sine of a joint that is bent enough to show its axis."""
_TURNED_DEG = 70.0
"""Nobody goes about with a head that is turned, or a spine that is twisted from one joint to the next, by as much."""
_SNAP_DEG = 30.0
"""Joints whose axes are as near to those of a standing person, turned by right angles, were made so."""
_FLEXES = {"hip": np.array([0.0, 0.0, -1.0]), "shoulder": np.array([0.0, 0.0, 1.0])}
"""Where shin and forearm go when knee and elbow bend, in a T-pose."""


def rest_turns(clip: Clip, bones: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Part of a limb -> rotation (3, 3) of our rest pose onto the source's, the identity for hands' and feet's ends.

    Args:
        bones: part -> from it to the next one in our rest pose.
    """
    turns = {part: np.eye(3) for part in clip.anatomy.limbs}
    for part in bones:
        if part.endswith(("hip", "knee", "shoulder", "elbow")):
            turns[part] = aligned(bones[part], _bone(clip, part))
    for side in ("left", "right"):
        turns[f"{side}_wrist"] = turns[f"{side}_elbow"]
        if _stands(clip):
            continue
        collar = f"{side}_collar"
        if (
            collar in bones
            and collar in clip.anatomy.limbs
            and np.linalg.norm(clip.bone(collar, f"{side}_shoulder")) > 1e-9
        ):
            turns[collar] = aligned(_t_pose(collar), clip.bone(collar, f"{side}_shoulder"))
        turns |= _leg_by_motion(clip, bones, side, turns) | _hinge(clip, bones, f"{side}_shoulder", turns)
        turns[f"{side}_wrist"] = turns[f"{side}_elbow"]
    return turns


def _t_pose(part: str) -> np.ndarray:
    """Where a limb points in a T-pose."""
    side, _, limb = part.partition("_")
    return np.array([0.0, -1.0, 0.0] if limb in ("hip", "knee") else [1.0 if side == "left" else -1.0, 0.0, 0.0])


def trunk_turns(clip: Clip) -> dict[int, np.ndarray]:
    """Joint of the trunk -> rotation (3, 3) of our rest pose onto the source's; nothing where its trunk stands at rest.

    Where the pelvis has the axes of the world and the spine lies along its bones, or the like, no rest pose shows how
    they belong together: the hips tell how the pelvis is turned, and each other joint is on average turned as the one
    below it.
    """
    anatomy = clip.anatomy
    chain = [anatomy.pelvis, *anatomy.spine, *anatomy.neck, anatomy.head]
    steps = dict(zip(chain, np.diff(clip.rest[chain], axis=0), strict=False))
    bones = {joint: bone / np.linalg.norm(bone) for joint, bone in steps.items() if np.linalg.norm(bone) > 1e-9}
    if not any(bone[1] < np.cos(np.radians(UPRIGHT_DEG)) for bone in bones.values()) and not _turned(clip, chain):
        return {}
    left = clip.bone("right_hip", "left_hip")
    up = bones.get(chain[0], np.array([0.0, 1.0, 0.0]))
    if not np.linalg.norm(np.cross(left, up)) > 1e-3 * np.linalg.norm(left):
        return {}
    turns = {chain[0]: _snapped(_frame(left, up))}
    for below, joint in pairwise(chain):
        carrier = clip.world[:, below] @ turns[below]
        mean = Rotation.from_matrix(np.swapaxes(clip.world[:, joint], 1, 2) @ carrier).mean().as_matrix()
        turn = aligned(mean[:, 1], bones[joint]) @ mean if joint in bones else mean
        turns[joint] = _snapped(turn)
    return turns


def _turned(clip: Clip, chain: Sequence[int]) -> bool:
    """Whether joints of a trunk whose bones stand are turned about them as no person's are."""
    for above, below in pairwise(chain):
        local = Rotation.from_matrix(np.swapaxes(clip.world[:, above], 1, 2) @ clip.world[:, below]).mean()
        x, y, z, w = local.as_quat()
        sine = np.linalg.norm([x, y, z]) if below == chain[-1] else abs(y)
        if 2 * np.degrees(np.arctan2(sine, abs(w))) > _TURNED_DEG:
            return True
    return False


def _snapped(turn: np.ndarray) -> np.ndarray:
    """A rotation by right angles, where it is near one."""
    group = Rotation.create_group("O").as_matrix()
    nearest = group[np.argmax(np.einsum("nab,ab->n", group, turn))].round()
    near = np.degrees(Rotation.from_matrix(nearest.T @ turn).magnitude()) < _SNAP_DEG
    return nearest if near else turn


_NEXT = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}


def _bone(clip: Clip, part: str) -> np.ndarray:
    side, _, limb = part.partition("_")
    bone = clip.bone(part, f"{side}_{_NEXT[limb]}")
    if not np.linalg.norm(bone) > 1e-6 * max(clip.leg, 1e-12):
        said = f"expected bones with a length, found none from {part} to {side}_{_NEXT[limb]}"
        raise InputError(said.replace("_", " "), where=clip.path)
    return bone


def _stands(clip: Clip) -> bool:
    """Whether the legs point down at rest, more or less."""
    legs = [clip.bone(f"{side}_hip", f"{side}_knee") for side in ("left", "right")]
    return all(leg[1] < 0.3 * np.linalg.norm(leg) for leg in legs)


def _leg_by_motion(
    clip: Clip, bones: Mapping[str, np.ndarray], side: str, turns: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    found = _hinge(clip, bones, f"{side}_hip", turns)
    limbs = clip.anatomy.limbs
    knee, ankle, foot = (limbs.get(f"{side}_{part}") for part in ("knee", "ankle", "foot"))
    assert knee is not None
    assert ankle is not None
    local = np.swapaxes(clip.world[:, knee], 1, 2) @ clip.world[:, ankle]
    across = (
        local.mean(axis=0).T @ found[f"{side}_knee"] @ aligned(bones[f"{side}_knee"], _t_pose(f"{side}_knee")).T[:, 0]
    )
    toes = None if foot is None else clip.rest[foot] - clip.rest[ankle]
    if toes is None or not np.linalg.norm(toes) > 1e-9:
        mean = Rotation.from_matrix(local).mean().as_matrix()
        return {**found, f"{side}_ankle": mean.T @ found[f"{side}_knee"]}
    return {**found, f"{side}_ankle": _frame(toes, across) @ _frame(_FOOT, np.array([1.0, 0.0, 0.0])).T}


def _hinge(
    clip: Clip, bones: Mapping[str, np.ndarray], part: str, turns: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Turns of the two bones that meet in a knee or an elbow, from where the second goes when it bends."""
    side, _, limb = part.partition("_")
    middle = f"{side}_{_NEXT[limb]}"
    upper, lower = _bone(clip, part), _bone(clip, middle)
    limbs = clip.anatomy.limbs
    local = np.swapaxes(clip.world[:, limbs[part]], 1, 2) @ clip.world[:, limbs[middle]]
    along = upper / np.linalg.norm(upper)
    bends = local @ (lower / np.linalg.norm(lower))
    bend = (bends - (bends @ along)[:, None] * along).mean(axis=0)
    if np.linalg.norm(bend) < _BENT:
        return {part: turns[part], middle: turns[middle]}
    axis = np.cross(along, bend)
    carried = (np.swapaxes(local, 1, 2) @ axis).mean(axis=0)
    straight = _t_pose(part)
    ours = _frame(straight, np.cross(straight, _FLEXES[limb])).T
    return {
        part: _frame(upper, axis) @ ours @ aligned(bones[part], straight),
        middle: _frame(lower, carried) @ ours @ aligned(bones[middle], straight),
    }


def _frame(along: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Bone, hinge axis made square to it, and what is across both, as columns."""
    first = along / np.linalg.norm(along)
    second = axis - (axis @ first) * first
    second = second / max(np.linalg.norm(second), 1e-12)
    return np.stack([first, second, np.cross(first, second)], axis=1)


def aligned(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The smallest rotation, (3, 3), that turns one direction onto another."""
    unit = np.stack([target / np.linalg.norm(target), source / np.linalg.norm(source)])
    return Rotation.align_vectors(unit[:1], unit[1:])[0].as_matrix()
