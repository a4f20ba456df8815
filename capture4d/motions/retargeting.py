"""Motion from one skeleton to another.

Retargeting copies world rotations relative to the rest pose of the source, part by part, after turning each limb of our
rest pose onto the source's, so that bone lengths and rest poses may differ. Spine and neck are shared out: the
rotation at each share of our spine is that of the source at the same share of its own, between two of its joints by
spherical interpolation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation, Slerp

from capture4d.body.skinning import ShapedBody, with_pose
from capture4d.errors import InputError
from capture4d.motions.clips import Clip
from capture4d.motions.rest_alignment import aligned, rest_turns, trunk_turns
from capture4d.types import PoseSequence

__all__ = ["SMPL_ORIGIN", "SMPL_TREE", "as_smpl", "frame_times", "is_smpl", "pose_sequence", "relative", "retarget"]


@dataclass(frozen=True, slots=True)
class _Skeleton:
    """What a body that can be moved calls the parts of a person; its other joints follow their parents."""

    limbs: Mapping[str, str]
    """Part -> joint."""
    spine: tuple[str, ...]
    neck: tuple[str, ...]
    pelvis: str
    head: str

    @property
    def drives(self) -> dict[str, str]:
        """Joint -> the part of SMPL that moves it."""
        trunk = zip(("spine1", "spine2", "spine3"), self.spine, strict=True)
        return {
            self.pelvis: "pelvis", self.head: "head", self.neck[0]: "neck", **{joint: part for part, joint in trunk},
            **{joint: part for part, joint in self.limbs.items()},
        }  # fmt: skip


SMPL_TREE: dict[str, tuple[int, tuple[float, float, float]]] = {
    "pelvis": (-1, (0.0, 0.945, 0.0)),
    "left_hip": (0, (0.07, -0.09, 0.0)),
    "right_hip": (0, (-0.07, -0.09, 0.0)),
    "spine1": (0, (0.0, 0.11, 0.0)),
    "left_knee": (1, (0.0, -0.40, 0.0)),
    "right_knee": (2, (0.0, -0.40, 0.0)),
    "spine2": (3, (0.0, 0.13, 0.0)),
    "left_ankle": (4, (0.0, -0.41, 0.0)),
    "right_ankle": (5, (0.0, -0.41, 0.0)),
    "spine3": (6, (0.0, 0.06, 0.0)),
    "left_foot": (7, (0.0, -0.05, 0.12)),
    "right_foot": (8, (0.0, -0.05, 0.12)),
    "neck": (9, (0.0, 0.21, 0.0)),
    "left_collar": (9, (0.08, 0.11, 0.0)),
    "right_collar": (9, (-0.08, 0.11, 0.0)),
    "head": (12, (0.0, 0.09, 0.05)),
    "left_shoulder": (13, (0.10, 0.03, 0.0)),
    "right_shoulder": (14, (-0.10, 0.03, 0.0)),
    "left_elbow": (16, (0.26, 0.0, 0.0)),
    "right_elbow": (17, (-0.26, 0.0, 0.0)),
    "left_wrist": (18, (0.25, 0.0, 0.0)),
    "right_wrist": (19, (-0.25, 0.0, 0.0)),
}
"""SMPL's first 22 joints, which its whole family shares: parent and offset of an adult in a T-pose, rounded, metres."""

SMPL_ORIGIN = (0.0, -0.22, 0.03)
"""The pelvis of SMPL's mean body at rest from the origin of its file, rounded, metres: translations start there."""

AIMS = {
    "spine1": "spine2", "spine2": "spine3", "spine3": "neck", "neck": "head",
    **{f"{side}_{joint}": f"{side}_{following}" for side in ("left", "right") for joint, following in (
        ("hip", "knee"), ("knee", "ankle"), ("collar", "shoulder"), ("shoulder", "elbow"), ("elbow", "wrist"))},
}  # fmt: skip
"""The joint that each joint of SMPL's chains carries next."""

_LIMBS = {"hip": "upperleg01", "knee": "lowerleg01", "ankle": "foot", "collar": "clavicle", "shoulder": "upperarm01",
          "elbow": "lowerarm01", "wrist": "wrist"}  # fmt: skip
_BUILT_IN = _Skeleton(
    {f"{side}_{part}": f"{joint}.{letter}" for side, letter in (("left", "L"), ("right", "R"))
     for part, joint in _LIMBS.items()},
    ("spine05", "spine03", "spine01"), ("neck01", "neck02"), "root", "head",
)  # fmt: skip
_SMPL = _Skeleton(
    {f"{side}_{part}": f"{side}_{part}" for side in ("left", "right") for part in _LIMBS},
    ("spine1", "spine2", "spine3"), ("neck",), "pelvis", "head",
)  # fmt: skip


def is_smpl(joint_names: Sequence[str]) -> bool:
    return tuple(joint_names[:22]) == tuple(SMPL_TREE)


def _skeleton(shaped: ShapedBody) -> _Skeleton:
    """Of a body; it has every limb.

    Raises:
        InputError: the body lacks some of them.
    """
    names = shaped.body.joint_names
    found = _SMPL if is_smpl(names) else _BUILT_IN
    _require_joints(shaped, [joint for part, joint in found.limbs.items() if not part.endswith("collar")])
    return found


def retarget(
    shaped: ShapedBody,
    clip: Clip,
    fps: float,
    *,
    first_frame: int = 0,
    place: Literal["origin", "world"] = "origin",
) -> PoseSequence:
    """Move a person like a clip.

    Resampled to `fps` by spherical interpolation, scaled by leg length, feet on the floor.

    Args:
        first_frame: where to start, in frames of the result.
        place: `origin` turns the clip to face +Z and starts it above the origin; `world` leaves it where it is.
    Raises:
        InputError: the clip is shorter, or the body lacks limbs that it drives.
    """
    skeleton = _skeleton(shaped)
    duration = (len(clip.world) - 1) * clip.frame_time_s
    at = frame_times(duration, fps, len(clip.world), first_frame=first_frame)
    if not len(at):
        raise InputError(
            f"expected a clip longer than {first_frame} frames, found {duration * fps:.0f}", where=clip.path
        )
    times = np.arange(len(clip.world)) * clip.frame_time_s
    joints, parents = shaped.joints, shaped.body.parents
    turn = np.eye(3)
    if place == "origin":
        facing = clip.world[round(first_frame / fps / clip.frame_time_s), clip.anatomy.pelvis, :, 2]
        turn = Rotation.from_euler("y", -np.arctan2(facing[0], facing[2])).as_matrix()

    driven = _driven(shaped, skeleton, clip)
    world_target = np.empty((len(at), len(joints), 3, 3))
    for joint, name in enumerate(shaped.body.joint_names):
        if name not in driven:
            world_target[:, joint] = world_target[:, parents[joint]]
            continue
        path = Rotation.from_matrix(driven[name])
        if len(times) > 1:
            path = Slerp(times, path)(np.clip(at, 0, times[-1]))
        world_target[:, joint] = turn @ path.as_matrix()
    scale = _leg(shaped, skeleton) / clip.leg
    path = np.stack([np.interp(at, times, clip.pelvis[:, axis]) for axis in range(3)], axis=1)
    translations = (path - path[0]) @ turn.T * scale if place == "origin" else path * scale - joints[0]
    return pose_sequence(shaped, relative(world_target, parents), fps, translations)


def frame_times(duration: float, fps: float, count: int, *, first_frame: int = 0) -> np.ndarray:
    """Seconds at which a clip of `count` frames is sampled at another rate.

    Raises:
        InputError: so many more frames that the file's rate, or the wanted one, is none.
    """
    most = max(100_000, 100 * count)
    if not duration * fps < most:
        raise InputError(
            f"expected at most {most} frames at {fps:g} fps of a clip of {count}, found {duration * fps:.4g}"
        )
    return np.arange(first_frame / fps, duration + 0.1 / fps, 1 / fps)  # files round their frame time


def _driven(shaped: ShapedBody, skeleton: _Skeleton, clip: Clip) -> dict[str, np.ndarray]:
    """World rotations (T, 3, 3) of the joints that the clip moves, by name."""
    anatomy, world = clip.anatomy, clip.world.copy()
    for joint, turn in trunk_turns(clip).items():
        world[:, joint] = world[:, joint] @ turn
    spine = _shared(world, anatomy.pelvis, anatomy.spine, len(skeleton.spine))
    # Without a joint of its own, the neck takes its part of how the head is turned from the chest.
    through = anatomy.neck or (anatomy.head,)
    neck = _shared(world, anatomy.chest, through, len(skeleton.neck) + (not anatomy.neck))
    driven = {skeleton.pelvis: world[:, anatomy.pelvis], skeleton.head: world[:, anatomy.head]}
    driven |= dict(zip(skeleton.spine, spine, strict=True)) | dict(zip(skeleton.neck, neck, strict=False))
    turns = rest_turns(clip, _rest_bones(shaped, skeleton))
    for part, name in skeleton.limbs.items():
        if part in anatomy.limbs:
            driven[name] = world[:, anatomy.limbs[part]] @ turns[part]
    return driven


def _shared(world: np.ndarray, base: int, chain: Sequence[int], count: int) -> list[np.ndarray]:
    """Rotations (T, 3, 3) at `count` equal shares of a chain of joints, from above its base to its end."""
    if not chain:
        return [world[:, base]] * count
    known = [base, *chain]
    shares = []
    for place in np.arange(1, count + 1) * len(chain) / count:
        before = min(int(place), len(chain) - 1)
        part, start = place - before, world[:, known[before]]
        if part in (0.0, 1.0):
            shares.append(world[:, known[before + int(part)]])
            continue
        step = Rotation.from_matrix(np.swapaxes(start, 1, 2) @ world[:, known[before + 1]]).as_rotvec()
        shares.append(start @ Rotation.from_rotvec(part * step).as_matrix())
    return shares


def _rest_bones(shaped: ShapedBody, skeleton: _Skeleton) -> dict[str, np.ndarray]:
    """Part of a limb -> from it to the next one at rest."""
    names = shaped.body.joint_names
    places = {part: shaped.joints[names.index(name)] for part, name in skeleton.limbs.items() if name in names}
    return {part: places[AIMS[part]] - places[part] for part in places if part in AIMS}


def as_smpl(shaped: ShapedBody, poses: PoseSequence) -> tuple[Float64[np.ndarray, "frames 22 3 3"], np.ndarray]:
    """The inverse of `retarget` onto SMPL's first 22 joints, in the world of the poses.

    What lies between two joints that SMPL knows, such as every second joint of our spine, is summed up in the next;
    each joint then turns the least that points it at where the next one really is.

    Returns:
        Local rotations, and where the pelvis is, (T, 3).
    """
    skeleton, tree = _skeleton(shaped), list(SMPL_TREE)
    _require_joints(shaped, skeleton.drives)
    names = list(shaped.body.joint_names)
    ours, centres = _world(shaped, poses)
    driver = {part: joint for joint, part in skeleton.drives.items()}
    bones = _rest_bones(shaped, skeleton)
    world = np.empty((len(ours), len(tree), 3, 3))
    for joint, part in enumerate(tree):
        if part not in driver:
            world[:, joint] = world[:, SMPL_TREE[part][0]]
            continue
        mine = names.index(driver[part])
        bone = part.replace("wrist", "elbow")  # a hand goes with its arm
        if bone.endswith(("hip", "knee", "shoulder", "elbow")):
            world[:, joint] = ours[:, mine] @ aligned(bones[bone], np.array(SMPL_TREE[AIMS[bone]][1])).T
        else:
            world[:, joint] = ours[:, mine]
        if part in AIMS:
            aim = names.index(driver[AIMS[part]])
            expected = ours[:, mine] @ (shaped.joints[aim] - shaped.joints[mine])
            world[:, joint] = _smallest_turns(expected, centres[:, aim] - centres[:, mine]) @ world[:, joint]
    leg = sum(float(np.linalg.norm(SMPL_TREE[part][1])) for part in ("left_knee", "left_ankle"))
    parents = np.array([parent for parent, _ in SMPL_TREE.values()])
    return relative(world, parents), (poses.translations + shaped.joints[0]) * leg / _leg(shaped, skeleton)


def _require_joints(shaped: ShapedBody, names: Iterable[str]) -> None:
    missing = sorted(set(names) - set(shaped.body.joint_names))
    if missing:
        raise InputError(f"body: expected joints named as the built-in body's, found none called {missing[0]}")


def _world(shaped: ShapedBody, poses: PoseSequence) -> tuple[np.ndarray, np.ndarray]:
    """World rotations (T, J, 3, 3) and centres (T, J, 3) of the joints."""
    rotations = poses.rotations.astype(np.float64)
    centres = np.tile(shaped.joints[0] + poses.translations[:, None], (1, len(shaped.joints), 1))
    for joint in range(1, len(shaped.joints)):
        parent = shaped.body.parents[joint]
        centres[:, joint] = centres[:, parent] + rotations[:, parent] @ (shaped.joints[joint] - shaped.joints[parent])
        rotations[:, joint] = rotations[:, parent] @ rotations[:, joint]
    return rotations, centres


def pose_sequence(
    shaped: ShapedBody, rotations: np.ndarray, fps: float, translations: np.ndarray | None = None
) -> PoseSequence:
    """Stand a motion on the floor: one vertical shift for the whole clip puts its lowest point at y = 0.

    Args:
        rotations: (T, J, 3, 3).
        translations: (T, 3) of the root, metres; zero if None.
    """
    count = len(rotations)
    translations = np.zeros((count, 3)) if translations is None else translations.copy()
    probes = np.linspace(0, count - 1, min(count, 24)).round().astype(int)
    lowest = min(with_pose(shaped, rotations[t], translations[t]).vertices()[:, 1].min() for t in probes)
    translations[:, 1] -= lowest
    return PoseSequence(
        rotations.astype(np.float32),
        translations.astype(np.float32),
        shaped.shape.astype(np.float32),
        np.arange(count, dtype=np.int32),
        fps,
        shaped.body.joint_names,
    )


def relative(world: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """World rotations (T, J, 3, 3) relative to their parents'."""
    local = world.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[:, joint] = np.swapaxes(world[:, parent], 1, 2) @ world[:, joint]
    return local


def _leg(shaped: ShapedBody, skeleton: _Skeleton) -> float:
    """Thigh and shin, metres."""
    bones = _rest_bones(shaped, skeleton)
    return float(np.linalg.norm(bones["left_hip"]) + np.linalg.norm(bones["left_knee"]))


def _smallest_turns(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The same for many directions, (T, 3) each: (T, 3, 3)."""
    source, target = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (source, target))
    across = np.cross(source, target)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, np.einsum("ta,ta->t", source, target))
    return Rotation.from_rotvec(across * (angle / np.maximum(sine, 1e-12))[:, None]).as_matrix()
