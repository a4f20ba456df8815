"""Pixels of images as other programs write them, and of those that claim more than they are."""

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from capture4d.errors import InputError
from capture4d.files.pictures import picture_pixels

GREY = np.array([[0, 100], [200, 255]], np.uint8)


def written(array: np.ndarray, kind: str) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(array).save(stream, kind)
    return stream.getvalue()


@pytest.mark.parametrize(("array", "kind"), [
    (GREY, "PNG"), (GREY, "TIFF"), (GREY, "BMP"), (GREY.astype(np.uint16) * 257, "PNG"),
    (GREY.astype(np.uint16) * 257, "TIFF"), (GREY.astype(np.int32) * 257, "TIFF"),
    (GREY.astype(np.float32) / 255, "TIFF"), (np.repeat(GREY[:, :, None], 3, axis=2), "PNG"),
    (np.dstack([GREY] * 3 + [GREY * 0]), "PNG"),
])  # fmt: skip
def test_grey_is_grey_however_many_bits_hold_it(array: np.ndarray, kind: str) -> None:
    np.testing.assert_array_equal(picture_pixels(written(array, kind)), np.repeat(GREY[:, :, None], 3, axis=2))


@pytest.mark.parametrize("array", [np.full((2, 2), np.nan, np.float32), np.full((2, 2), -1, np.float32),
                                   np.full((2, 2), 1e9, np.float32), np.full((2, 2), 2**30, np.int32)])  # fmt: skip
def test_levels_that_no_camera_has_are_refused(array: np.ndarray) -> None:
    with pytest.raises(InputError, match="expected grey levels"):
        picture_pixels(written(array, "TIFF"))


def test_an_image_that_claims_more_pixels_than_its_bytes_hold_is_refused() -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 12_000, 12_000, 8, 2, 0, 0, 0)
    with pytest.raises(InputError, match="that claim to be 12000 x 12000 pixels"):
        picture_pixels(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"") + chunk(b"IEND", b""))


@pytest.mark.parametrize("data", [b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", b"GIF89a", b"", b"\0" * 64])
def test_what_is_none_of_the_named_formats_is_not_opened(data: bytes) -> None:
    with pytest.raises(InputError, match="not a readable image, damaged or too large"):
        picture_pixels(data)
