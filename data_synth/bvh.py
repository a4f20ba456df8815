"""BVH motion files, and their retargeting to the parametric body.

Retargeting copies world rotations relative to the T-pose of the file, joint by joint, after turning each limb of our
rest pose onto the file's, so that bone lengths and rest poses may differ.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from capture4d.body import ShapedBody
from capture4d.errors import InputError
from capture4d.types import PoseSequence

__all__ = ["Bvh", "read_bvh", "retarget"]


@dataclass(frozen=True, slots=True, eq=False)
class Bvh:
    """One clip as its file has it."""

    path: Path
    joint_names: tuple[str, ...]
    parents: np.ndarray
    """(J,) int, -1 for the root."""
    offsets: np.ndarray
    """(J, 3) from the parent, in the file's unit."""
    rotations: Rotation
    """(T * J) local rotations, frame by frame."""
    root_positions: np.ndarray
    """(T, 3) in the file's unit."""
    frame_time_s: float

    def world_rotations(self) -> np.ndarray:
        """(T, J, 3, 3) down the joint tree."""
        local = self.rotations.as_matrix().reshape(-1, len(self.joint_names), 3, 3)
        world = local.copy()
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                world[:, joint] = world[:, parent] @ local[:, joint]
        return world


def read_bvh(path: Path) -> Bvh:
    """Read a BVH file.

    Raises:
        InputError: missing file, or a line that does not fit the format; names file and line.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such BVH file")
    lines = path.read_text(errors="replace").splitlines()
    names, parents, offsets, channels, stack = [], [], [], [], []
    number, in_end_site, motion_at = 0, False, None
    try:
        for number, line in enumerate(lines, start=1):
            words = line.split()
            if not words:
                continue
            match words[0]:
                case "ROOT" | "JOINT":
                    names.append(words[1])
                    parents.append(stack[-1] if stack else -1)
                    offsets.append((0.0, 0.0, 0.0))
                    channels.append([])
                    pending = len(names) - 1
                case "End":
                    in_end_site, pending = True, -1
                case "{":
                    stack.append(pending)
                case "}":
                    in_end_site = False
                    stack.pop()
                case "OFFSET" if not in_end_site:
                    offsets[stack[-1]] = tuple(float(word) for word in words[1:4])
                case "CHANNELS":
                    channels[stack[-1]] = words[2 : 2 + int(words[1])]
                case "MOTION":
                    motion_at = number
                    break
        if motion_at is None:
            raise InputError(f"{path}: expected a MOTION section, found the end of the file at line {number}")
        count = int(lines[motion_at].split(":")[1])
        frame_time = float(lines[motion_at + 1].split(":")[1])
        width = sum(len(each) for each in channels)
        rows = []
        for number in range(motion_at + 3, motion_at + 3 + count):
            row = [float(word) for word in lines[number - 1].split()]
            if len(row) != width:
                raise InputError(f"{path}, line {number}: expected {width} channel values, found {len(row)}")
            rows.append(row)
    except (ValueError, IndexError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}, line {number}: not a BVH file, or cut short ({error})") from None
    values = np.array(rows)
    local, column, positions = [], 0, np.zeros((count, 3))
    for joint, each in enumerate(channels):
        block = dict(zip(each, values[:, column : column + len(each)].T, strict=True))
        column += len(each)
        order = "".join(name[0] for name in each if name.endswith("rotation"))
        angles = np.stack([block[f"{axis}rotation"] for axis in order], axis=1) if order else np.zeros((count, 3))
        local.append(Rotation.from_euler(order or "XYZ", angles, degrees=True).as_quat())
        if joint == 0 and "Xposition" in block:
            positions = np.stack([block[f"{axis}position"] for axis in "XYZ"], axis=1)
    quaternions = np.stack(local, axis=1).reshape(-1, 4)
    return Bvh(
        path, tuple(names), np.array(parents), np.array(offsets), Rotation.from_quat(quaternions), positions, frame_time
    )


@dataclass(frozen=True, slots=True)
class _Scheme:
    """Which joint of a file drives which of ours."""

    drives: dict[str, str]
    """Our joint -> the file's joint; joints of ours that are not named follow their parent."""
    limbs: dict[str, str]
    """Our limb joint -> the file's joint whose offset tells the limb's rest direction."""


def _cmu(hip: str, knee: str, ankle: str, spine: tuple[str, ...], neck: tuple[str, ...], collar: str, shoulder: str,
         elbow: str, wrist: str) -> _Scheme:  # fmt: skip
    drives = {"root": "Hips", "spine05": spine[0], "spine03": spine[1], "spine01": spine[2]}
    drives |= {"neck01": neck[0], "neck02": neck[1], "head": "Head"}
    limbs = {}
    for side, word in (("L", "Left"), ("R", "Right")):
        drives |= {
            f"upperleg01.{side}": word + hip,
            f"lowerleg01.{side}": word + knee,
            f"foot.{side}": word + ankle,
            f"clavicle.{side}": word + collar,
            f"upperarm01.{side}": word + shoulder,
            f"lowerarm01.{side}": word + elbow,
            f"wrist.{side}": word + wrist,
        }
        limbs |= {
            f"upperleg01.{side}": word + knee,
            f"lowerleg01.{side}": word + ankle,
            f"upperarm01.{side}": word + elbow,
            f"lowerarm01.{side}": word + wrist,
        }
    return _Scheme(drives, limbs)


SCHEMES = (
    _cmu("UpLeg", "Leg", "Foot", ("LowerBack", "Spine", "Spine1"), ("Neck", "Neck1"), "Shoulder", "Arm", "ForeArm",
         "Hand"),
    _cmu("Hip", "Knee", "Ankle", ("lowerback", "Chest", "Chest2"), ("lowerneck", "Neck"), "Collar", "Shoulder",
         "Elbow", "Wrist"),
)  # fmt: skip
"""The two joint-naming schemes of the CMU Graphics Lab database."""

LIMB_ENDS = {"upperleg01": "lowerleg01", "lowerleg01": "foot", "upperarm01": "lowerarm01", "lowerarm01": "wrist"}


def retarget(shaped: ShapedBody, bvh: Bvh, fps: float, *, first_frame: int = 0) -> PoseSequence:
    """Move a person like a BVH clip.

    Resampled to `fps` by spherical interpolation, turned to face +Z and start above the origin, scaled by leg length,
    feet on the floor.

    Args:
        first_frame: where to start, in frames of the result.
    Raises:
        InputError: the file's joint names follow none of the known schemes.
    """
    from data_synth.motions import pose_sequence

    scheme = _match(bvh)
    world = bvh.world_rotations()
    duration = (len(world) - 1) * bvh.frame_time_s
    at = np.arange(first_frame / fps, duration + 0.1 / fps, 1 / fps)  # files round their frame time
    if not len(at):
        raise InputError(f"{bvh.path}: expected a clip longer than {first_frame} frames, found {duration * fps:.0f}")
    times = np.arange(len(world)) * bvh.frame_time_s
    index = {name: slot for slot, name in enumerate(bvh.joint_names)}
    names, joints, parents = shaped.body.joint_names, shaped.joints, shaped.body.parents

    facing = world[:, index[scheme.drives["root"]]][:, :, 2]
    start = round(first_frame / fps / bvh.frame_time_s)
    yaw = np.arctan2(facing[start, 0], facing[start, 2])
    turn = Rotation.from_euler("y", -yaw).as_matrix()

    world_target = np.empty((len(at), len(names), 3, 3))
    for joint, name in enumerate(names):
        if name not in scheme.drives:
            world_target[:, joint] = world_target[:, parents[joint]]
            continue
        source = index[scheme.drives[name]]
        path = Slerp(times, Rotation.from_matrix(world[:, source]))(np.clip(at, 0, times[-1])).as_matrix()
        world_target[:, joint] = turn @ path
        if name in scheme.limbs:
            stem, side = name.split(".")
            ours = joints[names.index(f"{LIMB_ENDS[stem]}.{side}")] - joints[joint]
            theirs = bvh.offsets[index[scheme.limbs[name]]]
            world_target[:, joint] = world_target[:, joint] @ _align(ours, theirs)
    local = world_target.copy()
    for joint in range(1, len(names)):
        local[:, joint] = np.swapaxes(world_target[:, parents[joint]], 1, 2) @ world_target[:, joint]

    knee, ankle = scheme.limbs["upperleg01.L"], scheme.limbs["lowerleg01.L"]
    their_leg = sum(np.linalg.norm(bvh.offsets[index[name]]) for name in (knee, ankle))
    our_leg = np.linalg.norm(joints[names.index("foot.L")] - joints[names.index("lowerleg01.L")]) + np.linalg.norm(
        joints[names.index("lowerleg01.L")] - joints[names.index("upperleg01.L")]
    )
    path = np.stack([np.interp(at, times, bvh.root_positions[:, axis]) for axis in range(3)], axis=1)
    translations = (path - path[0]) @ turn.T * (our_leg / their_leg)
    return pose_sequence(shaped, local, fps, translations)


def _match(bvh: Bvh) -> _Scheme:
    have = set(bvh.joint_names)
    missing = [sorted(set(scheme.drives.values()) - have) for scheme in SCHEMES]
    best = int(np.argmin([len(each) for each in missing]))
    if missing[best]:
        lacking = ", ".join(missing[best][:4])
        raise InputError(f"{bvh.path}: expected joints named as in the CMU database, found none called {lacking}")
    return SCHEMES[best]


def _align(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The smallest rotation, (3, 3), that turns one direction onto another."""
    unit = np.stack([target / np.linalg.norm(target), source / np.linalg.norm(source)])
    return Rotation.align_vectors(unit[:1], unit[1:])[0].as_matrix()
