"""Bodies, poses, garments and rigs as files: npz without pickle, and JSON for what people edit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile, mesh_arrays
from capture4d.files.atomic import read_json, write_json, write_npz
from capture4d.files.border_loops import on_open_edges
from capture4d.files.json_values import number
from capture4d.files.reading import reading
from capture4d.types import Body, Garment, PoseSequence, Rig

__all__ = ["load_body", "load_garment", "load_poses", "load_rig", "save_body", "save_garment", "save_poses", "save_rig"]


def save_body(path: str | Path, body: Body) -> None:
    optional = {"pose_directions": body.pose_directions, "regions": body.regions}
    write_npz(
        path,
        **mesh_arrays("template_", body.template),
        shape_directions=body.shape_directions,
        joints=body.joints,
        joint_directions=body.joint_directions,
        joint_names=np.array(body.joint_names),
        parents=body.parents,
        skin_weights=body.skin_weights,
        **{name: array for name, array in optional.items() if array is not None},
    )


def load_body(path: str | Path) -> Body:
    with ArrayFile(path) as arrays:
        return Body(
            template=arrays.mesh("template_"),
            shape_directions=arrays["shape_directions"],
            joints=arrays["joints"],
            joint_directions=arrays["joint_directions"],
            joint_names=arrays.names("joint_names"),
            parents=arrays["parents"],
            skin_weights=arrays["skin_weights"],
            pose_directions=arrays.get("pose_directions"),
            regions=arrays.get("regions"),
        )


def save_poses(path: str | Path, poses: PoseSequence) -> None:
    write_npz(
        path,
        rotations=poses.rotations,
        translations=poses.translations,
        shape=poses.shape,
        frame_ids=poses.frame_ids,
        fps=np.float64(poses.fps),
        joint_names=np.array(poses.joint_names),
    )


def load_poses(path: str | Path) -> PoseSequence:
    with ArrayFile(path) as arrays:
        return PoseSequence(
            rotations=arrays["rotations"],
            translations=arrays["translations"],
            shape=arrays["shape"],
            frame_ids=arrays["frame_ids"],
            fps=arrays.number("fps"),
            joint_names=arrays.names("joint_names"),
        )


def save_garment(path: str | Path, garment: Garment) -> None:
    optional = {
        "embedding_faces": garment.embedding_faces,
        "embedding_barycentric": garment.embedding_barycentric,
        "skin_weights": garment.skin_weights,
        "body_shape": garment.body_shape,
        "pattern_metres": None if garment.pattern_metres is None else np.float64(garment.pattern_metres),
    }
    write_npz(
        path,
        **mesh_arrays("template_", garment.template),
        **{f"loop_{name}": loop for name, loop in garment.loops.items()},
        **{name: array for name, array in optional.items() if array is not None},
    )


def load_garment(path: str | Path, data: bytes | None = None) -> Garment:
    """Read a garment; `data` is what the file holds, if it was read already."""
    with ArrayFile(path, data) as arrays:
        garment = Garment(
            template=arrays.mesh("template_"),
            loops=arrays.prefixed("loop_"),
            embedding_faces=arrays.get("embedding_faces"),
            embedding_barycentric=arrays.get("embedding_barycentric"),
            skin_weights=arrays.get("skin_weights"),
            body_shape=arrays.get("body_shape"),
            pattern_metres=arrays.number("pattern_metres") if "pattern_metres" in arrays else None,
        )
        return on_open_edges(garment)


def save_rig(path: str | Path, rig: Rig) -> None:
    cameras = [
        {
            "name": name,
            "width": int(rig.image_sizes[index, 0]),
            "height": int(rig.image_sizes[index, 1]),
            **({} if lens == "brown" else {"lens": lens}),
            "intrinsics": rig.intrinsics[index],
            "distortion": rig.distortion[index, : _COEFFICIENTS[lens]],
            "T_camera_world": rig.T_camera_world[index],
        }
        for index, (name, lens) in enumerate(zip(rig.names, rig.lenses, strict=True))
    ]
    write_json(path, {"format": 1, "cameras": cameras})


def load_rig(path: str | Path) -> Rig:
    found = read_json(path, expected="a JSON object with cameras")
    with reading(path, "rig"):
        if "cameras" not in found:
            raise InputError("expected the entry 'cameras', found none")
        cameras = found["cameras"]
        if not isinstance(cameras, list) or not all(isinstance(camera, dict) for camera in cameras):
            raise InputError("expected a list of objects as 'cameras', found something else")
        if not cameras:
            raise InputError("expected at least one camera, found none")
        try:
            names = tuple(_camera_name(camera["name"]) for camera in cameras)
            return Rig(
                names=names,
                intrinsics=_camera_arrays(names, cameras, "intrinsics", (3, 3)),
                distortion=np.stack([_distortion(*named) for named in zip(names, cameras, strict=True)]),
                T_camera_world=_camera_arrays(names, cameras, "T_camera_world", (4, 4)),
                image_sizes=np.array([_image_size(*named) for named in zip(names, cameras, strict=True)], np.int32),
                lenses=tuple(camera.get("lens", "brown") for camera in cameras),
            )
        except KeyError as error:
            raise InputError(f"expected the entry {error} for every camera, found none") from None


_COEFFICIENTS = {"brown": 5, "fisheye": 4}


def _camera_name(name: Any) -> str:
    if not isinstance(name, str | int) or isinstance(name, bool):
        raise InputError(f"expected a text as the name of a camera, found {name!r}")
    return str(name)


def _camera_arrays(names: Sequence[str], cameras: Sequence[dict[str, Any]], entry: str, shape: tuple) -> np.ndarray:
    return np.stack([_camera_array(*named, entry, shape) for named in zip(names, cameras, strict=True)])


def _camera_array(name: str, camera: dict[str, Any], entry: str, shape: tuple[int, ...]) -> np.ndarray:
    try:
        values = np.array(_leaves(camera[entry], entry), np.float64)
    except (ValueError, OverflowError):
        raise InputError(f"camera {name!r}: expected numbers as {entry}, found something else") from None
    if values.shape != shape:
        expected, seen = (" x ".join(map(str, size)) or "one" for size in (shape, values.shape))
        raise InputError(f"camera {name!r}: expected {expected} numbers as {entry}, found {seen}")
    return values


def _leaves(value: Any, entry: str) -> Any:
    """Nested lists of numbers; true and "1" are none."""
    return [_leaves(each, entry) for each in value] if isinstance(value, list) else number(value, entry)


def _distortion(name: str, camera: dict[str, Any]) -> np.ndarray:
    lens = camera.get("lens", "brown")
    count = _COEFFICIENTS.get(lens) if isinstance(lens, str) else None
    if count is None:
        raise InputError(f"camera {name!r}: expected a lens of {', '.join(_COEFFICIENTS)}, found {lens!r}")
    values = _camera_array(name, camera, "distortion", (count,))
    return np.concatenate([values, np.zeros(5 - count)])


def _image_size(name: str, camera: dict[str, Any]) -> tuple[int, int]:
    size = camera["width"], camera["height"]
    for length in size:
        if isinstance(length, bool) or not isinstance(length, int | float) or length != int(length):
            raise InputError(f"camera {name!r}: expected whole pixels as width and height, found {size[0]} x {size[1]}")
    if not all(0 < length < 2**31 for length in size):
        raise InputError(f"camera {name!r}: expected the size of an image, found {size[0]} x {size[1]}")
    return int(size[0]), int(size[1])
