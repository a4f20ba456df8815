"""Images of a board in a folder: which camera took which at what pose, and their grey levels."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from capture4d.errors import InputError
from capture4d.files.pictures import holds_pixels
from capture4d.files.reading import reading

__all__ = ["PATTERN", "BoardImage", "find_images", "natural_order", "read_grey"]

PATTERN = "{camera}/{pose}"
ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm")
_NOT_OURS = "__MACOSX"
"""A folder that macOS leaves in archives; its other leavings begin with a dot."""
_BRIGHTEST = 1e-4
"""Share of the pixels that may be brighter than the range in use: hot ones."""
_PNM = re.compile(rb"P([2356])\s(?:\s|#[^\n]*\n)*(\d{1,9})\s(?:\s|#[^\n]*\n)*(\d{1,9})\s(?:\s|#[^\n]*\n)*(\d{1,5})\s")


@dataclass(frozen=True, slots=True)
class BoardImage:
    """One image of a calibration, by its names."""

    camera: str
    pose: str
    path: Path


def find_images(folder: Path, pattern: str = PATTERN) -> list[BoardImage]:
    """The images of a folder, ordered by camera and pose. Hidden files and folders are left alone.

    Args:
        pattern: the path of an image in the folder without its ending; {camera} and {pose} stand for the names.
    Raises:
        InputError: the pattern lacks one of the two, no image matches it, or two images have the same names.
    """
    if sorted(re.findall(r"{(.*?)}", pattern)) != ["camera", "pose"]:
        raise InputError(f"--pattern: expected {{camera}} and {{pose}} once each, found '{pattern}'")
    if not folder.is_dir():
        raise InputError("no such folder", where=folder)
    expression = re.escape(pattern.strip("/"))
    for name in ("camera", "pose"):
        expression = expression.replace(re.escape(f"{{{name}}}"), f"(?P<{name}>[^/]+?)")
    paths = [path for path in sorted(folder.rglob("*")) if path.suffix.lower() in ENDINGS and path.is_file()]
    paths = [path for path in paths if not _hidden(path.relative_to(folder))]
    if not paths:
        raise InputError(f"expected images ({', '.join(ENDINGS)}), found none", where=folder)
    found: dict[tuple[str, str], BoardImage] = {}
    for path in paths:
        match = re.fullmatch(expression, path.relative_to(folder).with_suffix("").as_posix())
        if match is None:
            continue
        image = BoardImage(match["camera"], match["pose"], path)
        twin = found.setdefault((image.camera, image.pose), image)
        if twin is not image:
            raise InputError(f"expected one image of a camera and a pose, found {twin.path} as well", where=path)
    if not found:
        raise InputError(f"expected images that lie as --pattern '{pattern}' says, found none", where=paths[0])
    return sorted(found.values(), key=lambda image: (natural_order(image.camera), natural_order(image.pose)))


def natural_order(name: str) -> list[tuple[int, int | str]]:
    """Sort key that puts cam9 before cam10."""
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", name) if part]


def read_grey(path: Path) -> UInt8[np.ndarray, "height width"]:
    """The grey levels of an image, whose EXIF orientation is ignored.

    Images of more than 8 bits are scaled linearly, by the fewest bits that hold them.
    """
    with reading(path, "image"):
        data = path.read_bytes()
        picture = None
        if holds_pixels(data) and _pnm_holds_pixels(data):
            kind = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), kind)
        if picture is None:
            raise InputError("not a readable image, cut off or damaged")
        return _eight_bits(picture)


def _hidden(path: Path) -> bool:
    return any(part.startswith(".") or part == _NOT_OURS for part in path.parts)


def _pnm_holds_pixels(data: bytes) -> bool:
    """Whether a PGM or PPM is as long as its header claims; true for what is none."""
    if not re.match(rb"P[1-7]\s", data):
        return True
    header = _PNM.match(data)
    if header is None:
        return False
    kind, width, height, most = (int(number) for number in header.groups())
    samples = width * height * (3 if kind in (3, 6) else 1)
    least = 2 * samples - 1 if kind in (2, 3) else samples * (2 if most > 255 else 1)
    return len(data) - header.end() >= least


def _eight_bits(picture: np.ndarray) -> UInt8[np.ndarray, "height width"]:
    """Cameras of 10, 12 or 14 bits write files of 16 in which the upper bits are never used."""
    if picture.dtype == np.uint8:
        return picture
    if picture.dtype.kind not in "uf" or not np.isfinite(picture).all():
        raise InputError(f"expected grey levels of 8 or 16 bits, found {picture.dtype}")
    place = picture.size - 1 - min(max(1, int(_BRIGHTEST * picture.size)), picture.size - 1)
    bright = float(np.partition(picture.ravel(), place)[place])
    if picture.dtype.kind == "f":
        white = 2.0 ** np.ceil(np.log2(max(bright, 1e-30)))
    else:
        white = 2.0 ** max(int(bright).bit_length(), 8) - 1
    return np.rint(picture * (255.0 / white)).clip(0, 255).astype(np.uint8)
