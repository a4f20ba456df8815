"""Stanford PLY, text and binary.

Read here because packaged readers refuse binary files that mix triangles with other polygons, split vertices at UV
seams, or take a file that is cut off for an empty one.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from capture4d.errors import InputError
from capture4d.mesh_files.materials import decoded
from capture4d.mesh_files.ply_records import COLOURS, Element, Lists, read_binary, read_text
from capture4d.mesh_files.polygons import Painted, colour_bytes, polygon_corners, polygon_mesh
from capture4d.mesh_files.textures import of_faces_at_vertices
from capture4d.types import Mesh

__all__ = ["ply_bytes", "read_ply"]

_TYPES = {
    name: kind
    for kind, names in {
        "i1": ("char", "int8"),
        "u1": ("uchar", "uint8"),
        "i2": ("short", "int16"),
        "u2": ("ushort", "uint16"),
        "i4": ("int", "int32"),
        "u4": ("uint", "uint32"),
        "i8": ("int64",),
        "u8": ("uint64",),
        "f4": ("float", "float32"),
        "f8": ("double", "float64"),
    }.items()
    for name in names
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"(?:^|[\r\n])[ \t]*end_header[ \t]*(\r\n|\r|\n|\Z)")
_LINE = re.compile(r"\r\n|\r|\n")
_TEXTURE = re.compile(r"(?:comment|obj_info)\s+TextureFile\s+(.+)", re.IGNORECASE)

_INDICES = ("vertex_indices", "vertex_index", "vertex_indexes")
_VERTEX_UV = (
    ("s", "t"),
    ("u", "v"),
    ("texture_u", "texture_v"),
    ("texture_s", "texture_t"),
    ("texcoord_u", "texcoord_v"),
    ("tex_u", "tex_v"),
)
_FACE_UV = ("texcoord", "texcoords", "tex_coord", "tex_coords")


@dataclass(frozen=True, slots=True)
class _Header:
    elements: list[Element]
    order: str
    """Of the bytes in a number, '<' or '>'; '' for a text."""
    images: tuple[str, ...]
    lines: int
    size: int


def read_ply(path: Path) -> Painted:
    """Read a PLY file; `capture4d.mesh_files.meshes.read_mesh` is the way in.

    Raises:
        InputError: the file is damaged or cut off; the message does not name it.
    """
    data = path.read_bytes()
    header = _header(data)
    body = memoryview(data)[header.size :]
    if header.order:
        read_binary(header.elements, body, header.order)
    else:
        read_text(header.elements, bytes(body), header.lines + 1)

    vertex, faces = _element(header.elements, "vertex"), _element(header.elements, "face")
    if not {"x", "y", "z"} <= vertex.values.keys():
        found = ", ".join([*vertex.values, *vertex.lists])
        raise InputError(f"expected vertices with x, y and z, found {found or 'none'}")
    vertices = np.empty((vertex.count, 3), np.float32)
    for axis, name in enumerate("xyz"):
        vertices[:, axis] = vertex.values[name]
    corners = _corners(header.elements, faces)
    found, uv = polygon_mesh(vertices, corners.flat, corners.sizes, _uv(vertex, faces, corners))
    colours, notes = _colours(vertex)
    if colours is None:
        colours, notes = _colours(faces)
        if colours is not None:
            of_triangle = np.repeat(colours, corners.sizes - 2, axis=0).astype(np.float64)
            colours, more = of_faces_at_vertices(found.mesh, of_triangle)
            notes += more
    paint = _paint(faces, len(header.images), corners.sizes)
    return Painted(replace(found, colours=colours, notes=found.notes + notes), uv, paint, images=header.images)


def _header(data: bytes) -> _Header:
    """The elements, still empty, and what else stands in the head."""
    start = 3 * data.startswith(b"\xef\xbb\xbf")
    end = _END.search(data, start) if b"end_header" in data else None
    lines = _LINE.split(decoded(data[start : end.start() if end else 65_536]))
    if lines[0].strip().lower() != "ply":
        raise InputError(f"not a PLY file, expected it to begin with 'ply', found {data[:16]!r}")
    if end is None:
        raise InputError("cut off in the header")
    elements: dict[str, Element] = {}
    latest: Element | None = None
    order, images = None, {}
    for line in lines[1:]:
        try:
            match line.split():
                case ["format", name, *_]:
                    order = _ORDERS[name.lower()]
                case ["element", name, count]:
                    if name in elements or not re.fullmatch(r"[0-9]{1,15}", count):
                        raise ValueError(name)
                    latest = elements[name] = Element(name, int(count))
                case ["property", "list", length, kind, name] if latest is not None:
                    latest.add(name, _TYPES[kind.lower()], _TYPES[length.lower()])
                case ["property", kind, name] if latest is not None:
                    latest.add(name, _TYPES[kind.lower()], "")
                case ["format" | "element" | "property", *_]:
                    raise ValueError(line)
        except (KeyError, ValueError):
            raise InputError(f"damaged header, cannot read '{line.strip()[:80]}'") from None
        if named := _TEXTURE.fullmatch(line.strip()):
            images[named[1]] = None
    if order is None or not elements:
        raise InputError("cut off in the header")
    for element in elements.values():
        if element.count and not element.properties:
            raise InputError(f"damaged header, {element.count} records of '{element.name}' have no property")
    size = end.end()
    if end[1] == b"\r\n" and re.match(
        rb"[^\r\n]*\r[^\n]", data
    ):  # lines end with \r: the rest is the first byte behind
        size -= 1
    return _Header(list(elements.values()), order, tuple(images), len(lines) + 1, size)


def _element(elements: list[Element], name: str) -> Element:
    return next((element for element in elements if element.name == name), Element(name, 0))


def _corners(elements: list[Element], faces: Element) -> Lists:
    """The corners of all faces, or of the triangles of strips where there are no faces."""
    strips = _element(elements, "tristrips")
    for element in (faces, strips):
        for name, kind, length in element.properties:
            if name.lower() in _INDICES and not length:
                raise InputError(f"expected a list of corners in every {element.name}, found one number called {name}")
            if name.lower() in _INDICES and kind.startswith("f"):
                raise InputError(f"expected whole numbers as {name}, found a list of floats")
    none = Lists(np.zeros(0, np.int64), np.zeros(0, np.int64))
    found = next((faces.lists[name] for name in _INDICES if name in faces.lists), none)
    of_strips = next((strips.lists[name] for name in _INDICES if name in strips.lists), none)
    return found if len(found.sizes) or not len(of_strips.sizes) else _triangles(of_strips)


def _triangles(strips: Lists) -> Lists:
    """Of strips of triangles, which begin anew behind -1; without those of no area, which only lead on."""
    ends = np.cumsum(strips.sizes)
    corners = np.insert(strips.flat.astype(np.int64), ends, -1)
    begin = np.maximum.accumulate(np.where(corners < 0, np.arange(len(corners)) + 1, 0))
    a, b, c = corners[:-2], corners[1:-1], corners[2:]
    first = np.flatnonzero((np.minimum(np.minimum(a, b), c) >= 0) & (a != b) & (b != c) & (a != c))
    odd = (first - begin[first]) % 2 == 1  # every second triangle of a strip winds the other way
    faces = np.column_stack([np.where(odd, b[first], a[first]), np.where(odd, a[first], b[first]), c[first]])
    return Lists(np.full(len(faces), 3), faces.reshape(-1))


def _colours(element: Element) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Those of its records as bytes, if they have any."""
    for names in COLOURS:
        listed = next((name for name in names if name in element.lists), None)
        if listed is not None:
            raise InputError(f"expected one number called {listed} in every {element.name}, found a list")
        if all(name in element.values for name in names):
            channels = [element.values[name] for name in names]
            if len({channel.dtype for channel in channels}) == 1:
                return colour_bytes(np.stack(channels, axis=1))
            each = [colour_bytes(np.repeat(channel[:, None], 3, axis=1)) for channel in channels]
            return np.stack([found[:, 0] for found, _ in each], axis=1), each[0][1]
    return None, ()


def _uv(vertex: Element, faces: Element, corners: Lists) -> np.ndarray | None:
    """UVs at the corners: those of the faces, else of the vertices."""
    for name in _FACE_UV:
        if name in faces.lists and len(faces.lists[name].sizes) == len(corners.sizes):
            found = faces.lists[name]
            whole = found.sizes == 2 * corners.sizes
            if whole.all():
                return found.flat.reshape(-1, 2)
            if whole.any():
                uv = np.full((len(corners.flat), 2), np.nan, np.float32)
                uv[np.repeat(whole, corners.sizes)] = found.flat[np.repeat(whole, found.sizes)].reshape(-1, 2)
                return uv
    for names in _VERTEX_UV:
        if all(name in vertex.values for name in names) and vertex.count:
            table = np.stack([vertex.values[name] for name in names], axis=1).astype(np.float32)
            return table[np.clip(corners.flat, 0, vertex.count - 1)]
    return None


def _paint(faces: Element, images: int, sizes: np.ndarray) -> np.ndarray | None:
    """Which image each triangle has; None if the file does not say."""
    number = faces.values.get("texnumber")
    if number is None or not images or len(number) != len(sizes):
        return None
    number = np.where(np.isfinite(number) & (number >= 0), number, -1).astype(np.int64)
    return np.repeat(np.minimum(number, 0) if images == 1 else number, sizes - 2)


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
