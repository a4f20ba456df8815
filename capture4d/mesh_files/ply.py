"""Stanford PLY, text and binary.

Read here because packaged readers refuse binary files that mix triangles with other polygons, split vertices at UV
seams, or take a file that is cut off for an empty one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.errors import InputError
from capture4d.mesh_files.polygons import MeshFile, colour_bytes, polygon_corners, polygon_mesh
from capture4d.types import Mesh

__all__ = ["ply_bytes", "read_ply"]

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}


_INDICES = ("vertex_indices", "vertex_index")


@dataclass(slots=True)
class _Element:
    """One kind of record in a PLY file, and its columns once they are read."""

    name: str
    count: int
    properties: list[tuple[str, str, str]]
    """Name, type, and for a list the type of its length, else ''."""
    columns: dict[str, Any]
    """By property: (count,) for a value, (count, n) for lists of equal length, else a list of arrays."""

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError(self.count)

    def add(self, name: str, kind: str, length: str) -> None:
        if any(name == other for other, _, _ in self.properties) or length.startswith("f"):
            raise ValueError(name)
        self.properties.append((name, kind, length))


def read_ply(path: Path) -> MeshFile:
    """Read a PLY file; `capture4d.mesh_files.meshes.read_mesh` is the way in.

    Raises:
        InputError: the file is damaged or cut off; the message does not name it.
    """
    head, _, body = path.read_bytes().partition(b"end_header")
    elements, order = _header(head)
    body = body[2:] if body[:2] == b"\r\n" else body[1:]
    if order:
        _records_binary(elements, body, order)
    else:
        _records_ascii(elements, body)

    vertex, _ = _columns(elements, "vertex")
    face_values, face = _columns(elements, "face")
    if not {"x", "y", "z"} <= vertex.keys():
        raise InputError(f"expected vertices with x, y and z, found {', '.join(vertex) or 'none'}")
    vertices = np.column_stack([vertex[axis] for axis in "xyz"]).astype(np.float64)
    colours = None
    if {"red", "green", "blue"} <= vertex.keys():
        colours = colour_bytes(np.column_stack([vertex[channel] for channel in ("red", "green", "blue")]))

    for name in _INDICES:
        if name in face_values:
            raise InputError(f"expected a list of corners in every face, found one number called {name}")
    lists = next((face[name] for name in _INDICES if name in face), [])
    sizes = np.array([len(row) for row in lists], np.int64)
    corners = _joined(lists, np.int64)
    corner_uv = None
    if "texcoord" in face:
        texture = _joined(face["texcoord"], np.float64)
        corner_uv = texture.reshape(-1, 2) if len(texture) == 2 * len(corners) else None
    for u, v in (("s", "t"), ("u", "v"), ("texture_u", "texture_v")):
        if corner_uv is None and {u, v} <= vertex.keys():
            corner_uv = np.column_stack([vertex[u], vertex[v]])[np.clip(corners, 0, len(vertices) - 1)]
    mesh, polygon_sizes = polygon_mesh(vertices, corners, sizes, corner_uv)
    return MeshFile(mesh, colours, polygon_sizes)


def _columns(elements: list[_Element], name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Of one element: its properties that are a value, and those that are a list."""
    for element in elements:
        if element.name == name:
            lists = {each for each, _, length in element.properties if length}
            kinds = {each: kind for each, kind, _ in element.properties}
            for index in _INDICES:
                if kinds.get(index, "i").startswith("f"):
                    raise InputError(f"expected whole numbers as {index}, found a list of floats")
            columns = element.columns
            values = {each: columns[each] for each in columns if each not in lists}
            return values, {each: columns[each] for each in columns if each in lists}
    return {}, {}


def _header(head: bytes) -> tuple[list[_Element], str]:
    """The elements, still empty, and the byte order, '' for a text file."""
    elements: list[_Element] = []
    order = None
    lines = head.decode("latin-1").splitlines()
    if not lines or lines[0].strip() != "ply":
        raise InputError("not a PLY file, expected it to begin with 'ply'")
    for line in lines[1:]:
        try:
            match line.split():
                case ["format", name, _]:
                    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[name]
                case ["element", name, count]:
                    if any(name == element.name for element in elements):
                        raise ValueError(name)
                    elements.append(_Element(name, int(count), [], {}))
                case ["property", "list", length, kind, name]:
                    elements[-1].add(name, _TYPES[kind], _TYPES[length])
                case ["property", kind, name]:
                    elements[-1].add(name, _TYPES[kind], "")
        except (KeyError, ValueError, IndexError):
            raise InputError(f"damaged header, cannot read '{line.strip()[:80]}'") from None
    if order is None or not elements:
        raise InputError("cut off in the header")
    return elements, order


def _records_binary(elements: list[_Element], body: bytes, order: str) -> None:
    offset = 0
    for element in elements:
        if not element.properties:  # whatever their number, nothing is there
            continue
        offset = _equal_records(element, body, offset, order) or _single_records(element, body, offset, order)


def _equal_records(element: _Element, body: bytes, offset: int, order: str) -> int | None:
    """Read all records at once if each has lists as long as the first one's; the offset behind them, or None."""
    fields: list[tuple] = []
    size = offset
    for name, kind, length in element.properties:
        entries = 0
        if length:
            step = np.dtype(length).itemsize
            if size + step > len(body):
                return None
            entries = int(np.frombuffer(body, order + length, 1, size)[0])
            if entries < 0 or entries > len(body):
                return None
            fields.append((f"{name} length", order + length))
            size += step
        fields.append((name, order + kind, (entries,)) if length else (name, order + kind))
        size += np.dtype(kind).itemsize * (entries if length else 1)
    record = np.dtype(fields)
    end = offset + record.itemsize * element.count
    if end > len(body) or not element.count:
        return None
    records = np.frombuffer(body, record, element.count, offset)
    for name, _, length in element.properties:
        if length and (records[f"{name} length"] != records[f"{name} length"][0]).any():
            return None
    element.columns = {name: records[name] for name, _, _ in element.properties}
    return end


def _single_records(element: _Element, body: bytes, offset: int, order: str) -> int:
    """Read record by record, for lists of mixed lengths."""
    rows: dict[str, list[np.ndarray]] = {name: [] for name, _, _ in element.properties}
    types = [
        (name, np.dtype(order + kind), np.dtype(order + length) if length else None)
        for name, kind, length in element.properties
    ]
    try:
        for _ in range(element.count):
            for name, kind, length in types:
                entries = 1
                if length:
                    entries = int(np.frombuffer(body, length, 1, offset)[0])
                    offset += length.itemsize
                    if entries < 0:
                        raise ValueError(entries)
                rows[name].append(np.frombuffer(body, kind, entries, offset))
                offset += kind.itemsize * entries
    except ValueError:
        raise _cut_off(element, min(map(len, rows.values()))) from None
    _keep(element, rows)
    return offset


def _records_ascii(elements: list[_Element], body: bytes) -> None:
    try:
        numbers = np.array(body.split(), np.float64)
    except ValueError as error:
        raise InputError(f"damaged, {error}") from None
    offset = 0
    for element in elements:
        if not element.properties:
            continue
        if not any(length for _, _, length in element.properties):
            table = numbers[offset : offset + element.count * len(element.properties)]
            if len(table) < element.count * len(element.properties):
                raise _cut_off(element, len(table) // len(element.properties))
            offset += len(table)
            table = table.reshape(element.count, len(element.properties))
            element.columns = {
                name: _typed(table[:, index], kind, name) for index, (name, kind, _) in enumerate(element.properties)
            }
            continue
        rows: dict[str, list[np.ndarray]] = {name: [] for name, _, _ in element.properties}
        for row in range(element.count):
            for name, kind, length in element.properties:
                entries = 1
                if length:
                    entries = int(np.nan_to_num(numbers[offset], nan=-1)) if offset < len(numbers) else 1
                    offset += 1
                if entries < 0 or offset + entries > len(numbers):
                    raise _cut_off(element, row)
                rows[name].append(_typed(numbers[offset : offset + entries], kind, name))
                offset += entries
        _keep(element, rows)


def _typed(numbers: np.ndarray, kind: str, name: str) -> np.ndarray:
    """Numbers of a text file as the type that its header gives them."""
    typed = numbers.astype(kind)
    if not kind.startswith("f") and (typed != numbers).any():
        wrong = numbers[typed != numbers][0]
        raise InputError(f"expected {name} from {np.iinfo(kind).min} to {np.iinfo(kind).max}, found {wrong:g}")
    return typed


def _keep(element: _Element, rows: dict[str, list[np.ndarray]]) -> None:
    element.columns = {
        name: rows[name] if length else np.concatenate([np.empty(0, kind), *rows[name]])
        for name, kind, length in element.properties
    }


def _cut_off(element: _Element, found: int) -> InputError:
    return InputError(f"cut off, expected {element.count} records of '{element.name}', found {found}")


def _joined(lists: Any, dtype: type) -> np.ndarray:
    return (
        lists.reshape(-1).astype(dtype) if isinstance(lists, np.ndarray) else np.concatenate([*lists, []]).astype(dtype)
    )


def ply_bytes(mesh: Mesh, colours: np.ndarray | None, polygon_sizes: np.ndarray | None) -> bytes:
    vertex_fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    header = [f"property float {axis}" for axis in "xyz"]
    if colours is not None:
        vertex_fields += [(channel, "u1") for channel in ("red", "green", "blue")]
        header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    vertices = np.empty(len(mesh.vertices), vertex_fields)
    for axis, name in enumerate("xyz"):
        vertices[name] = mesh.vertices[:, axis]
    if colours is not None:
        for channel, name in enumerate(("red", "green", "blue")):
            vertices[name] = colours[:, channel]

    sizes = np.full(len(mesh.faces), 3) if polygon_sizes is None else polygon_sizes
    triangle, corner = polygon_corners(sizes)
    corners, uv = mesh.faces[triangle, corner], None if mesh.uv is None else mesh.uv[triangle, corner]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *header,
        f"element face {len(sizes)}",
        "property list uchar int vertex_indices",
        *(["property list uchar float texcoord"] if uv is not None else []),
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode() + vertices.tobytes() + b"".join(_face_records(sizes, corners, uv))


def _face_records(sizes: np.ndarray, corners: np.ndarray, uv: np.ndarray | None) -> Iterable[bytes]:
    """Face records; runs of faces with the same number of corners are packed at once."""
    if len(sizes) and sizes.max() > 255 // (1 if uv is None else 2):
        raise InputError(f"expected faces of at most 127 corners in a PLY file, found {sizes.max()}")
    offsets = np.cumsum(sizes) - sizes
    runs = np.flatnonzero(np.diff(sizes, prepend=-1))
    for start, stop in itertools.pairwise([*runs.tolist(), len(sizes)]):
        size, first = int(sizes[start]), int(offsets[start])
        fields = [("count", "u1"), ("corners", "<i4", (size,))]
        if uv is not None:
            fields += [("uv_count", "u1"), ("uv", "<f4", (2 * size,))]
        block = np.empty(stop - start, fields)
        span = slice(first, first + size * (stop - start))
        block["count"], block["corners"] = size, corners[span].reshape(-1, size)
        if uv is not None:
            block["uv_count"], block["uv"] = 2 * size, uv[span].reshape(-1, 2 * size)
        yield block.tobytes()
