"""Offset images as files that other programs open: float TIFF or EXR in centimetres, or PNG with 16 bits over a range.

RGB is tangent, bitangent, normal. A PNG tells its range and unit in text chunks, an EXR its unit; the folder's
layout.json does as well. A program may write a PNG back with 8 bits, and an EXR with 16.
"""

from __future__ import annotations

import contextlib
import errno
import io
import tempfile
import zlib
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from capture4d.errors import InputError
from capture4d.files.atomic import write_bytes
from capture4d.files.optional_packages import EXR, package_module
from capture4d.files.reading import reading
from capture4d.heavy_imports import native_stderr_closed
from wrinkles.offset_images.editing.config import PictureFormat

__all__ = ["RANGE_CM", "read_change", "write_picture"]

RANGE_CM = 64.0
"""Of a PNG, half of it below zero: 16 bits err by 0.005 mm."""
EXR_MAGIC = b"\x76\x2f\x31\x01"
FULL = {np.dtype(np.uint16): 65535.0, np.dtype(np.uint8): 255.0}


def write_picture(path: Path, image: Float32[np.ndarray, "size size 3"], kind: PictureFormat) -> np.ndarray:
    """Write one side.

    Returns:
        The values as the file has them: float32 of a TIFF and an EXR, uint16 of a PNG.
    Raises:
        InputError: offsets beyond a PNG's range, or an EXR without the package for it.
    """
    if kind == "exr":
        write_bytes(path, _exr_bytes(image))
        return image
    if kind == "png" and np.abs(image).max(initial=0.0) > RANGE_CM / 2:
        worst = float(np.abs(image).max())
        raise InputError(
            f"expected offsets within {RANGE_CM / 2:g} cm for a PNG, found {worst:.1f}; use tif", where=path
        )
    values = image if kind == "tif" else np.round((image / RANGE_CM + 0.5) * 65535).astype(np.uint16)
    good, data = cv2.imencode(f".{kind}", np.ascontiguousarray(values[..., ::-1]))
    assert good
    write_bytes(path, data.tobytes() if kind == "tif" else _with_text(data.tobytes()))
    return values


def read_change(path: Path, written: np.ndarray) -> Float32[np.ndarray, "size size 3"]:
    """How a picture differs from what was written, centimetres; exactly 0 where nobody touched it.

    Args:
        written: what `write_picture` returned for it.
    Raises:
        InputError: the file is missing, damaged, or holds another kind of picture.
    """
    with reading(path, "picture"):
        if path.suffix == ".exr":
            planes = _read_exr(path, written.shape)
            if all(plane.dtype.kind == "f" for plane in planes):  # each by itself: some may be halves
                _check_values(np.stack(planes, axis=-1), written)
                return np.stack([_change(plane, written[..., at]) for at, plane in enumerate(planes)], axis=-1)
            raise InputError("expected channels of float, found whole numbers")
        found = _read_image(path)
        _check_size(found.shape, written.shape)
        if written.dtype.kind == "f":
            if found.dtype != np.float32:
                raise InputError(f"expected 32 bits of float in a channel as it was drawn, found {found.dtype}")
            _check_values(found, written)
            return _change(found, written)
        if found.dtype not in FULL:
            raise InputError(f"expected 16 or 8 bits a channel, found {found.dtype}")
        full = FULL[found.dtype]
        before = written if found.dtype == written.dtype else np.round(written / 257.0)
        return (RANGE_CM / full * (found.astype(np.float64) - before)).astype(np.float32)


def _check_size(found: tuple[int, ...], drawn: tuple[int, ...]) -> None:
    if found[:2] != drawn[:2]:
        raise InputError(f"expected {drawn[1]} x {drawn[0]} texels as it was drawn, found {found[1]} x {found[0]}")


def _check_values(found: np.ndarray, written: np.ndarray) -> None:
    if not np.isfinite(found).all():
        raise InputError("expected finite offsets, found others")
    if _is_clipped(found, written):
        raise InputError("expected centimetres of any sign, found nothing below 0 or above 1: the program that "
                         "wrote it has clipped them; draw with --format png for it")  # fmt: skip


def _change(found: np.ndarray, written: np.ndarray) -> np.ndarray:
    """What was added, beside what was written in as many bits."""
    return (found.astype(np.float64) - written.astype(found.dtype).astype(np.float64)).astype(np.float32)


def _read_image(path: Path) -> np.ndarray:
    data = np.frombuffer(path.read_bytes(), np.uint8)
    found = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    if found is None or found.ndim != 3 or found.shape[2] not in (3, 4):
        raise InputError("expected a picture with three channels, found none, or a damaged one")
    return found[..., 2::-1]


def _exr_bytes(image: np.ndarray) -> bytes:
    """Read back, for the library says nothing of a disk that is full."""
    exr = package_module(EXR, "")
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage, "unit": "cm"}
    with tempfile.TemporaryDirectory(prefix="capture4d-exr-") as folder:
        path = Path(folder) / "offsets.exr"
        with exr.File(header, {"RGB": np.ascontiguousarray(image, np.float32)}) as file:
            file.write(str(path))
        try:
            whole = np.array_equal(np.stack(_read_exr(path, image.shape), axis=-1), image)
        except InputError:
            whole = False
        if not whole:
            raise OSError(errno.EIO, "an EXR that was written there cannot be read back", folder)
        return path.read_bytes()


def _read_exr(path: Path, drawn: tuple[int, ...]) -> list[np.ndarray]:
    """Red, green and blue, of kinds of their own, of the first part that has them, of a layer of any name."""
    exr = package_module(EXR, "")
    if path.read_bytes()[:4] != EXR_MAGIC:
        raise InputError("expected an EXR, found none")
    told = io.StringIO()  # of pixels that cannot be read there is a line, and no error
    try:
        with native_stderr_closed(), contextlib.redirect_stdout(told):
            with exr.File(str(path), header_only=True) as file:
                for part in file.parts:  # before room is made for its pixels
                    first, last = part.header["dataWindow"]
                    width, height = (int(size) for size in np.subtract(last, first, dtype=np.int64) + 1)
                    _check_size((height, width), drawn)
            with exr.File(str(path), separate_channels=True) as file:
                parts = [{name: channel.pixels for name, channel in part.channels.items()} for part in file.parts]
    except InputError:
        raise
    except (RuntimeError, ValueError, MemoryError) as error:
        raise InputError("expected an EXR, found a damaged one") from error
    if told.getvalue():
        raise InputError("expected an EXR, found a damaged one")
    for channels in parts:
        for layer in (name.removesuffix("R") for name in channels if name == "R" or name.endswith(".R")):
            planes = [channels[layer + name] for name in "RGB" if layer + name in channels]
            if [plane.shape for plane in planes] == 3 * [drawn[:2]]:
                return planes
    raise InputError("expected channels R, G and B, found others")


def _is_clipped(found: np.ndarray, written: np.ndarray) -> bool:
    """Whether a program that takes floats for shares of white has written a picture, such as ImageMagick with 16 bits
    a quantum."""
    within = float(found.min()) >= 0 and float(found.max()) <= 1
    return within and (float(written.min()) < 0 or float(written.max()) > 1)


def _with_text(data: bytes) -> bytes:
    """A PNG with its unit and range in text chunks behind its header, its pixels untouched."""
    header = 8 + 25  # signature and IHDR
    told = {"unit": "cm", "range": f"{-RANGE_CM / 2:g} {RANGE_CM / 2:g}"}
    chunks = b"".join(_text_chunk(f"{key}\0{value}".encode("latin-1")) for key, value in told.items())
    return data[:header] + chunks + data[header:]


def _text_chunk(body: bytes) -> bytes:
    return len(body).to_bytes(4, "big") + b"tEXt" + body + zlib.crc32(b"tEXt" + body).to_bytes(4, "big")
