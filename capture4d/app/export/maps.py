"""Normal maps beside an export: +Y, 8 or 16 bits, named by frame."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from capture4d.app.export.clip import MapFolder
from capture4d.errors import InputError
from capture4d.files.atomic import write_bytes
from capture4d.files.pictures import holds_pixels
from wrinkles.normal_maps.spaces import decode_png, encode_png, encode_png8, flip_green

__all__ = ["map_bytes", "map_name", "write_maps"]


def map_name(frame_id: int) -> str:
    return f"normals/{frame_id:06d}.png"


def write_maps(folder: Path, maps: MapFolder, frame_ids: list[int], bits: int) -> None:
    """Write the map of each frame that is not there yet, and read it back.

    Raises:
        InputError: a map is damaged, or has fewer bits than are asked for.
    """
    for frame_id in frame_ids:
        path = folder / map_name(frame_id)
        if path.is_file() and path.stat().st_size:
            continue
        data = map_bytes(maps, frame_id, bits)
        write_bytes(path, data)
        pixels = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
        if pixels is None or pixels.dtype.itemsize * 8 != bits:
            raise InputError(f"read back: expected a picture of {bits} bits, found none", where=path)


def map_bytes(maps: MapFolder, frame_id: int, bits: int) -> bytes:
    """A PNG of +Y."""
    if bits > maps.bits:
        raise InputError(f"expected normal maps of {bits} bits, found {maps.bits}; use --maps 8", where=maps.path)
    source = maps.file(frame_id)
    data = source.read_bytes()
    if bits == maps.bits and not maps.flipped:
        return data
    if maps.bits == 16:
        image = decode_png(data, source=str(source))[0]
    else:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if holds_pixels(data) else None
        if pixels is None:
            raise InputError("expected a picture, found a damaged file", where=source)
        image = (pixels[..., ::-1].astype(np.float32) - 128) / np.float32(127.5)
    image = flip_green(image) if maps.flipped else image
    return encode_png(image) if bits == 16 else encode_png8(image)
