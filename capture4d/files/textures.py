"""Textures: the image that a mesh file names, and its colours at the vertices.

The image is read at every face corner, between pixels, and a vertex takes the mean of its corners: across a seam both
sides show the same paint.
"""

from __future__ import annotations

import io
import re
import struct
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from capture4d.errors import InputError
from capture4d.files.arrays import DEFLATE_RATIO
from capture4d.files.reading import companion, one_line, reading
from capture4d.types import Mesh

__all__ = ["holds_pixels", "named_texture", "read_texture", "texture_colours", "texture_pixels"]

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "TGA")
"""What is opened, whatever the file is called: Pillow knows others that start programs."""
_HEAD = 65_536
_PNG = b"\x89PNG\r\n\x1a\n"
_ALWAYS = 1 << 22
"""Pixels of which an image of few bytes is believed."""


def named_texture(path: Path) -> Path | None:
    """The one image that the head of an obj (by its mtl) or of a ply names.

    Raises:
        InputError: it names several, one that is not there, or one that does not lie beside it or in a folder below.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD).decode("utf-8", errors="replace")
    if path.suffix.lower() == ".ply":
        names = re.findall(r"^comment TextureFile (.+?)\s*$", head.partition("end_header")[0], re.M)
    else:
        names = []
        for library in re.findall(r"^mtllib (.+?)\s*$", head, re.M):
            lines = companion(path, library, "materials").read_text(encoding="utf-8", errors="replace")
            names += re.findall(r"^\s*map_Kd (?:-\S+ \S+ )*(.+?)\s*$", lines, re.M)
    if len(set(names)) > 1:
        raise InputError(f"expected one texture, found {', '.join(sorted(set(names)))}", where=path)
    return companion(path, names[0], "texture") if names else None


def read_texture(picture: Path) -> UInt8[np.ndarray, "rows columns 3"]:
    """The pixels of an image file, sRGB."""
    with reading(picture, "image"):
        return texture_pixels(picture.read_bytes())


def texture_pixels(data: bytes) -> UInt8[np.ndarray, "rows columns 3"]:
    """The pixels of an image, sRGB.

    Raises:
        InputError: it is damaged, too large, or not an image; the message names no file.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large images: it stops at twice that by itself; of odd metadata
            with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
                if not _plausible(image.size, data):
                    raise InputError(f"{len(data)} bytes that claim to be {image.width} x {image.height} pixels")
                return np.array(image.convert("RGB"))
    except Exception as error:  # whatever Pillow's readers meet in a damaged file
        says = "none of " + ", ".join(_FORMATS) if isinstance(error, UnidentifiedImageError) else one_line(error)
        raise InputError(f"not a readable image, damaged or too large ({says})") from error


def holds_pixels(data: bytes) -> bool:
    """Whether an image can hold the pixels that its header claims; OpenCV makes room for them before it looks.

    True for what is no image, too: that is the decoder's to say.
    """
    from PIL import Image

    if data.startswith(_PNG) and not _chunks_fit(data):
        return False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
                return _plausible(image.size, data)
    except Image.DecompressionBombError:
        return False
    except Exception:
        return True


def _chunks_fit(data: bytes) -> bool:
    """Whether the parts of a PNG, up to its end, are as long as they say."""
    place = len(_PNG)
    while place + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, place)
        place += 12 + length
        if kind == b"IEND":
            break
    return place <= len(data)


def _plausible(size: tuple[int, int], data: bytes) -> bool:
    return size[0] * size[1] <= max(_ALWAYS, DEFLATE_RATIO * len(data))


def texture_colours(mesh: Mesh, image: UInt8[np.ndarray, "rows columns 3"]) -> UInt8[np.ndarray, "verts 3"]:
    """Sample a texture at the vertices of a mesh with UVs; vertices that no face uses are black.

    Args:
        image: sRGB; v = 1 is its first row, as in obj files. UVs beyond 0 to 1 repeat it.
    Raises:
        InputError: the mesh has no UVs.
    """
    if mesh.uv is None:
        raise InputError("a texture needs UVs, found none")
    rows, columns = image.shape[:2]
    uv = mesh.uv.reshape(-1, 2).astype(np.float64)
    inside = np.where((uv >= 0) & (uv <= 1), uv, uv - np.floor(uv))
    across = np.clip(inside[:, 0] * columns - 0.5, 0, columns - 1)
    down = np.clip((1 - inside[:, 1]) * rows - 0.5, 0, rows - 1)
    left, top = np.floor(across).astype(int), np.floor(down).astype(int)
    right, bottom = np.minimum(left + 1, columns - 1), np.minimum(top + 1, rows - 1)
    x, y = (across - left)[:, None], (down - top)[:, None]
    upper = (1 - x) * image[top, left] + x * image[top, right]
    lower = (1 - x) * image[bottom, left] + x * image[bottom, right]
    corners = (1 - y) * upper + y * lower
    vertex = mesh.faces.reshape(-1)
    count = np.maximum(np.bincount(vertex, minlength=len(mesh.vertices)), 1)
    sums = [np.bincount(vertex, corners[:, channel], minlength=len(mesh.vertices)) for channel in range(3)]
    return np.clip(np.rint(np.stack(sums, axis=1) / count[:, None]), 0, 255).astype(np.uint8)
