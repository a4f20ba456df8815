"""COLMAP's files of cameras, images and frames, binary and text: what a rig needs of a model.

Read here because pycolmap's reader follows the counts in a file: one that lies makes it spin, or ends the process.
Rigs and points are not needed: an image's own pose stands in images.bin, and says the same.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.files.reading import reading

__all__ = ["ColmapCamera", "ColmapImage", "model_suffix", "read_cameras", "read_frames", "read_images"]

_MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)
"""Names and numbers of parameters, by COLMAP's number of the model (sensor/models.h)."""
_CAMERA_SENSOR = 0
_KIND = "COLMAP model"


@dataclass(frozen=True, slots=True, eq=False)
class ColmapCamera:
    """A line of cameras.txt."""

    model: str
    width: int
    height: int
    parameters: Float64[np.ndarray, " parameters"]

    def __post_init__(self) -> None:
        if not (0 < self.width < 2**31 and 0 < self.height < 2**31):
            raise InputError(f"expected the size of an image, found {self.width} x {self.height}")
        expected = dict(_MODELS).get(self.model, len(self.parameters))
        if len(self.parameters) != expected:
            raise InputError(f"expected {expected} parameters of {self.model}, found {len(self.parameters)}")
        if not np.isfinite(self.parameters).all():
            raise InputError("expected finite parameters of a camera, found NaN or infinity")


@dataclass(frozen=True, slots=True, eq=False)
class ColmapImage:
    """A line of images.txt."""

    name: str
    camera_id: int
    T_camera_world: Float64[np.ndarray, "4 4"]


def model_suffix(folder: Path) -> str:
    """Of the model's files.

    Raises:
        InputError: there is no model.
    """
    for suffix in (".bin", ".txt"):
        if all((folder / f"{part}{suffix}").is_file() for part in ("cameras", "images")):
            return suffix
    raise InputError("expected a COLMAP model (cameras and images, .bin or .txt), found none", where=folder)


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """By their numbers."""
    with reading(path, _KIND):
        return dict(_cameras_text(path) if path.suffix == ".txt" else _cameras_binary(path))


def read_images(path: Path) -> dict[int, ColmapImage]:
    """By their numbers."""
    with reading(path, _KIND):
        return dict(_images_text(path) if path.suffix == ".txt" else _images_binary(path))


def read_frames(path: Path) -> dict[int, tuple[int, ...]]:
    """The images that were taken at once, by the numbers of their frames; models of before COLMAP 3.12 have no file."""
    if not path.is_file():
        return {}
    with reading(path, _KIND):
        return dict(_frames_text(path) if path.suffix == ".txt" else _frames_binary(path))


def _pose(numbers: list[float] | tuple[float, ...]) -> Float64[np.ndarray, "4 4"]:
    """From a quaternion, w first, and a translation."""
    w, x, y, z, *translation = numbers
    if not np.isfinite(numbers).all() or w * w + x * x + y * y + z * z == 0:
        raise InputError(f"expected a pose, found {' '.join(f'{number:g}' for number in numbers)}")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    matrix[:3, 3] = translation
    return matrix


# --- binary ------------------------------------------------------------------------------------------------------


class _Bytes:
    """The numbers of a file, one after the other."""

    def __init__(self, path: Path) -> None:
        self._data, self._at = path.read_bytes(), 0

    def take(self, form: str) -> tuple:
        values = struct.unpack_from(f"<{form}", self._data, self._at)
        self.skip(struct.calcsize(f"<{form}"))
        return values

    def skip(self, count: int) -> None:
        self._at += count
        if self._at > len(self._data):
            raise InputError(f"not a readable {_KIND}, cut off: expected {self._at} bytes, found {len(self._data)}")

    def word(self) -> str:
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise InputError(f"not a readable {_KIND}, cut off in a name")
        word = self._data[self._at : end].decode("utf-8")
        self._at = end + 1
        return word


def _cameras_binary(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    data = _Bytes(path)
    for _ in range(data.take("Q")[0]):
        number, model, width, height = data.take("IiQQ")
        if not 0 <= model < len(_MODELS):
            raise InputError(f"camera {number}: expected a model from 0 to {len(_MODELS) - 1}, found {model}")
        name, count = _MODELS[model]
        yield number, ColmapCamera(name, width, height, np.array(data.take(f"{count}d")))


def _images_binary(path: Path) -> Iterator[tuple[int, ColmapImage]]:
    data = _Bytes(path)
    for _ in range(data.take("Q")[0]):
        number, *pose, camera_id = data.take("I7dI")
        name = data.word()
        data.skip(24 * data.take("Q")[0])  # points: x, y and the number of a 3D point
        yield number, ColmapImage(name, camera_id, _pose(pose))


def _frames_binary(path: Path) -> Iterator[tuple[int, tuple[int, ...]]]:
    data = _Bytes(path)
    for _ in range(data.take("Q")[0]):
        number, _, *_, count = data.take("II7dI")
        taken = [data.take("iIQ") for _ in range(count)]
        yield number, tuple(image for sensor, _, image in taken if sensor == _CAMERA_SENSOR)


# --- text --------------------------------------------------------------------------------------------------------


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        yield number, line.strip()


def _cameras_text(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    for number, line in _lines(path):
        if line and not line.startswith("#"):
            try:
                camera_id, model, width, height, *parameters = line.split()
                values = np.array([float(value) for value in parameters])
                yield int(camera_id), ColmapCamera(model, int(width), int(height), values)
            except ValueError as error:
                raise _wrong(number, "ID MODEL WIDTH HEIGHT PARAMETERS", line, error) from None


def _images_text(path: Path) -> Iterator[tuple[int, ColmapImage]]:
    """Two lines an image: its own, and one with its points, which may be empty."""
    lines = _lines(path)
    for number, line in lines:
        if not line or line.startswith("#"):
            continue
        try:
            image_id, *pose, camera_id, name = line.split(maxsplit=9)
            image = ColmapImage(name, int(camera_id), _pose([float(value) for value in pose]))
        except ValueError as error:
            raise _wrong(number, "ID QW QX QY QZ TX TY TZ CAMERA NAME", line, error) from None
        number, points = next(lines, (number, ""))
        try:
            if np.array(points.split(), np.float64).size % 3:
                raise ValueError("not three numbers a point")
        except ValueError as error:
            raise _wrong(number, "X Y POINT3D of every point, or an empty line", points, error) from None
        yield int(image_id), image


def _frames_text(path: Path) -> Iterator[tuple[int, tuple[int, ...]]]:
    for number, line in _lines(path):
        if line and not line.startswith("#"):
            words = line.split()
            try:
                count = int(words[9])
                taken = [words[10 + 3 * index : 13 + 3 * index] for index in range(min(count, len(words)))]
                yield int(words[0]), tuple(int(image) for sensor, _, image in taken if sensor == "CAMERA")
            except (ValueError, IndexError) as error:
                raise _wrong(number, "ID RIG QW QX QY QZ TX TY TZ COUNT and SENSOR ID DATA", line, error) from None


def _wrong(number: int, expected: str, found: str, error: Exception) -> InputError:
    if isinstance(error, InputError):
        return InputError(error.reason, line=number)
    return InputError(f"not a readable {_KIND}, expected {expected}, found '{found[:80]}'", line=number)
