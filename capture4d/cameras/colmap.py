"""COLMAP models (cameras, images, rigs, frames; binary or text) as the exchange format of rigs.

COLMAP puts the centre of the first pixel at (0.5, 0.5), we and OpenCV at (0, 0). This module is the one place where
that half pixel is added or taken away for its sake. Lengths stay as they are, and the axes of a camera are the same:
x right, y down, z forward; a COLMAP pose (`cam_from_world`) is our T_camera_world. What is read is read by
`colmap_files`; pycolmap's own reader is never asked.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from capture4d.cameras.colmap_files import (
    ColmapCamera,
    ColmapImage,
    find_model,
    model_suffix,
    read_cameras,
    read_frames,
    read_images,
)
from capture4d.cameras.names import camera_names
from capture4d.cameras.projection import Lens, camera_lens
from capture4d.errors import InputError
from capture4d.files.reading import reading
from capture4d.heavy_imports import import_pycolmap
from capture4d.types import Rig

__all__ = ["colmap_camera", "lens_of", "read_model", "sensor", "to_colmap_pixels", "write_model"]

HALF_PIXEL = 0.5
# Where the parameters of a COLMAP camera model lie in fx fy cx cy and our five coefficients.
_BROWN = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3),
    "RADIAL": (0, 0, 1, 2, 3, 4),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7, 8),
}
_FISHEYE = {
    "SIMPLE_FISHEYE": (0, 0, 1, 2),
    "FISHEYE": (0, 1, 2, 3),
    "SIMPLE_RADIAL_FISHEYE": (0, 0, 1, 2, 3),
    "RADIAL_FISHEYE": (0, 0, 1, 2, 3, 4),
    "OPENCV_FISHEYE": (0, 1, 2, 3, 4, 5, 6, 7),
}


def to_colmap_pixels(pixels: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, "points 2"]:
    """Pixels with centres at integers, as COLMAP counts them."""
    return pixels + HALF_PIXEL


def colmap_camera(camera_id: int, lens: Lens, image_size: np.ndarray) -> Any:
    """A pycolmap.Camera: OPENCV, FULL_OPENCV where there is a k3, OPENCV_FISHEYE.

    Raises:
        InputError: the intrinsics are skewed, which no COLMAP model knows.
    """
    K, distortion = lens.intrinsics, lens.distortion
    if K[0, 1] != 0 or K[1, 0] != 0:
        raise InputError(f"intrinsics: expected no skew for a COLMAP model, found {K[0, 1]:g}")
    parameters = [K[0, 0], K[1, 1], *(K[:2, 2] + HALF_PIXEL), *distortion[:4]]
    full = bool(distortion[4] != 0)
    model = "OPENCV_FISHEYE" if lens.model == "fisheye" else "FULL_OPENCV" if full else "OPENCV"
    return import_pycolmap().Camera(
        camera_id=camera_id,
        model=model,
        width=int(image_size[0]),
        height=int(image_size[1]),
        params=[*parameters, distortion[4], 0, 0, 0] if full else parameters,
    )


def lens_of(camera: Any) -> Lens:
    """The lens of a pycolmap.Camera.

    Raises:
        InputError: its model is not a special case of ours.
    """
    size = camera.width, camera.height
    return _lens(camera.camera_id, ColmapCamera(camera.model.name, *size, np.asarray(camera.params, np.float64)))


def _lens(camera_id: int, camera: ColmapCamera) -> Lens:
    model, given = camera.model, camera.parameters
    places = (_BROWN | _FISHEYE).get(model)
    if places is None or np.any(given[9:] != 0):
        wanted = ", ".join(_BROWN | _FISHEYE)
        raise InputError(f"camera {camera_id}: expected one of {wanted} without k4 to k6, found {model}")
    values = np.zeros(9)
    values[: len(places)] = given[list(places)]
    values[2:4] -= HALF_PIXEL
    intrinsics = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1]])
    return Lens(intrinsics, values[4:], "fisheye" if model in _FISHEYE else "brown")


def sensor(camera_id: int) -> Any:
    """The sensor_t of a camera."""
    pycolmap = import_pycolmap()
    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)


def write_model(folder: str | Path, rig: Rig, *, text: bool = False) -> None:
    """Write a rig as one COLMAP rig with one frame, whose images are called after the cameras: `NAME.png`.

    The rig's own frame is the first camera.
    """
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction()
    colmap_rig, frame = pycolmap.Rig(rig_id=1), pycolmap.Frame(frame_id=1, rig_id=1)
    from_first = rig.T_camera_world @ np.linalg.inv(rig.T_camera_world[0])
    images = []
    for index, name in enumerate(rig.names):
        camera_id = index + 1
        model.add_camera(colmap_camera(camera_id, camera_lens(rig, index), rig.image_sizes[index]))
        if index == 0:
            colmap_rig.add_ref_sensor(sensor(camera_id))
        else:
            colmap_rig.add_sensor(sensor(camera_id), pycolmap.Rigid3d(from_first[index, :3]))
        frame.add_data_id(pycolmap.data_t(sensor(camera_id), camera_id))
        image = pycolmap.Image(name=f"{name}.png", camera_id=camera_id, image_id=camera_id)
        image.frame_id = 1
        images.append(image)
    frame.rig_from_world = pycolmap.Rigid3d(rig.T_camera_world[0, :3])
    model.add_rig(colmap_rig)
    model.add_frame(frame)
    for image in images:
        model.add_image(image)
    model.register_frame(1)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write)(folder)


def read_model(folder: str | Path) -> Rig:
    """Read the cameras of a COLMAP model, binary or text.

    A model with a rig of several cameras gives these, placed as in its first frame. Without one, every image is a
    camera. A camera is called after its image's file, or after its folder where a rig has many frames.

    Args:
        folder: of the model, or one above it that holds no other.
    Raises:
        InputError: not a model, no image in it, or a camera that our lenses cannot describe.
    """
    folder = find_model(Path(folder))
    suffix = model_suffix(folder)
    cameras = read_cameras(folder / f"cameras{suffix}")
    images = read_images(folder / f"images{suffix}")
    if not images:
        raise InputError("expected a model with images that have poses, found none", where=folder)
    frames = _frames_of(images, read_frames(folder / f"frames{suffix}"))
    widest = max(frames, key=len)
    moving = len(widest) > 1
    chosen = [images[image_id] for frame in ([widest] if moving else frames) for image_id in frame]
    with reading(folder, "COLMAP model"):
        missing = [image for image in chosen if image.camera_id not in cameras]
        if missing:
            raise InputError(
                f"image {missing[0].name}: expected camera {missing[0].camera_id}, found none of this number"
            )
        lenses = [_lens(image.camera_id, cameras[image.camera_id]) for image in chosen]
        sizes = [(cameras[image.camera_id].width, cameras[image.camera_id].height) for image in chosen]
        return Rig(
            names=camera_names([image.name for image in chosen], by_folder=moving and len(frames) > 1),
            intrinsics=np.stack([lens.intrinsics for lens in lenses]),
            distortion=np.stack([lens.distortion for lens in lenses]),
            T_camera_world=np.stack([image.T_camera_world for image in chosen]),
            image_sizes=np.array(sizes, np.int32),
            lenses=tuple(lens.model for lens in lenses),
        )


def _frames_of(images: Mapping[int, ColmapImage], frames: Mapping[int, tuple[int, ...]]) -> list[list[int]]:
    """The numbers of the images that were taken at once; an image of no frame is alone."""
    grouped = [sorted(image_id for image_id in frames[number] if image_id in images) for number in sorted(frames)]
    known = {image_id for frame in grouped for image_id in frame}
    return [frame for frame in grouped if frame] + [[image_id] for image_id in sorted(images) if image_id not in known]
