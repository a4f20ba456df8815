"""Bodies, poses, garments and rigs as files: npz without pickle, and JSON for what people edit."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.atomic_files import read_json, write_json, write_npz
from capture4d.errors import InputError
from capture4d.types import Body, Garment, Mesh, PoseSequence, Rig

__all__ = [
    "ArrayFile",
    "load_body",
    "load_garment",
    "load_poses",
    "load_rig",
    "mesh_arrays",
    "save_body",
    "save_garment",
    "save_poses",
    "save_rig",
]


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
            fps=float(arrays["fps"]),
            joint_names=arrays.names("joint_names"),
        )


def save_garment(path: str | Path, garment: Garment) -> None:
    optional = {
        "embedding_faces": garment.embedding_faces,
        "embedding_barycentric": garment.embedding_barycentric,
        "skin_weights": garment.skin_weights,
        "body_shape": garment.body_shape,
    }
    write_npz(
        path,
        **mesh_arrays("template_", garment.template),
        **{f"loop_{name}": loop for name, loop in garment.loops.items()},
        **{name: array for name, array in optional.items() if array is not None},
    )


def load_garment(path: str | Path) -> Garment:
    with ArrayFile(path) as arrays:
        return Garment(
            template=arrays.mesh("template_"),
            loops=arrays.prefixed("loop_"),
            embedding_faces=arrays.get("embedding_faces"),
            embedding_barycentric=arrays.get("embedding_barycentric"),
            skin_weights=arrays.get("skin_weights"),
            body_shape=arrays.get("body_shape"),
        )


def save_rig(path: str | Path, rig: Rig) -> None:
    cameras = [
        {
            "name": name,
            "width": int(rig.image_sizes[index, 0]),
            "height": int(rig.image_sizes[index, 1]),
            "intrinsics": rig.intrinsics[index],
            "distortion": rig.distortion[index],
            "T_camera_world": rig.T_camera_world[index],
        }
        for index, name in enumerate(rig.names)
    ]
    write_json(path, {"format": 1, "cameras": cameras})


def load_rig(path: str | Path) -> Rig:
    found = read_json(path)
    if not isinstance(found, dict):
        raise InputError(f"{path}: expected a JSON object with cameras, found {type(found).__name__}")
    try:
        cameras = found["cameras"]
        if not cameras:
            raise InputError("expected at least one camera, found none")
        return Rig(
            names=tuple(str(camera["name"]) for camera in cameras),
            intrinsics=np.array([camera["intrinsics"] for camera in cameras], np.float64),
            distortion=np.array([camera["distortion"] for camera in cameras], np.float64),
            T_camera_world=np.array([camera["T_camera_world"] for camera in cameras], np.float64),
            image_sizes=np.array([[camera["width"], camera["height"]] for camera in cameras], np.int32),
        )
    except KeyError as error:
        where = "" if str(error) == "'cameras'" else " for every camera"
        raise InputError(f"{path}: expected the entry {error}{where}, found none") from None
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: {error}") from None


def mesh_arrays(prefix: str, mesh: Mesh) -> dict[str, np.ndarray]:
    arrays = {f"{prefix}vertices": mesh.vertices, f"{prefix}faces": mesh.faces}
    return arrays if mesh.uv is None else {**arrays, f"{prefix}uv": mesh.uv}


class ArrayFile:
    """An open npz file in which everything that is wrong becomes an InputError that names the file."""

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)

    def __enter__(self) -> ArrayFile:
        try:
            self._stream = self._path.open("rb")
        except FileNotFoundError:
            raise InputError(f"{self._path}: no such file") from None
        try:
            self._arrays = np.load(self._stream, allow_pickle=False)
            self._names = self._arrays.files
        except (ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
            self._stream.close()
            raise InputError(f"{self._path}: not a readable npz file, cut off or damaged ({error})") from None
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self._stream.close()
        if isinstance(error, InputError) and not str(error).startswith(str(self._path)):
            raise InputError(f"{self._path}: {error}") from None

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._names:
            raise InputError(f"{self._path}: expected an array '{name}', found {', '.join(self._names) or 'none'}")
        try:
            return self._arrays[name]
        except (ValueError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(f"{self._path}: damaged array '{name}' ({error})") from None

    def get(self, name: str) -> np.ndarray | None:
        return self[name] if name in self._names else None

    def names(self, name: str) -> tuple[str, ...]:
        return tuple(str(entry) for entry in self[name])

    def prefixed(self, prefix: str) -> dict[str, np.ndarray]:
        return {name.removeprefix(prefix): self[name] for name in self._names if name.startswith(prefix)}

    def mesh(self, prefix: str) -> Mesh:
        return Mesh(self[f"{prefix}vertices"], self[f"{prefix}faces"], self.get(f"{prefix}uv"))
