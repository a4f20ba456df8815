"""Pictures: the pixels of an image file from a stranger, in six named formats and no larger than its bytes allow."""

from __future__ import annotations

import io
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from capture4d.errors import InputError
from capture4d.files.arrays import DEFLATE_RATIO
from capture4d.files.reading import one_line, reading

__all__ = ["holds_pixels", "picture_pixels", "read_picture"]

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "TGA")
"""What is opened, whatever the file is called: Pillow knows others that start programs."""
_PNG = b"\x89PNG\r\n\x1a\n"
_ALWAYS = 1 << 22
"""Pixels of which an image of few bytes is believed."""


def read_picture(picture: Path) -> UInt8[np.ndarray, "rows columns 3"]:
    """The pixels of an image file, sRGB."""
    with reading(picture, "image"):
        return picture_pixels(picture.read_bytes())


def picture_pixels(data: bytes) -> UInt8[np.ndarray, "rows columns 3"]:
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
                return _bytes_of(image)
    except Exception as error:  # whatever Pillow's readers meet in a damaged file
        says = "none of " + ", ".join(_FORMATS) if isinstance(error, UnidentifiedImageError) else one_line(error)
        raise InputError(f"not a readable image, damaged or too large ({says})") from error


def _bytes_of(image: Any) -> UInt8[np.ndarray, "rows columns 3"]:
    """Of an opened image; Pillow alone would cut off grey levels above 255 instead of scaling them."""
    if image.mode.startswith("I;16"):
        grey = np.asarray(image).astype(np.uint16) / 257
    elif image.mode in ("I", "F"):
        grey = np.asarray(image).astype(np.float64)
        if not np.isfinite(grey).all() or grey.min(initial=0) < 0:
            raise InputError("expected grey levels from 0, found others")
        grey = grey * 255 if image.mode == "F" and grey.max(initial=0) <= 1 else grey / 257
        if grey.max(initial=0) > 255.5:
            raise InputError("expected grey levels of 8 or 16 bits, found larger ones")
    else:
        return np.array(image.convert("RGB"))
    return np.repeat(np.rint(grey).astype(np.uint8)[:, :, None], 3, axis=2)


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
