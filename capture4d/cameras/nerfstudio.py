"""The transforms.json of nerfstudio and instant-ngp: a camera for every frame.

Its poses are camera-to-world in OpenGL's axes (x right, y up, z backward); pixel centres lie at +0.5, as in COLMAP,
from which most of these files are made. What nerfstudio did to the world (`applied_transform`, `applied_scale`) is
undone, so that the rig stands where the program stood it that solved for it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from capture4d.cameras.names import camera_names
from capture4d.cameras.projection import Lens
from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.files.reading import reading
from capture4d.types import Rig

__all__ = ["read_transforms"]

HALF_PIXEL = 0.5
_BROWN = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
_ROW = 1e-4
"""What the last row of a matrix may err."""
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def read_transforms(path: Path) -> Rig:
    """Read the frames as cameras, which are called after their images.

    Raises:
        InputError: an entry is missing or cannot be meant, or a lens is none of ours; names the frame.
    """
    found = read_json(path, expected="a JSON object with frames")
    with reading(path, "transforms.json"):
        frames = found.get("frames")
        if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
            raise InputError("expected a list of frames, found none")
        T_world_theirs = _undo(found)
        images = [frame.get("file_path", f"frame_{index:05d}") for index, frame in enumerate(frames)]
        if not all(isinstance(image, str) and image for image in images):
            raise InputError("expected a text as the file_path of every frame, found something else")
        cameras = [_camera(image, found | frame, T_world_theirs) for image, frame in zip(images, frames, strict=True)]
        lenses = [lens for lens, _, _ in cameras]
        return Rig(
            names=camera_names(images),
            intrinsics=np.stack([lens.intrinsics for lens in lenses]),
            distortion=np.stack([lens.distortion for lens in lenses]),
            T_camera_world=np.stack([T_camera_world for _, T_camera_world, _ in cameras]),
            image_sizes=np.array([size for _, _, size in cameras], np.int32),
            lenses=tuple(lens.model for lens in lenses),
        )


def _camera(
    image: str, entries: Mapping[str, Any], T_world_theirs: Float64[np.ndarray, "4 4"]
) -> tuple[Lens, Float64[np.ndarray, "4 4"], tuple[int, int]]:
    """Lens, T_camera_world and image size of one frame, whose entries come before those of the file."""
    try:
        width, height = (_whole(entries, name) for name in ("w", "h"))
        T_theirs_camera = _matrix(entries, "transform_matrix")
        lens = _lens(entries, width, height)
    except InputError as error:
        raise InputError(f"frame {image!a}: {error.reason}") from None
    T_world_camera = T_world_theirs @ T_theirs_camera @ _OPENGL
    T_world_camera[:3, :3] /= np.cbrt(abs(np.linalg.det(T_world_theirs[:3, :3])))
    if not abs(np.linalg.det(T_world_camera[:3, :3])) > 1e-6:
        raise InputError(f"frame {image!a}: expected a rotation in its transform_matrix, found none")
    return lens, np.linalg.inv(T_world_camera), (width, height)


def _lens(entries: Mapping[str, Any], width: int, height: int) -> Lens:
    model = entries.get("camera_model", "FISHEYE" if entries.get("is_fisheye") else "OPENCV")
    if model not in (*_BROWN, *_FISHEYE):
        raise InputError(f"expected a camera_model of {', '.join((*_BROWN, *_FISHEYE))}, found {model!r}")
    listed = entries.get("distortion_params")
    if listed is not None:
        k1, k2, k3, k4, p1, p2 = (_number(dict(enumerate(listed)), place) for place in range(6))
    else:
        k1, k2, k3, k4, p1, p2 = (_number(entries, name) if name in entries else 0.0 for name in _COEFFICIENTS)
    fisheye = model in _FISHEYE
    unused = {"p1": p1, "p2": p2} if fisheye else {"k4": k4}
    for name, value in unused.items():
        if value != 0:
            raise InputError(f"expected no {name} of a lens of {model}, found {value:g}")
    fx = _focal(entries, "x", width)
    fy = _focal(entries, "y", height) if {"fl_y", "camera_angle_y", "y_fov"} & entries.keys() else fx
    cx = _number(entries, "cx") if "cx" in entries else width / 2
    cy = _number(entries, "cy") if "cy" in entries else height / 2
    K = np.array([[fx, 0, cx - HALF_PIXEL], [0, fy, cy - HALF_PIXEL], [0, 0, 1]])
    coefficients = [k1, k2, k3, k4, 0] if fisheye else [k1, k2, p1, p2, k3]
    return Lens(K, np.array(coefficients, np.float64), "fisheye" if fisheye else "brown")


def _focal(entries: Mapping[str, Any], axis: str, length: int) -> float:
    """From fl_x, or the angle of view of a pinhole camera."""
    if f"fl_{axis}" in entries:
        return _number(entries, f"fl_{axis}")
    if f"camera_angle_{axis}" in entries:
        angle = _number(entries, f"camera_angle_{axis}")
    elif f"{axis}_fov" in entries:
        angle = math.radians(_number(entries, f"{axis}_fov"))
    else:
        raise InputError(f"expected fl_{axis} or camera_angle_{axis}, found neither")
    if not 0 < angle < math.pi:
        raise InputError(f"expected an angle of view between 0 and 180 degrees, found {math.degrees(angle):g}")
    return length / (2 * math.tan(angle / 2))


def _undo(found: Mapping[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """The inverse of what nerfstudio did to the world."""
    applied = _matrix(found, "applied_transform") if "applied_transform" in found else np.eye(4)
    scale = _number(found, "applied_scale") if "applied_scale" in found else 1.0
    if not np.linalg.det(applied[:3, :3]) > 1e-9 or not scale > 0:
        raise InputError("expected an applied_transform and an applied_scale that mirror nothing, found others")
    applied[:3] *= scale
    return np.linalg.inv(applied)


def _matrix(entries: Mapping[str, Any], name: str) -> Float64[np.ndarray, "4 4"]:
    """Of three rows or four."""
    if name not in entries:
        raise InputError(f"expected the entry '{name}', found none")
    try:
        given = np.array(entries[name], np.float64)
    except (ValueError, TypeError):
        given = np.zeros(0)
    if given.shape not in ((3, 4), (4, 4)) or not np.isfinite(given).all():
        raise InputError(f"expected 3 x 4 or 4 x 4 finite numbers as {name}, found something else")
    matrix = np.eye(4)
    matrix[:3] = given[:3]
    if len(given) == 4 and np.abs(given[3] - (0, 0, 0, 1)).max() > _ROW:  # inverted matrices are off by little
        raise InputError(f"expected a last row of 0 0 0 1 in {name}, found {given[3].tolist()}")
    return matrix


def _number(entries: Mapping[Any, Any], name: Any) -> float:
    value = entries.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"expected a finite number as {name}, found {value!r}")
    return float(value)


def _whole(entries: Mapping[str, Any], name: str) -> int:
    if name not in entries:
        raise InputError(f"expected the size of the images as w and h, found no {name}")
    value = _number(entries, name)
    if value != int(value) or not 0 < value < 2**31:
        raise InputError(f"expected whole pixels as {name}, found {value:g}")
    return int(value)
