"""COLMAP's files of cameras, images and frames, binary and text: what a rig needs of a model.

Text may be written by hand: comments anywhere, and an image without the line of its points.

Read here because pycolmap's reader follows the counts in a file: one that lies makes it spin, or ends the process.
Rigs and points are not needed: an image's own pose stands in images.bin, and says the same.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.files.reading import reading

__all__ = [
    "MODELS",
    "ColmapCamera",
    "ColmapImage",
    "find_model",
    "model_suffix",
    "read_cameras",
    "read_frames",
    "read_images",
]

MODELS = (
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
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)
"""Names and numbers of parameters, by COLMAP's number of the model (sensor/models.h)."""
_CAMERA_SENSOR = 0
_DEEPEST = 3
"""Folders below one that is given in which a model is looked for: PROJECT/dense/sparse/0."""
_MOST_FOLDERS = 20_000
_KIND = "COLMAP model"
_Row = TypeVar("_Row")


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
        expected = dict(MODELS).get(self.model, len(self.parameters))
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


def model_suffix(folder: Path) -> str | None:
    """Of the model's files: .bin where both kinds lie there, as COLMAP does it; None if there is no model."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{part}{suffix}").is_file() for part in ("cameras", "images")):
            return suffix
    return None


def find_model(folder: Path) -> Path:
    """A folder with a model: this one, or the only one below it.

    Raises:
        InputError: there is no model, or more than one.
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=folder)
    if model_suffix(folder) is not None:
        return folder
    level, models, looked = [folder], [], 0
    for _ in range(_DEEPEST):
        level = [below for above in level for below in _folders(above)][: _MOST_FOLDERS - looked]
        looked += len(level)
        models += [below for below in level if model_suffix(below) is not None]
    if len(models) > 1:
        named = ", ".join(model.relative_to(folder).as_posix() for model in models[:5])
        raise InputError(f"expected one COLMAP model, found {len(models)} ({named}); give one of them", where=folder)
    if not models:
        raise InputError("expected a COLMAP model (cameras and images, .bin or .txt), found none", where=folder)
    return models[0]


def _folders(above: Path) -> list[Path]:
    try:
        return sorted(below for below in above.iterdir() if below.is_dir() and not below.is_symlink())
    except PermissionError:
        return []


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """By their numbers."""
    with reading(path, _KIND):
        return _by_number("camera", _cameras_text(path) if path.suffix == ".txt" else _cameras_binary(path))


def read_images(path: Path) -> dict[int, ColmapImage]:
    """By their numbers."""
    with reading(path, _KIND):
        return _by_number("image", _images_text(path) if path.suffix == ".txt" else _images_binary(path))


def read_frames(path: Path) -> dict[int, tuple[int, ...]]:
    """The images that were taken at once, by the numbers of their frames; models of before COLMAP 3.12 have no file."""
    if not path.is_file():
        return {}
    with reading(path, _KIND):
        return _by_number("frame", _frames_text(path) if path.suffix == ".txt" else _frames_binary(path))


def _by_number(what: str, rows: Iterable[tuple[int, _Row]]) -> dict[int, _Row]:
    found: dict[int, _Row] = {}
    for number, row in rows:
        if number in found:
            raise InputError(f"expected {what}s with numbers of their own, found {what} {number} twice")
        found[number] = row
    return found


def _pose(numbers: list[float] | tuple[float, ...]) -> Float64[np.ndarray, "4 4"]:
    """From a quaternion, w first, and a translation."""
    quaternion, translation = np.array(numbers[:4]), numbers[4:]
    if not np.isfinite(numbers).all() or not quaternion.any():
        raise InputError(f"expected a pose, found {' '.join(f'{number:g}' for number in numbers)}")
    w, x, y, z = quaternion / np.abs(quaternion).max()  # so that its square is a number
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
        if not 0 <= model < len(MODELS):
            raise InputError(f"camera {number}: expected a model from 0 to {len(MODELS) - 1}, found {model}")
        name, count = MODELS[model]
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
    """Without comments; names may hold what `splitlines` takes for the end of a line."""
    for number, line in enumerate(path.read_text(encoding="utf-8-sig").split("\n"), start=1):
        if not line.lstrip().startswith("#"):
            yield number, line.strip()


def _cameras_text(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    for number, line in _lines(path):
        if line:
            try:
                camera_id, model, width, height, *parameters = line.split()
                values = np.array([float(value) for value in parameters])
                yield int(camera_id), ColmapCamera(model, int(width), int(height), values)
            except ValueError as error:
                raise _wrong(number, "ID MODEL WIDTH HEIGHT PARAMETERS", line, error) from None


def _images_text(path: Path) -> Iterator[tuple[int, ColmapImage]]:
    """A line an image, and after it one with its points, which may be empty or missing."""
    points_may_follow = False
    for number, line in _lines(path):
        if not line or (points_may_follow and _are_points(line)):
            points_may_follow = False
            continue
        try:
            image_id, *pose, camera_id, name = line.split(maxsplit=9)
            if len(pose) != 7:
                raise ValueError("not ten words")
            image = ColmapImage(name, int(camera_id), _pose([float(value) for value in pose]))
            yield int(image_id), image
        except ValueError as error:
            expected = "ID QW QX QY QZ TX TY TZ CAMERA NAME"
            if points_may_follow:
                expected += ", or X Y POINT3D of every point of the image before"
            raise _wrong(number, expected, line, error) from None
        points_may_follow = True


def _are_points(line: str) -> bool:
    """Whether a line is numbers alone, three a point and the last of them whole."""
    words = line.split()
    if len(words) % 3:
        return False
    try:
        return all(number.is_integer() for number in list(map(float, words))[2::3])
    except ValueError:
        return False


def _frames_text(path: Path) -> Iterator[tuple[int, tuple[int, ...]]]:
    for number, line in _lines(path):
        if line:
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
