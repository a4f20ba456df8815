"""Motion from one skeleton to another.

Retargeting copies world rotations relative to the T-pose of the source, joint by joint, after turning each limb of our
rest pose onto the source's, so that bone lengths and rest poses may differ.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from capture4d.body.skinning import ShapedBody, with_pose
from capture4d.errors import InputError
from capture4d.motions.bvh import Bvh
from capture4d.types import PoseSequence

__all__ = ["SMPL_TREE", "as_smpl", "pose_sequence", "retarget"]


@dataclass(frozen=True, slots=True)
class _Scheme:
    """Which joint of a file drives which of ours."""

    drives: dict[str, str]
    """Our joint -> the file's joint; joints of ours that are not named follow their parent."""
    limbs: dict[str, str]
    """Our limb joint -> the file's joint whose offset tells the limb's rest direction."""


def _scheme(
    trunk: dict[str, str], sides: tuple[str, str], leg: tuple[str, str, str], arm: tuple[str, str, str, str]
) -> _Scheme:
    """A scheme that names joints of the limbs by the side and the part.

    Args:
        trunk: our joint -> the file's joint.
        sides: what the names of left and right begin with.
        leg: hip, knee, ankle.
        arm: collar, shoulder, elbow, wrist.
    """
    drives, limbs = dict(trunk), {}
    for side, word in zip("LR", sides, strict=True):
        hip, knee, ankle = (word + part for part in leg)
        collar, shoulder, elbow, wrist = (word + part for part in arm)
        drives |= {
            f"upperleg01.{side}": hip,
            f"lowerleg01.{side}": knee,
            f"foot.{side}": ankle,
            f"clavicle.{side}": collar,
            f"upperarm01.{side}": shoulder,
            f"lowerarm01.{side}": elbow,
            f"wrist.{side}": wrist,
        }
        limbs |= {
            f"upperleg01.{side}": knee,
            f"lowerleg01.{side}": ankle,
            f"upperarm01.{side}": elbow,
            f"lowerarm01.{side}": wrist,
        }
    return _Scheme(drives, limbs)


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

AIMS = {
    "spine1": "spine2", "spine2": "spine3", "spine3": "neck", "neck": "head",
    **{f"{side}_{joint}": f"{side}_{following}" for side in ("left", "right") for joint, following in (
        ("hip", "knee"), ("knee", "ankle"), ("collar", "shoulder"), ("shoulder", "elbow"), ("elbow", "wrist"))},
}  # fmt: skip
"""The joint that each joint of SMPL's chains carries next."""

SCHEMES = (
    _scheme(
        {"root": "pelvis", "spine05": "spine1", "spine03": "spine2", "spine01": "spine3",
         "neck01": "neck", "head": "head"},
        ("left_", "right_"), leg=("hip", "knee", "ankle"), arm=("collar", "shoulder", "elbow", "wrist"),
    ),
    _scheme(
        {"root": "Hips", "spine05": "LowerBack", "spine03": "Spine", "spine01": "Spine1",
         "neck01": "Neck", "neck02": "Neck1", "head": "Head"},
        ("Left", "Right"), leg=("UpLeg", "Leg", "Foot"), arm=("Shoulder", "Arm", "ForeArm", "Hand"),
    ),
    _scheme(
        {"root": "Hips", "spine05": "lowerback", "spine03": "Chest", "spine01": "Chest2",
         "neck01": "lowerneck", "neck02": "Neck", "head": "Head"},
        ("Left", "Right"), leg=("Hip", "Knee", "Ankle"), arm=("Collar", "Shoulder", "Elbow", "Wrist"),
    ),
)  # fmt: skip
"""SMPL's naming, and the two of the CMU Graphics Lab database."""

LIMB_ENDS = {"upperleg01": "lowerleg01", "lowerleg01": "foot", "upperarm01": "lowerarm01", "lowerarm01": "wrist"}


def retarget(
    shaped: ShapedBody,
    bvh: Bvh,
    fps: float,
    *,
    first_frame: int = 0,
    place: Literal["origin", "world"] = "origin",
) -> PoseSequence:
    """Move a person like a BVH clip.

    Resampled to `fps` by spherical interpolation, scaled by leg length, feet on the floor.

    Args:
        first_frame: where to start, in frames of the result.
        place: `origin` turns the clip to face +Z and starts it above the origin; `world` leaves it where it is.
    Raises:
        InputError: the file's joint names follow none of the known schemes, or the body lacks limbs that it drives.
    """
    scheme = _match(bvh)
    _require_joints(shaped, {*scheme.limbs, "foot.L"})
    world = bvh.world_rotations()
    duration = (len(world) - 1) * bvh.frame_time_s
    at = np.arange(first_frame / fps, duration + 0.1 / fps, 1 / fps)  # files round their frame time
    if not len(at):
        raise InputError(
            f"expected a clip longer than {first_frame} frames, found {duration * fps:.0f}", where=bvh.path
        )
    times = np.arange(len(world)) * bvh.frame_time_s
    index = {name: slot for slot, name in enumerate(bvh.joint_names)}
    names, joints, parents = shaped.body.joint_names, shaped.joints, shaped.body.parents
    turn = np.eye(3)
    if place == "origin":
        facing = world[round(first_frame / fps / bvh.frame_time_s), index[scheme.drives["root"]]][:, 2]
        turn = Rotation.from_euler("y", -np.arctan2(facing[0], facing[2])).as_matrix()

    world_target = np.empty((len(at), len(names), 3, 3))
    for joint, name in enumerate(names):
        if name not in scheme.drives:
            world_target[:, joint] = world_target[:, parents[joint]]
            continue
        path = Rotation.from_matrix(world[:, index[scheme.drives[name]]])
        if len(times) > 1:
            path = Slerp(times, path)(np.clip(at, 0, times[-1]))
        world_target[:, joint] = turn @ path.as_matrix() @ _limb_alignment(shaped, scheme, bvh, name)
    scale = _leg(shaped) / _source_leg(scheme, bvh)
    path = np.stack([np.interp(at, times, bvh.root_positions[:, axis]) for axis in range(3)], axis=1)
    translations = (path - path[0]) @ turn.T * scale if place == "origin" else path * scale - joints[0]
    return pose_sequence(shaped, _relative(world_target, parents), fps, translations)


def as_smpl(shaped: ShapedBody, poses: PoseSequence) -> Bvh:
    """The inverse of `retarget` onto SMPL's first 22 joints, in the world of the poses.

    What lies between two joints that SMPL knows, such as every second joint of our spine, is summed up in the next;
    each joint then turns the least that points it at where the next one really is.
    """
    names = list(shaped.body.joint_names)
    scheme, tree = SCHEMES[0], list(SMPL_TREE)
    _require_joints(shaped, scheme.drives)
    source = Bvh(
        Path("SMPL"),
        tuple(tree),
        np.array([parent for parent, _ in SMPL_TREE.values()]),
        np.array([offset for _, offset in SMPL_TREE.values()]),
        Rotation.identity(len(poses.rotations) * len(tree)),
        np.zeros((len(poses.rotations), 3)),
        1 / poses.fps,
    )
    ours, centres = _world(shaped, poses)
    driver = {theirs: mine for mine, theirs in scheme.drives.items()}
    world = np.empty((len(ours), len(tree), 3, 3))
    for joint, name in enumerate(tree):
        if name not in driver:
            world[:, joint] = world[:, source.parents[joint]]
            continue
        alignment = _limb_alignment(shaped, scheme, source, driver[name])
        mine = names.index(driver[name])
        world[:, joint] = ours[:, mine] @ alignment.T
        if name in AIMS:
            aim = names.index(driver[AIMS[name]])
            expected = ours[:, mine] @ (shaped.joints[aim] - shaped.joints[mine])
            world[:, joint] = _smallest_turns(expected, centres[:, aim] - centres[:, mine]) @ world[:, joint]
    scale = _leg(shaped) / _source_leg(scheme, source)
    local = _relative(world, source.parents)
    return replace(
        source,
        rotations=Rotation.from_matrix(local.reshape(-1, 3, 3)),
        root_positions=(poses.translations + shaped.joints[0]) / scale,
    )


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


def _relative(world: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """World rotations (T, J, 3, 3) relative to their parents'."""
    local = world.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[:, joint] = np.swapaxes(world[:, parent], 1, 2) @ world[:, joint]
    return local


def _limb_alignment(shaped: ShapedBody, scheme: _Scheme, bvh: Bvh, name: str) -> np.ndarray:
    """Turns our limb in its rest pose onto the source's; the identity for what is no limb. A hand goes with its arm."""
    name = name.replace("wrist", "lowerarm01")
    if name not in scheme.limbs:
        return np.eye(3)
    names = shaped.body.joint_names
    stem, side = name.split(".")
    ours = shaped.joints[names.index(f"{LIMB_ENDS[stem]}.{side}")] - shaped.joints[names.index(name)]
    return _align(ours, bvh.offsets[bvh.joint_names.index(scheme.limbs[name])])


def _leg(shaped: ShapedBody) -> float:
    """Thigh and shin, metres."""
    hip, knee, ankle = (
        shaped.joints[shaped.body.joint_names.index(f"{name}.L")] for name in ("upperleg01", "lowerleg01", "foot")
    )
    return float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))


def _source_leg(scheme: _Scheme, bvh: Bvh) -> float:
    """The same of the source, in its unit."""
    ends = (scheme.limbs["upperleg01.L"], scheme.limbs["lowerleg01.L"])
    return float(sum(np.linalg.norm(bvh.offsets[bvh.joint_names.index(name)]) for name in ends))


def _match(bvh: Bvh) -> _Scheme:
    have = set(bvh.joint_names)
    missing = [sorted(set(scheme.drives.values()) - have) for scheme in SCHEMES]
    best = int(np.argmin([len(each) for each in missing]))
    if missing[best]:
        lacking = ", ".join(missing[best][:4])
        raise InputError(
            f"expected joints named as in SMPL or the CMU database, found none called {lacking}", where=bvh.path
        )
    return SCHEMES[best]


def _align(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The smallest rotation, (3, 3), that turns one direction onto another."""
    unit = np.stack([target / np.linalg.norm(target), source / np.linalg.norm(source)])
    return Rotation.align_vectors(unit[:1], unit[1:])[0].as_matrix()


def _smallest_turns(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The same for many directions, (T, 3) each: (T, 3, 3)."""
    source, target = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (source, target))
    across = np.cross(source, target)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, np.einsum("ta,ta->t", source, target))
    return Rotation.from_rotvec(across * (angle / np.maximum(sine, 1e-12))[:, None]).as_matrix()
