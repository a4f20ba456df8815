"""Motion from elsewhere and back: this project's npz, AMASS npz, and BVH, each told by what is in the file.

own npz    poses.npz as in a capture; as it is
AMASS npz  `poses` (T, 3 J) axis-angle of SMPL's joints, `trans`, `betas`, frame rate under either name, Z up
BVH        a file with this body's joints is read as it is, with the shape that its bone lengths show; other skeletons
           are retargeted (see `retargeting`). Written in centimetres

Poses of SMPL's joints fit a body of the SMPL family without change (hands beyond the wrist are left out), and other
bodies by retargeting. What these joints cannot say (a second neck joint, twist bones, hands, another shape space) goes
along in arrays of our own, `capture4d_*`: what is left between the poses that were written and those that AMASS's
arrays alone give. Other readers pass over them; ours puts the difference back.
"""

from __future__ import annotations

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
from capture4d.motions.bvh import Bvh, format_bvh, read_bvh
from capture4d.motions.retargeting import SMPL_TREE, as_smpl, retarget
from capture4d.types import Body, PoseSequence

__all__ = ["read_motion", "resample", "write_amass", "write_bvh", "write_motion"]

BVH_METRE = 100.0
"""Units of a written BVH in a metre."""
AMASS_JOINTS = 52
"""SMPL-H: 22 of the body, 15 for each hand."""
MOST_FRAMES = 1_000_000
"""Of a resampled motion: two hours at 120 a second; a rate in a file may ask for more than memory holds."""
FRAME_RATES = ("mocap_framerate", "mocap_frame_rate")
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns AMASS's world, Z up, into ours."""


def read_motion(path: Path, body: Body, *, fps: float | None = None) -> PoseSequence:
    """Poses of a body from a motion file, where they are in its world.

    Args:
        fps: resample to this rate; None keeps the file's.
    Raises:
        InputError: an unknown kind of file, a damaged one, or joints that have no counterpart in the body.
    """
    if not path.is_file():
        raise InputError("no such motion file", where=path)
    # Whether numbers are a motion shows when they are put on the body.
    with reading(path, "motion file"):
        match path.suffix.lower():
            case ".bvh":
                poses = _from_bvh(read_bvh(path), body)
            case ".npz":
                poses = _from_npz(path, body)
            case other:
                raise InputError(f"expected a motion file .npz or .bvh, found '{other}'")
    return poses if fps is None else resample(poses, fps)


def write_motion(path: Path, body: Body, poses: PoseSequence, *, amass: bool = False) -> None:
    """Write poses as .bvh, or as .npz of this project or AMASS's."""
    match path.suffix.lower():
        case ".bvh":
            write_bvh(path, body, poses)
        case ".npz":
            write_amass(path, body, poses) if amass else save_poses(path, poses)
        case other:
            raise InputError(f"expected a motion file .npz or .bvh, found '{other}'", where=path)


def resample(poses: PoseSequence, fps: float) -> PoseSequence:
    """Poses at another frame rate, by spherical interpolation; frames are counted from 0."""
    times = (poses.frame_ids - poses.frame_ids[0]) / poses.fps
    if times[-1] * fps > MOST_FRAMES:
        raise InputError(f"expected at most {MOST_FRAMES} poses at {fps:g} fps, found {times[-1] * fps:.3g}")
    at = np.arange(0, times[-1] + 0.1 / fps, 1 / fps).clip(max=times[-1])
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


def _from_npz(path: Path, body: Body) -> PoseSequence:
    with ArrayFile(path) as arrays:
        if "poses" not in arrays:
            poses = load_poses(path)
            if poses.joint_names != body.joint_names:
                expected, found = len(body.joint_names), len(poses.joint_names)
                raise InputError(f"expected the body's {expected} joints, found {found} others")
            return poses
        vectors, trans = arrays.real("poses"), arrays.real("trans")
        rates = [arrays.number(name) for name in FRAME_RATES if name in arrays]
        betas = arrays.real("betas") if "betas" in arrays else None
        rest = _Rest.read(arrays)
    if vectors.ndim != 2 or vectors.shape[1] % 3 or vectors.shape[1] < 66 or trans.shape != (len(vectors), 3):
        found = f"{vectors.shape}, {trans.shape}"
        raise InputError(f"expected poses (T, 66 or more) and trans (T, 3), found {found}")
    if not rates:
        raise InputError(f"expected a frame rate as {' or '.join(FRAME_RATES)}, found none")
    if not 0 < rates[0] < np.inf:
        raise InputError(f"expected a positive frame rate, found {rates[0]:g}")
    wrong = np.flatnonzero(~(np.isfinite(vectors).all(axis=1) & np.isfinite(trans).all(axis=1)))
    if len(wrong):
        raise InputError(f"expected finite poses and trans, found NaN or infinity in frame {wrong[0]} of {len(trans)}")
    vectors = vectors[:, :66].reshape(-1, 22, 3)
    if rest is None or rest.joint_names != body.joint_names or len(rest.turns) != len(vectors):
        return _from_smpl(path, body, vectors, trans, betas, rates[0])
    return rest.put_back(_from_smpl(path, body, vectors, trans, rest.shape, rates[0]))


def _from_smpl(
    path: Path,
    body: Body,
    vectors: Float[np.ndarray, "frames 22 3"],
    trans: Float[np.ndarray, "frames 3"],
    betas: Float[np.ndarray, "..."] | None,
    fps: float,
) -> PoseSequence:
    """AMASS's arrays on a body; `betas` are its own shape."""
    count = len(vectors)
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(count, 22, 3, 3)
    rotations[:, 0] = Z_UP @ rotations[:, 0]
    if _is_smpl(body):
        root = body.joints[0].astype(np.float64)
        return _for_smpl(body, rotations, trans @ Z_UP.T + _turned_about_origin(root), betas, fps)
    source = Bvh(
        path,
        tuple(SMPL_TREE),
        np.array([parent for parent, _ in SMPL_TREE.values()]),
        np.array([offset for _, offset in SMPL_TREE.values()]),
        Rotation.from_matrix(rotations.reshape(-1, 3, 3)),
        (trans + SMPL_TREE["pelvis"][1]) @ Z_UP.T,
        1 / fps,
    )
    return retarget(with_shape(body, np.zeros(0, np.float32)), source, fps, place="world")


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


def _is_smpl(body: Body) -> bool:
    return body.joint_names[:22] == tuple(SMPL_TREE)


def _turned_about_origin(root: np.ndarray) -> np.ndarray:
    """SMPL's root lies off its origin, and turning the world moves it: what that adds to the translation."""
    return Z_UP @ root - root


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


def write_amass(path: Path, body: Body, poses: PoseSequence) -> None:
    """Write AMASS's arrays for SMPL-H, Z up, hands at rest, and beside them what these leave out of the poses.

    `betas` hold the shape if the body is of the SMPL family.
    """
    betas = np.zeros(16)
    if _is_smpl(body):
        rotations = poses.rotations[:, :22].astype(np.float64)
        trans = (poses.translations - _turned_about_origin(body.joints[0].astype(np.float64))) @ Z_UP
        betas[: len(poses.shape)] = poses.shape[:16]
    else:
        motion = as_smpl(with_shape(body, poses.shape), poses)
        rotations = motion.rotations.as_matrix().reshape(-1, 22, 3, 3)
        trans = motion.root_positions @ Z_UP - SMPL_TREE["pelvis"][1]
    rotations[:, 0] = Z_UP.T @ rotations[:, 0]
    vectors = np.zeros((len(rotations), AMASS_JOINTS, 3))
    vectors[:, :22] = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec().reshape(-1, 22, 3)
    plain = _from_smpl(path, body, vectors[:, :22], trans, poses.shape, poses.fps)
    write_npz(
        path,
        poses=vectors.reshape(len(vectors), -1),
        trans=trans,
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
        BVH_METRE * (poses.translations + shaped.joints[0]),
        1 / poses.fps,
    )
    write_bytes(path, format_bvh(motion, _ends(shaped)).encode())


def _ends(shaped: ShapedBody) -> np.ndarray:
    """A tenth of a metre further along each bone, for the end sites."""
    parents = np.maximum(shaped.body.parents, 0)
    along = shaped.joints - shaped.joints[parents]
    length = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    return 0.1 * BVH_METRE * along / length


def _from_bvh(bvh: Bvh, body: Body) -> PoseSequence:
    if set(body.joint_names) != set(bvh.joint_names):
        return retarget(with_shape(body, np.zeros(0, np.float32)), bvh, round(1 / bvh.frame_time_s, 3), place="world")
    order = [bvh.joint_names.index(name) for name in body.joint_names]
    shape = _shape_of_bones(body, bvh.offsets[order] / BVH_METRE)
    rotations = bvh.rotations.as_matrix().reshape(-1, len(order), 3, 3)[:, order]
    translations = bvh.root_positions / BVH_METRE - with_shape(body, shape).joints[0]
    return PoseSequence(
        rotations.astype(np.float32),
        translations.astype(np.float32),
        shape,
        np.arange(len(rotations), dtype=np.int32),
        round(1 / bvh.frame_time_s, 3),
        body.joint_names,
    )


def _shape_of_bones(body: Body, offsets: np.ndarray) -> np.ndarray:
    """The shape whose bones are nearest to the given offsets, (S,) float32."""
    parents = np.maximum(body.parents[1:], 0)
    mean = (body.joints[1:] - body.joints[parents]).astype(np.float64)
    directions = (body.joint_directions[:, 1:] - body.joint_directions[:, parents]).astype(np.float64)
    columns = directions.reshape(len(directions), -1).T
    ridge = 1e-9 * np.eye(columns.shape[1])
    error = (offsets[1:] - mean).ravel()
    return np.linalg.solve(columns.T @ columns + ridge, columns.T @ error).astype(np.float32)
