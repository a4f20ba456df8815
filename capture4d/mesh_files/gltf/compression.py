"""Compressed geometry: Draco and meshoptimizer.

Both decoders are native and given the bytes of strangers. What a payload claims is compared with its bytes before they
see it; of Draco only the newest bitstream, which glTF asks for, and none of the metadata that Draco can carry.
"""

from __future__ import annotations

import queue
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture4d.errors import InputError
from capture4d.files.reading import one_line
from capture4d.mesh_files.gltf.entries import count_of

__all__ = ["DRACO", "MESHOPT", "Draco", "draco_mesh", "meshopt_bytes"]

DRACO = "KHR_draco_mesh_compression"
MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
_MODES, _FILTERS = ("ATTRIBUTES", "TRIANGLES", "INDICES"), ("NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL", "COLOR")
_MESHOPT_RATIO = 1024
"""Bytes that one byte can stand for: two bits say that a byte of 256 rows stays as it is."""
_DRACO_RATIO, _DRACO_ALWAYS = 256, 65_536
"""Vertices or faces that a byte can stand for, and those always believed: of flat grids the densest has 28 a byte."""
_PATIENCE_S, _SLOWEST = 10, 100_000
"""Seconds for any payload, and bytes in each more: a fiftieth of what it decodes at its slowest level on one core."""
_DRACO_HEAD = struct.Struct("<5s4BH")
_METADATA = 0x8000


def meshopt_bytes(name: str, where: str, packed: dict[str, Any], data: memoryview) -> bytes:
    """A buffer view of EXT_meshopt_compression or KHR_meshopt_compression, decompressed."""
    count, stride = count_of(packed, "count"), count_of(packed, "byteStride")
    mode, kind = packed.get("mode"), packed.get("filter", "NONE")
    if mode not in _MODES or kind not in _FILTERS:
        raise InputError(f"{where}: expected a mode and a filter of {name}, found {str(mode)[:40]}, {str(kind)[:40]}")
    if count * stride > _MESHOPT_RATIO * len(data):
        raise InputError(f"{where}: not readable as {name}, {len(data)} bytes that claim to be {count * stride}")
    if not count:
        return b""
    import meshopt

    try:
        return meshopt.decode_gltf_buffer(bytes(data), count, stride, mode, kind).tobytes()
    except Exception as error:
        raise InputError(f"{where}: not readable as {name}, damaged ({one_line(error)})") from None


@dataclass(frozen=True, slots=True, eq=False)
class Draco:
    """A primitive that was compressed."""

    faces: np.ndarray
    """(F, 3)"""
    attributes: dict[int, np.ndarray]
    """(V, width) by unique id, of the type in which they were compressed."""


def draco_mesh(where: str, payload: bytes) -> Draco:
    """A payload of KHR_draco_mesh_compression, decompressed."""
    try:
        payload = _plain(payload)
    except (struct.error, IndexError, RecursionError):
        raise InputError(f"{where}: not readable as Draco ({DRACO}), cut off") from None
    except InputError as error:
        raise InputError(f"{where}: not readable as Draco ({DRACO}), {error.reason}") from None
    import DracoPy

    try:
        mesh = _within(_PATIENCE_S + len(payload) / _SLOWEST, lambda: DracoPy.decode(payload))
        if not isinstance(mesh, DracoPy.DracoMesh):  # what it makes of a mesh without faces
            raise InputError("found no triangles")
        faces = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
        attributes = {int(each["unique_id"]): np.asarray(each["data"]) for each in mesh.attributes}
    except Exception as error:
        raise InputError(f"{where}: not readable as Draco ({DRACO}), damaged ({one_line(error)})") from None
    return Draco(faces, attributes)


def _within(seconds: float, decode: Callable[[], Any]) -> Any:
    """What a decoder that lets go of Python's lock makes, if it is done in time.

    A few bytes can make Draco read a billion bits. Nobody can stop it then; it ends by itself, or with the process.
    """
    done: queue.SimpleQueue[tuple[Any, Exception | None]] = queue.SimpleQueue()

    def run() -> None:
        try:
            done.put((decode(), None))
        except Exception as error:
            done.put((None, error))

    threading.Thread(target=run, daemon=True).start()
    try:
        found, error = done.get(timeout=seconds)
    except queue.Empty:
        raise InputError(f"not done in {seconds:.0f} s") from None
    if error is not None:
        raise error
    return found


def _plain(payload: bytes) -> bytes:
    """A Draco mesh without its metadata, whose claims its bytes can bear."""
    word, major, minor, kind, method, flags = _DRACO_HEAD.unpack_from(payload)
    if word != b"DRACO":
        raise InputError(f"expected the bytes DRACO at its beginning, found {word!r}")
    if (major, minor) != (2, 2) or kind != 1 or method > 1:
        raise InputError(f"expected a mesh of version 2.2, found kind {kind}, method {method} of {major}.{minor}")
    body = _DRACO_HEAD.size
    if flags & _METADATA:
        body = _after_metadata(payload, body)
        payload = _DRACO_HEAD.pack(word, major, minor, kind, method, flags & ~_METADATA) + payload[body:]
        body = _DRACO_HEAD.size
    most = max(_DRACO_ALWAYS, _DRACO_RATIO * len(payload))
    for claimed in _claims(payload, body, method):
        if claimed > most:
            raise InputError(f"{len(payload)} bytes that claim to be {claimed} elements")
    return payload


def _claims(payload: bytes, at: int, method: int) -> list[int]:
    """Numbers by which a decoder makes room: faces and points; or vertices, faces, symbols and split symbols."""
    if method == 0:
        faces, at = _varint(payload, at)
        return [faces, _varint(payload, at)[0]]
    vertices, at = _varint(payload, at + 1)  # after the kind of traversal
    faces, at = _varint(payload, at)
    symbols, at = _varint(payload, at + 1)  # after the number of attributes
    splits, _ = _varint(payload, at)
    if symbols > faces or splits > symbols:
        raise InputError(f"{symbols} symbols, {splits} of them splits, for {faces} faces")
    return [vertices, faces]


def _varint(payload: bytes, at: int) -> tuple[int, int]:
    """A number of any length, and where it ends."""
    value = 0
    for shift in range(0, 35, 7):
        value |= (payload[at] & 0x7F) << shift
        at += 1
        if payload[at - 1] < 0x80:
            return value, at
    raise InputError("a number that does not end")


def _after_metadata(payload: bytes, at: int) -> int:
    attributes, at = _varint(payload, at)
    for _ in range(attributes):
        _, at = _varint(payload, at)
        at = _after_entries(payload, at)
    return _after_entries(payload, at)


def _after_entries(payload: bytes, at: int) -> int:
    """The end of names and values, some of which are again names and values."""
    entries, at = _varint(payload, at)
    for _ in range(entries):
        at += 1 + payload[at]
        size, at = _varint(payload, at)
        at += size
    nested, at = _varint(payload, at)
    for _ in range(nested):
        at = _after_entries(payload, at + 1 + payload[at])
    return at
