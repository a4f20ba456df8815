"""Bodies, poses, garments and rigs as files: npz without pickle, and JSON for what people edit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile, mesh_arrays
from capture4d.files.atomic import read_json, write_json, write_npz
from capture4d.files.border_loops import on_open_edges
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
        )
        return on_open_edges(garment)


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
    found = read_json(path, expected="a JSON object with cameras")
    with reading(path, "rig"):
        if "cameras" not in found:
            raise InputError("expected the entry 'cameras', found none")
        cameras = found["cameras"]
        if not cameras:
            raise InputError("expected at least one camera, found none")
        try:
            return Rig(
                names=tuple(str(camera["name"]) for camera in cameras),
                intrinsics=np.array([camera["intrinsics"] for camera in cameras], np.float64),
                distortion=np.array([camera["distortion"] for camera in cameras], np.float64),
                T_camera_world=np.array([camera["T_camera_world"] for camera in cameras], np.float64),
                image_sizes=np.array([[camera["width"], camera["height"]] for camera in cameras], np.int32),
            )
        except KeyError as error:
            raise InputError(f"expected the entry {error} for every camera, found none") from None
