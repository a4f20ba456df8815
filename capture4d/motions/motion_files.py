"""Motion from elsewhere and back: this project's npz, SMPL's parameters in npz, and BVH, each told by what is in it.

own npz          poses.npz as in a capture; as it is
SMPL parameters  AMASS's arrays, or those of estimators and data sets (see `smpl_parameters`). Written: AMASS's, Z up
BVH              a file with this body's joints is read as it is, in whatever unit, with the shape that its bone lengths
                 show; other skeletons are retargeted (see `clips`, `retargeting`). Written in centimetres

Poses of SMPL's joints fit a body of the SMPL family without change (hands beyond the wrist are left out), and other
bodies by retargeting. What these joints cannot say (a second neck joint, twist bones, hands, another shape space) goes
along in arrays of our own, `capture4d_*`: what is left between the poses that were written and those that AMASS's
arrays alone give. Other readers pass over them; ours puts the difference back.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation, Slerp

from capture4d.body.skinning import ShapedBody, with_shape
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import write_bytes, write_npz
from capture4d.files.reading import reading
from capture4d.files.records import load_poses, save_poses
from capture4d.motions.bvh import Bvh, format_bvh, moved_by_root, read_bvh
from capture4d.motions.clips import MotionWords, understood
from capture4d.motions.own_skeleton import poses_of_own_skeleton
from capture4d.motions.retargeting import frame_times, is_smpl, retarget
from capture4d.motions.smpl_motions import AMASS_AXES, on_body, smpl_up, to_smpl
from capture4d.motions.smpl_parameters import RATES, are_smpl_parameters, read_smpl_parameters
from capture4d.types import Body, PoseSequence

__all__ = [
    "motion_on",
    "rate_note",
    "read_motion",
    "resample",
    "same_rate",
    "told",
    "write_amass",
    "write_bvh",
    "write_motion",
]

BVH_METRE = 100.0
"""Units of a written BVH in a metre."""
RATE_TOLERANCE = 1e-3
"""Relative difference of two frame rates that are the same."""
AMASS_JOINTS = 52
"""SMPL-H: 22 of the body, 15 for each hand."""


def read_motion(
    path: Path,
    body: Body,
    *,
    fps: float | None = None,
    words: MotionWords | None = None,
    say: Callable[[str], None] | None = None,
) -> PoseSequence:
    """Poses of a body from a motion file, where they are in its world.

    Args:
        fps: resample to this rate, frames counted from 0 on; None keeps the file's rate and numbers. Of a file that
            tells no rate, this is its own.
        words: what the user says of the file's joints and axes; what is not said is found.
        say: is given what was found, and whether the motion was resampled, a line at a time.
    Raises:
        InputError: an unknown kind of file, a damaged one, or joints that have no counterpart in the body.
    """
    if not path.is_file():
        raise InputError("no such motion file", where=path)
    words, say = words or MotionWords(), say or (lambda _: None)
    # Whether numbers are a motion shows when they are put on the body.
    with reading(path, "motion file"):
        match path.suffix.lower():
            case ".bvh":
                poses, notes = _from_bvh(read_bvh(path), body, words)
            case ".npz":
                poses, notes = _from_npz(path, body, words, fps)
            case other:
                raise InputError(f"expected a motion file .npz or .bvh, found '{other}'")
        resampled = poses if fps is None else resample(poses, fps)
    for note in notes:
        say(note)
    if not same_rate(resampled.fps, poses.fps):
        say(rate_note(poses.fps, len(poses.frame_ids), resampled.fps, len(resampled.frame_ids)))
    return resampled


def motion_on(path: Path, body: Body, shape: Float[np.ndarray, " shapes"], fps: float | None = None) -> PoseSequence:
    """The motion of a file on a person, at its own rate or at the wanted one; what was resampled is told.

    Args:
        shape: of the person.
        fps: frames a second; the file's own if absent.
    Raises:
        InputError: the file has no frames, or is of another skeleton.
    """
    say = told(path)
    found = read_motion(path, body, say=say)
    if found.joint_names != body.joint_names or not len(found.frame_ids):
        raise InputError(
            f"expected frames of the {len(body.joint_names)} joints of the model, found {len(found.frame_ids)} "
            f"of {len(found.joint_names)}",
            where=path,
        )
    found = replace(found, shape=np.asarray(shape, np.float32))
    if fps is None or same_rate(fps, found.fps):
        return found
    try:
        shown = resample(found, fps)
    except InputError as error:
        raise error.at(path) from None
    say(rate_note(found.fps, len(found.frame_ids), shown.fps, len(shown.frame_ids)))
    return shown


def told(path: Path) -> Callable[[str], None]:
    """What is found in a motion file, told on the screen beside the work."""
    return lambda note: print(f"capture4d: {path}: {note}", file=sys.stderr)


def write_motion(path: Path, body: Body, poses: PoseSequence, *, amass: bool = False) -> None:
    """Write poses as .bvh, or as .npz of this project or AMASS's."""
    match path.suffix.lower():
        case ".bvh":
            write_bvh(path, body, poses)
        case ".npz":
            write_amass(path, body, poses) if amass else save_poses(path, poses)
        case other:
            raise InputError(f"expected a motion file .npz or .bvh, found '{other}'", where=path)


def same_rate(one: float, other: float) -> bool:
    """Whether two frame rates are one: files round theirs."""
    return abs(one - other) <= RATE_TOLERANCE * other


def rate_note(fps: float, frames: int, new_fps: float, new_frames: int, *, whose: str = "") -> str:
    """What is told of a motion that was resampled.

    Args:
        whose: rate the new one is, such as "the model's".
    """
    to = " ".join(filter(None, (whose, f"{new_fps:g}")))
    return f"{fps:g} frames a second, resampled to {to}: {frames} frames became {new_frames}"


def resample(poses: PoseSequence, fps: float) -> PoseSequence:
    """Poses at another frame rate, by spherical interpolation; frames are counted from 0."""
    times = (poses.frame_ids - poses.frame_ids[0]) / poses.fps
    at = frame_times(times[-1], fps, len(times)).clip(max=times[-1])
    if len(times) == 1:
        return replace(poses, frame_ids=np.zeros(1, np.int32), fps=fps)
    joints = poses.rotations.shape[1]
    rotations = [Slerp(times, Rotation.from_matrix(poses.rotations[:, j]))(at).as_matrix() for j in range(joints)]
    translations = [np.interp(at, times, poses.translations[:, axis]) for axis in range(3)]
    return replace(
        poses,
        rotations=np.stack(rotations, axis=1).astype(np.float32),
        translations=np.stack(translations, axis=1).astype(np.float32),
        frame_ids=np.arange(len(at), dtype=np.int32),
        fps=fps,
    )


# --- npz ---------------------------------------------------------------------------------------------------------


def _from_npz(path: Path, body: Body, words: MotionWords, fps: float | None) -> tuple[PoseSequence, list[str]]:
    with ArrayFile(path) as arrays:
        if "rotations" in arrays or not are_smpl_parameters(arrays):
            return _own(path, body, words), []
        found = read_smpl_parameters(arrays)
        rest = _Rest.read(arrays)
    rate = found.fps or fps
    if rate is None:
        raise InputError(f"expected a frame rate as {' or '.join(RATES[:3])}, found none; convert-poses --fps tells it")
    ours = rest is not None and rest.joint_names == body.joint_names and len(rest.turns) == len(found.rotations)
    axes, notes = (AMASS_AXES, []) if rest is not None else smpl_up(found, words)
    notes = [*found.notes, *([] if found.fps else [f"no frame rate is there: {rate:g} fps, as told"]), *notes]
    poses = on_body(path, body, found, axes, rate, shape=rest.shape if ours and rest is not None else None)
    return (rest.put_back(poses) if ours and rest is not None else poses), notes


def _own(path: Path, body: Body, words: MotionWords) -> PoseSequence:
    poses = load_poses(path)
    if words.up not in (None, "y") or words.facing not in (None, "z"):
        raise InputError("expected neither --up nor --facing for poses of this project, whose Y is up")
    if poses.joint_names != body.joint_names:
        expected, found = len(body.joint_names), len(poses.joint_names)
        raise InputError(f"expected the body's {expected} joints, found {found} others")
    if not len(poses.frame_ids):
        raise InputError("expected at least one frame, found none")
    off = np.abs(poses.rotations @ np.swapaxes(poses.rotations, 2, 3) - np.eye(3)).max(axis=(2, 3))
    wrong = (off > 0.05) | (np.linalg.det(poses.rotations) < 0)
    if wrong.any():
        frame, joint = (int(axis[0]) for axis in np.nonzero(wrong))
        where = f"in frame {poses.frame_ids[frame]}, {poses.joint_names[joint]}"
        raise InputError(f"expected rotations, found a matrix that is none {where}")
    return poses


@dataclass(frozen=True, slots=True, eq=False)
class _Rest:
    """What AMASS's arrays leave out of the poses that were written."""

    joint_names: tuple[str, ...]
    turns: Float64[np.ndarray, "frames joints 3"]
    """Rotation vectors, after the rotations that AMASS's arrays give."""
    shifts: Float64[np.ndarray, "frames 3"]
    shape: Float64[np.ndarray, " shapes"]

    @staticmethod
    def between(plain: PoseSequence, poses: PoseSequence) -> _Rest:
        local = np.swapaxes(plain.rotations, 2, 3).astype(np.float64) @ poses.rotations
        turns = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(*local.shape[:2], 3)
        shifts = poses.translations.astype(np.float64) - plain.translations
        return _Rest(poses.joint_names, turns, shifts, poses.shape.astype(np.float64))

    def put_back(self, plain: PoseSequence) -> PoseSequence:
        turns = Rotation.from_rotvec(self.turns.reshape(-1, 3)).as_matrix().reshape(plain.rotations.shape)
        return replace(
            plain,
            rotations=(plain.rotations @ turns).astype(np.float32),
            translations=(plain.translations + self.shifts).astype(np.float32),
            shape=self.shape.astype(np.float32),
        )

    @staticmethod
    def read(arrays: ArrayFile) -> _Rest | None:
        if "capture4d_turns" not in arrays:
            return None
        turns, shifts, shape = (arrays.real(f"capture4d_{name}") for name in ("turns", "shifts", "shape"))
        return _Rest(arrays.names("capture4d_joint_names"), turns, shifts, shape)

    def arrays(self) -> dict[str, np.ndarray]:
        return {
            "capture4d_joint_names": np.array(self.joint_names, np.str_),
            "capture4d_turns": self.turns,
            "capture4d_shifts": self.shifts,
            "capture4d_shape": self.shape,
        }


def write_amass(path: Path, body: Body, poses: PoseSequence) -> None:
    """Write AMASS's arrays for SMPL-H, Z up, hands at rest, and beside them what these leave out of the poses.

    `betas` hold the shape if the body is of the SMPL family.
    """
    betas = np.zeros(16)
    if is_smpl(body.joint_names):
        betas[: len(poses.shape)] = poses.shape[:16]
    parameters = to_smpl(body, poses)
    vectors = np.zeros((len(parameters.rotations), AMASS_JOINTS, 3))
    turns = Rotation.from_matrix(parameters.rotations.reshape(-1, 3, 3))
    vectors[:, :22] = turns.as_rotvec().reshape(-1, 22, 3)
    plain = on_body(path, body, parameters, AMASS_AXES, poses.fps, shape=poses.shape)
    write_npz(
        path,
        poses=vectors.reshape(len(vectors), -1),
        trans=parameters.places,
        betas=betas,
        gender=np.array("neutral"),
        mocap_framerate=np.float64(poses.fps),
        **_Rest.between(plain, poses).arrays(),
    )


# --- BVH ---------------------------------------------------------------------------------------------------------


def write_bvh(path: Path, body: Body, poses: PoseSequence) -> None:
    """Write the body's own skeleton, in centimetres, with the bone lengths of the poses' shape."""
    shaped = with_shape(body, poses.shape)
    parents = body.parents
    offsets = np.where(parents[:, None] < 0, 0.0, shaped.joints - shaped.joints[np.maximum(parents, 0)])
    motion = Bvh(
        path,
        body.joint_names,
        parents,
        BVH_METRE * offsets,
        Rotation.from_matrix(poses.rotations.reshape(-1, 3, 3).astype(np.float64)),
        moved_by_root(BVH_METRE * offsets, BVH_METRE * (poses.translations + shaped.joints[0])),
        1 / poses.fps,
    )
    write_bytes(path, format_bvh(motion, _ends(shaped)).encode())


def _ends(shaped: ShapedBody) -> np.ndarray:
    """A tenth of a metre further along each bone, for the end sites."""
    parents = np.maximum(shaped.body.parents, 0)
    along = shaped.joints - shaped.joints[parents]
    length = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    return 0.1 * BVH_METRE * along / length


def _from_bvh(bvh: Bvh, body: Body, words: MotionWords) -> tuple[PoseSequence, list[str]]:
    fps = round(1 / bvh.frame_time_s, 3)
    own = poses_of_own_skeleton(bvh, body, words, fps)
    if own is not None:
        return own
    clip, notes = understood(bvh, words)
    return retarget(with_shape(body, np.zeros(0, np.float32)), clip, fps, place="world"), notes
