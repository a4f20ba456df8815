"""Parameters of SMPL bodies in npz files: AMASS's arrays, and those that estimators and data sets write instead.

What they hold is the same (rotations of SMPL's joints, where the body is, its shape, a rate), under other names and in
other forms: in one array or the root apart, rotation vectors or matrices, with or without an axis of one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile

__all__ = ["RATES", "SmplParameters", "are_smpl_parameters", "read_smpl_parameters"]

JOINTS = 22
"""SMPL's joints that its whole family shares."""
WHOLE = ("poses", "pose_world", "pose", "fullpose", "full_pose", "smpl_poses", "smpl_thetas", "pred_rotmat")
ROOT = ("root_orient", "global_orient", "poses_root", "root_pose", "pose_root", "orient", "global_rot")
BODY = ("pose_body", "body_pose", "poses_body", "body_poses")
PLACE = (
    "trans_world",
    "trans",
    "transl",
    "translation",
    "translations",
    "root_trans",
    "transl_world",
    "global_trans",
    "smpl_trans",
    "pred_trans",
    "cam_trans",
)
SHAPE = ("betas", "shape", "shapes", "beta", "smpl_betas", "pred_shape")
SCALE = "smpl_scaling"
"""Of AIST++, whose translations are that many times too long."""
RATES = ("mocap_framerate", "mocap_frame_rate", "fps", "framerate", "frame_rate", "mocap_fps", "framerate_hz")
ABOUT_ORIGIN, ABOUT_ORIGIN_PLACE = "rh", "th"
"""EasyMocap's: it turns the posed body about the origin of the world, not about its pelvis."""
_RATE_RANGE = (0.1, 10_000.0)
_MATRIX_TOLERANCE = 0.02
_TURNS_MOST, _JOINT_MOST = 50.0, 4 * math.pi
"""Radians: longer rotation vectors are degrees. The first joint may be a root that has been counted round and round."""


@dataclass(frozen=True, slots=True, eq=False)
class SmplParameters:
    """A motion of SMPL's 22 shared joints, in the file's world."""

    rotations: Float64[np.ndarray, "frames 22 3 3"]
    places: Float64[np.ndarray, "frames 3"]
    """As SMPL means its translation: of the rest pose's origin, before the root turns."""
    about_origin: Float64[np.ndarray, "frames 3 3"] | None
    """EasyMocap's turn of the whole posed body about the world's origin, before `places` are added."""
    betas: Float64[np.ndarray, " shapes"] | None
    fps: float | None
    notes: tuple[str, ...]


def are_smpl_parameters(arrays: ArrayFile) -> bool:
    names = _Names(arrays)
    return any(names.first(group) for group in (WHOLE, ROOT, BODY))


def read_smpl_parameters(arrays: ArrayFile) -> SmplParameters:
    """Read a motion from an open npz file.

    Raises:
        InputError: an array is missing, of another form, or holds what is no rotation; names it.
    """
    names, notes = _Names(arrays), []
    rotations = _all_rotations(arrays, names)
    count = len(rotations)
    about_origin = None
    turn, place = names.exact(ABOUT_ORIGIN), names.exact(ABOUT_ORIGIN_PLACE)
    if turn is not None:
        about_origin = _rotations(arrays, turn, (1,), count)[:, 0]
    place = place or names.first(PLACE)
    if place is None:
        notes.append("no translations are there: the body stays in its place")
    places = np.zeros((count, 3)) if place is None else _places(arrays, place, count)
    if (scaling := names.exact(SCALE)) is not None:
        scale = arrays.number(scaling)
        if not 0 < scale < math.inf:
            raise InputError(f"'{scaling}': expected a positive number, found {scale:g}")
        places = places / scale
    shape = names.first(SHAPE)
    betas = None if shape is None else _betas(arrays, shape, notes)
    return SmplParameters(rotations, places, about_origin, betas, _rate(arrays, names), tuple(notes))


class _Names:
    """Arrays by the last part of their names, lower case: `smpl_params_global/body_pose` is a `body_pose`."""

    def __init__(self, arrays: ArrayFile) -> None:
        self._found: dict[str, str] = {}
        for name in sorted(arrays.names_of_arrays(), key=_preference):
            last = name.replace(".", "/").replace(":", "/").split("/")[-1]
            self._found.setdefault(last.strip().lower(), name)

    def exact(self, name: str) -> str | None:
        return self._found.get(name)

    def first(self, names: Iterable[str]) -> str | None:
        return next((self._found[name] for name in names if name in self._found), None)

    def all(self, names: Iterable[str]) -> list[str]:
        return [self._found[name] for name in names if name in self._found]


def _preference(name: str) -> tuple[bool, bool]:
    """Of several arrays of one name, those in the world come before those in a camera."""
    lower = name.lower()
    return "incam" in lower or "cam" in lower.split("/")[0], not ("global" in lower or "world" in lower)


# --- rotations ---------------------------------------------------------------------------------------------------


def _all_rotations(arrays: ArrayFile, names: _Names) -> np.ndarray:
    """(T, 22, 3, 3), the root first."""
    whole, root, body = names.first(WHOLE), names.first(ROOT), names.first(BODY)
    turned = names.exact(ABOUT_ORIGIN)
    if root is not None and body is not None:
        below = _rotations(arrays, body, (21, 23))
        first = _rotations(arrays, root, (1,), len(below))
        return np.concatenate([first, below[:, : JOINTS - 1]], axis=1)
    if whole is None:
        lacking = ROOT if root is None else BODY
        raise InputError(f"expected an array '{lacking[0]}' or '{lacking[1]}' beside '{body or root}', found none")
    if root is not None or turned is not None:
        # A root of its own goes with poses that lack one (69 values), or repeat it.
        found = _rotations(arrays, whole, (*range(JOINTS, 128), 21, 23))
        if found.shape[1] in (21, 23):
            first = np.tile(np.eye(3), (len(found), 1, 1, 1)) if root is None else _rotations(arrays, root, (1,))
            if len(first) != len(found):
                raise InputError(f"expected '{root}' for {len(found)} frames, found {len(first)}")
            return np.concatenate([first, found[:, : JOINTS - 1]], axis=1)
        return found[:, :JOINTS]
    return _rotations(arrays, whole, range(JOINTS, 128))[:, :JOINTS]


def _rotations(arrays: ArrayFile, name: str, joints: Iterable[int], frames: int | None = None) -> np.ndarray:
    """An array as rotation matrices, (T, J, 3, 3).

    Args:
        joints: how many there may be.
        frames: how many there have to be; None is any number.
    """
    array, allowed = arrays.real(name), {*joints}
    if not array.size:
        raise InputError(f"'{name}': expected at least one frame, found an array of shape {array.shape}")
    for form in _forms(array):
        if form.shape[1] in allowed and (frames is None or len(form) == frames):
            return _checked(form, name) if form.ndim == 4 else _from_vectors(form, name)
    per_joint = {6: "6 numbers a joint", 4: "quaternions"}.get(array.shape[-1] if array.ndim > 2 else 0)
    found = f"an array of shape {array.shape}" + (f", perhaps {per_joint}" if per_joint else "")
    counted = f"{min(allowed)} or more" if len(allowed) > 4 else " or ".join(str(each) for each in sorted(allowed))
    many = "T" if frames is None else frames
    raise InputError(
        f"'{name}': expected rotation vectors or matrices of {counted} joints in {many} frames, found {found}"
    )


def _forms(array: np.ndarray) -> Iterator[np.ndarray]:
    """What an array can be, (T, J, 3) vectors or (T, J, 3, 3) matrices, the likelier first."""
    views = [array]
    while views[-1].ndim > 2 and views[-1].shape[0] == 1:
        views.append(views[-1][0])
    for view in views:
        shape = view.shape
        if len(shape) == 4 and shape[2:] == (3, 3):
            yield view
        if len(shape) == 3 and shape[1:] == (3, 3):
            yield view[:, None]
        if len(shape) == 3 and shape[2] == 3:
            yield view
        if len(shape) < 3 and view.size:
            yield from _flat_forms(np.atleast_2d(view))
    last = views[-1].shape
    if (len(last) == 2 and last[1] == 3) or (len(last) == 3 and last[1:] == (3, 3)):  # one frame
        yield views[-1][None]


def _flat_forms(rows: np.ndarray) -> Iterator[np.ndarray]:
    wide = rows.shape[1]
    if wide % 9 == 0 and wide // 9 in (1, 21, 22, 23, 24, 52, 55):
        yield rows.reshape(len(rows), -1, 3, 3)
    if wide % 3 == 0 and wide not in (132, 144, 312, 330):  # which are 6 numbers a joint
        yield rows.reshape(len(rows), -1, 3)


def _from_vectors(vectors: np.ndarray, name: str) -> np.ndarray:
    _require_finite(vectors, name)
    length = np.linalg.norm(vectors, axis=-1)
    if length.max() > _TURNS_MOST or length[:, 1:].max(initial=0) > _JOINT_MOST:
        frame, joint = np.unravel_index(np.argmax(length), length.shape)
        raise InputError(f"'{name}': expected rotation vectors in radians, found one of length {length.max():.4g} "
                         f"in frame {frame} of {len(vectors)}, joint {joint}")  # fmt: skip
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape[:2], 3, 3)


def _checked(matrices: np.ndarray, name: str) -> np.ndarray:
    """Rotations that are, made exact."""
    _require_finite(matrices, name)
    off = np.abs(matrices @ np.swapaxes(matrices, 2, 3) - np.eye(3)).max(axis=(2, 3))
    wrong = (off > _MATRIX_TOLERANCE) | (np.linalg.det(matrices) < 0)
    if wrong.any():
        frame, joint = (int(axis[0]) for axis in np.nonzero(wrong))
        raise InputError(f"'{name}': expected rotation matrices, found one that is none "
                         f"in frame {frame} of {len(matrices)}, joint {joint}")  # fmt: skip
    return Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_matrix().reshape(matrices.shape)


def _require_finite(array: np.ndarray, name: str) -> None:
    wrong = np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(axis=1))
    if len(wrong):
        raise InputError(
            f"'{name}': expected finite numbers, found NaN or infinity in frame {wrong[0]} of {len(array)}"
        )


# --- the rest ----------------------------------------------------------------------------------------------------


def _places(arrays: ArrayFile, name: str, frames: int) -> np.ndarray:
    array = arrays.real(name)
    if array.shape[-1:] != (3,) or array.size != 3 * frames:
        raise InputError(f"'{name}': expected translations ({frames}, 3), found an array of shape {array.shape}")
    places = array.reshape(frames, 3)
    _require_finite(places, name)
    return places


def _betas(arrays: ArrayFile, name: str, notes: list[str]) -> np.ndarray | None:
    """One shape; of a shape in every frame, their mean."""
    array = arrays.real(name)
    if not array.size:
        return None
    rows = np.atleast_2d(array)
    rows = rows.reshape(-1, rows.shape[-1])
    if not np.isfinite(rows).all():
        raise InputError(f"'{name}': expected finite numbers, found NaN or infinity")
    if np.ptp(rows, axis=0).max() > 1e-6:
        notes.append(f"a shape in every frame, up to {np.ptp(rows, axis=0).max():.2g} apart: their mean is taken")
    return rows.mean(axis=0)


def _rate(arrays: ArrayFile, names: _Names) -> float | None:
    """Frames a second; None if the file does not say."""
    found = names.all(RATES)
    if not found:
        return None
    value = arrays[found[0]]
    try:
        rate = float(str(value.reshape(-1)[0]).removeprefix("b'").removesuffix("'"))
        alike = value.size == 1
    except (ValueError, IndexError):
        rate, alike = math.nan, False
    least, most = _RATE_RANGE
    if not alike or not least <= rate <= most:
        said = f"{rate:g}" if alike else f"{value.dtype} of shape {value.shape}"
        raise InputError(f"'{found[0]}': expected a frame rate from {least:g} to {most:g}, found {said}")
    return rate
