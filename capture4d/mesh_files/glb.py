"""Binary glTF 2.0: the nodes of its scene as one mesh.

Read here because the numbers in such a file are followed, not believed: nothing is read from outside the file's folder,
no accessor reaches beyond its bytes, and a scene is a tree.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float32, Float64, Integer, UInt8

from capture4d.errors import InputError
from capture4d.files.pictures import picture_pixels
from capture4d.files.reading import companion
from capture4d.mesh_files.polygons import MeshFile
from capture4d.mesh_files.textures import texture_colours
from capture4d.types import Mesh

__all__ = ["glb_bytes", "read_coloured_glb", "read_glb"]

_JSON, _BINARY = b"JSON", b"BIN\0"
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_KNOWN_EXTENSIONS = ("KHR_mesh_quantization", "KHR_materials_", "KHR_lights_", "KHR_texture_", "EXT_texture_")
"""Extensions, or beginnings of them, that may be required: the surface is the same without them, or they are read."""
_MOST = 100_000_000
"""Vertices, or faces, of all nodes: a small file can place a mesh many times."""


@dataclass(frozen=True, slots=True, eq=False)
class _Primitive:
    """One surface with one material, where its node puts it."""

    mesh: Mesh
    """UVs are those of TEXCOORD_0, v up."""
    colours: UInt8[np.ndarray, "verts 3"] | None
    """Of COLOR_0."""
    material: int | None
    attributes: dict[str, Any]
    """The accessors' numbers, for what is not read yet."""


def read_glb(path: Path) -> MeshFile:
    """Read a GLB file; `capture4d.mesh_files.meshes.read_mesh` is the way in.

    Raises:
        InputError: the file is damaged; the message need not name it.
    """
    return _joined(list(_primitives(_open(path))))


def read_coloured_glb(path: Path) -> MeshFile:
    """The same, and colours from the base colour textures where the vertices have none."""
    document = _open(path)
    primitives = list(_primitives(document))
    found = _joined(primitives)
    if found.colours is not None:
        return found
    textured = [_textured(document, primitive) for primitive in primitives]
    colours = [
        texture if texture is not None else _base_colour(document, primitive)
        for primitive, texture in zip(primitives, textured, strict=True)
    ]
    any_texture = any(texture is not None for texture in textured)
    return replace(found, colours=np.concatenate(colours)) if any_texture else found


def glb_bytes(mesh: Mesh, colours: np.ndarray | None) -> bytes:
    import trimesh

    model = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)
    data = trimesh.Scene(model).export(file_type="glb")
    assert isinstance(data, bytes)
    return data


def _joined(primitives: list[_Primitive]) -> MeshFile:
    if not primitives:
        return MeshFile(Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)))
    meshes = [primitive.mesh for primitive in primitives]
    firsts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + np.int32(first) for mesh, first in zip(meshes, firsts, strict=False)]
    uv = [mesh.uv for mesh in meshes if mesh.uv is not None]
    colours = [primitive.colours for primitive in primitives if primitive.colours is not None]
    mesh = Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(faces),
        np.concatenate(uv) if len(uv) == len(meshes) else None,
    )
    return MeshFile(mesh, np.concatenate(colours) if len(colours) == len(meshes) else None)


# --- the container -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Document:
    """The JSON of a file, and the bytes that it speaks of."""

    path: Path
    tree: dict[str, Any]
    binary: bytes

    def entry(self, kind: str, index: Any) -> dict[str, Any]:
        """An entry of one of the JSON's lists."""
        entries = self.tree.get(kind)
        entries = entries if isinstance(entries, list) else []
        if type(index) is not int or not 0 <= index < len(entries) or not isinstance(entries[index], dict):
            raise InputError(f"expected one of {len(entries)} {kind}, found {str(index)[:40]!r}")
        return entries[index]

    def view(self, index: Any) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and from one element to the next, 0 if they follow each other."""
        view = self.entry("bufferViews", index)
        start, length = _count(view, "byteOffset", 0), _count(view, "byteLength")
        data = self.bytes_of("buffers", view.get("buffer"))
        if start + length > len(data):
            raise InputError(f"bufferViews[{index}]: expected {start + length} bytes, found {len(data)}")
        return memoryview(data)[start : start + length], _count(view, "byteStride", 0)

    def bytes_of(self, kind: str, index: Any) -> bytes:
        """Those of a buffer or an image: inside the file, in the JSON, or in a file beside it."""
        entry = self.entry(kind, index)
        if "bufferView" in entry:
            return bytes(self.view(entry["bufferView"])[0])
        uri = entry.get("uri")
        if uri is None and kind == "buffers" and index == 0:
            return self.binary
        if not isinstance(uri, str):
            raise InputError(f"{kind}[{index}]: expected bytes, found none")
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        return companion(self.path, unquote(uri), "buffer" if kind == "buffers" else "texture").read_bytes()

    def accessor(self, index: Any) -> np.ndarray:
        """(count, width): integers or float32, and float32 between -1 and 1 where integers are normalised."""
        accessor = self.entry("accessors", index)
        where = f"accessors[{index}]"
        kind, component = accessor.get("type"), accessor.get("componentType")
        if kind not in _WIDTHS or component not in _COMPONENTS:
            raise InputError(f"{where}: expected a type of glTF, found {str(kind)[:40]!r} of {str(component)[:40]!r}")
        count, width, dtype = _count(accessor, "count"), _WIDTHS[kind], np.dtype(_COMPONENTS[component])
        sparse = accessor.get("sparse")
        if "bufferView" in accessor:
            values = self._values(where, accessor, count, width, dtype)
        elif sparse is not None and count <= _MOST:
            values = np.zeros((count, width), dtype)
        else:
            raise InputError(f"{where}: expected a buffer view, found none")
        if sparse is not None:
            self._put(where, sparse, values)
        if accessor.get("normalized") is True and dtype.kind in "iu":
            return np.maximum(values.astype(np.float32) / np.float32(np.iinfo(dtype).max), -1)
        return values

    def _values(self, where: str, place: dict[str, Any], count: int, width: int, dtype: np.dtype) -> np.ndarray:
        data, stride = self.view(place["bufferView"])
        row, offset = width * dtype.itemsize, _count(place, "byteOffset", 0)
        stride = max(stride, row)
        needed = offset + (stride * (count - 1) + row if count else 0)
        if needed > len(data):
            raise InputError(f"{where}: expected {needed} bytes, found {len(data)}")
        if not count:
            return np.zeros((0, width), dtype)
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize)).copy()

    def _put(self, where: str, sparse: dict[str, Any], values: np.ndarray) -> None:
        """Replace some of the values."""
        count, indices = _count(sparse, "count"), sparse["indices"]
        dtype = np.dtype(_COMPONENTS[indices["componentType"]])
        rows = self._values(f"{where}.sparse", indices, count, 1, dtype)[:, 0].astype(np.int64)
        if dtype.kind != "u" or (len(rows) and rows.max() >= len(values)):
            raise InputError(f"{where}.sparse: expected indices from 0 to {len(values) - 1}, found others")
        values[rows] = self._values(f"{where}.sparse", sparse["values"], count, values.shape[1], values.dtype)


def _open(path: Path) -> _Document:
    data = path.read_bytes()
    if len(data) < 20 or data[:4] != b"glTF":
        raise InputError("not a readable GLB file, cut off, or something else under this name")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise InputError(f"expected version 2 of glTF, found {version}")
    if length > len(data):
        raise InputError(f"not a readable GLB file, cut off: expected {length} bytes, found {len(data)}")
    chunks: dict[bytes, bytes] = {}
    offset = 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, offset)
        if offset + 8 + size > len(data):
            raise InputError("not a readable GLB file, cut off or damaged (a chunk reaches beyond its end)")
        chunks.setdefault(kind, data[offset + 8 : offset + 8 + size])
        offset += 8 + size
    try:
        tree = json.loads(chunks.get(_JSON, b""))
    except (ValueError, RecursionError) as error:
        raise InputError(f"not a readable GLB file, cut off or damaged (not valid JSON: {error})") from None
    if not isinstance(tree, dict):
        raise InputError(f"not a readable GLB file, expected a JSON object, found {type(tree).__name__}")
    unknown = [name for name in tree.get("extensionsRequired", []) if not str(name).startswith(_KNOWN_EXTENSIONS)]
    if unknown:
        raise InputError(
            f"expected a GLB file that can be read without extensions, found {', '.join(map(str, unknown))}"
        )
    return _Document(path, tree, chunks.get(_BINARY, b""))


def _count(entry: dict[str, Any], name: str, default: int | None = None) -> int:
    value = entry.get(name, default)
    if type(value) is not int or value < 0:
        raise InputError(f"{name}: expected a whole number, found {str(value)[:40]!r}")
    return value


# --- nodes -------------------------------------------------------------------------------------------------------


def _primitives(document: _Document) -> Iterator[_Primitive]:
    """The surfaces of the scene, node by node."""
    vertices = faces = 0
    for node, transform in _placed(document):
        if "mesh" not in node:
            continue
        for description in document.entry("meshes", node["mesh"]).get("primitives", []):
            if description.get("mode", _TRIANGLES) not in (_TRIANGLES, _STRIP, _FAN):  # points and lines
                continue
            primitive = _primitive(document, description, transform)
            vertices, faces = vertices + len(primitive.mesh.vertices), faces + len(primitive.mesh.faces)
            if max(vertices, faces) > _MOST:
                raise InputError(f"expected a scene of at most {_MOST} vertices and faces, found more")
            yield primitive


def _placed(document: _Document) -> Iterator[tuple[dict[str, Any], Float64[np.ndarray, "4 4"]]]:
    """The nodes of the scene, each once, in the world; the last child first."""
    nodes = document.tree.get("nodes", [])
    if "scenes" in document.tree:
        roots = document.entry("scenes", document.tree.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [index for index in range(len(nodes)) if index not in children]
    waiting = [(index, np.eye(4)) for index in roots]
    seen: set[int] = set()
    while waiting:
        index, parent = waiting.pop()
        node = document.entry("nodes", index)
        if index in seen:
            raise InputError(f"nodes[{index}]: expected a tree of nodes, found one that is reached twice")
        seen.add(index)
        transform = parent @ _transform(node)
        yield node, transform
        waiting += [(child, transform) for child in node.get("children", [])]


def _transform(node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """From the node to its parent: a matrix, or scale, then rotation, then translation."""
    matrix = _numbers(node, "matrix", np.eye(4).ravel()).reshape(4, 4).T
    x, y, z, w = _numbers(node, "rotation", np.array([0.0, 0.0, 0.0, 1.0]))
    norm = x * x + y * y + z * z + w * w
    scaled = 2 / norm if norm > 0 else 0.0
    turned = np.eye(4)
    turned[:3, :3] -= scaled * np.array(
        [
            [y * y + z * z, z * w - x * y, -x * z - y * w],
            [-x * y - z * w, x * x + z * z, x * w - y * z],
            [y * w - x * z, -y * z - x * w, x * x + y * y],
        ]
    )
    moved = np.eye(4)
    moved[:3, 3] = _numbers(node, "translation", np.zeros(3))
    return matrix @ moved @ turned @ np.diag([*_numbers(node, "scale", np.ones(3)), 1.0])


def _numbers(entry: dict[str, Any], name: str, default: np.ndarray) -> np.ndarray:
    found = np.asarray(entry.get(name, default))
    if found.dtype.kind not in "iuf" or found.shape != default.shape or not np.isfinite(found).all():
        raise InputError(f"{name}: expected {len(default)} finite numbers, found {str(entry.get(name))[:40]}")
    return found.astype(np.float64)


# --- primitives --------------------------------------------------------------------------------------------------


def _primitive(document: _Document, described: dict[str, Any], transform: Float64[np.ndarray, "4 4"]) -> _Primitive:
    attributes = described["attributes"]
    vertices = _attribute(document, attributes, "POSITION", (3,)).astype(np.float32)
    faces = _faces(document, described, len(vertices))
    if not np.array_equal(transform, np.eye(4)):
        vertices = (vertices.astype(np.float64) @ transform[:3, :3].T + transform[:3, 3]).astype(np.float32)
        if np.linalg.det(transform[:3, :3]) < 0:  # a mirrored surface keeps its outside
            faces = np.ascontiguousarray(faces[:, ::-1])
    uv = _coordinates(document, attributes, 0, faces) if "TEXCOORD_0" in attributes else None
    if uv is not None and not np.isfinite(uv).all():  # the surface is there all the same
        uv = None
    colours = None
    if "COLOR_0" in attributes:
        colours = _bytes_of(_attribute(document, attributes, "COLOR_0", (3, 4))[:, :3])
        if len(colours) != len(vertices):
            raise InputError(f"expected a colour for each of {len(vertices)} vertices, found {len(colours)}")
    return _Primitive(Mesh(vertices, faces, uv), colours, described.get("material"), attributes)


def _attribute(document: _Document, attributes: dict[str, Any], name: str, widths: tuple[int, ...]) -> np.ndarray:
    if name not in attributes:
        raise InputError(f"expected {name} in a primitive, found {', '.join(attributes) or 'none'}")
    found = document.accessor(attributes[name])
    if found.shape[1] not in widths:
        raise InputError(f"{name}: expected {widths[0]} numbers a vertex, found {found.shape[1]}")
    return found


def _faces(document: _Document, described: dict[str, Any], count: int) -> Integer[np.ndarray, "faces 3"]:
    corners = np.arange(count)
    if "indices" in described:
        found = document.accessor(described["indices"])
        if found.dtype.kind != "u" or found.shape[1] != 1:
            raise InputError(f"indices: expected whole numbers, found {found.dtype} of shape {found.shape}")
        corners = found[:, 0].astype(np.int64)
    if len(corners) and corners.max() >= count:
        raise InputError(f"expected vertex indices from 0 to {count - 1}, found {corners.max()}")
    match described.get("mode", _TRIANGLES):
        case 4:
            if len(corners) % 3:
                raise InputError(f"expected three corners a triangle, found {len(corners)} in all")
            faces = corners.reshape(-1, 3)
        case 5:  # every second triangle of a strip winds the other way
            faces = np.column_stack([corners[:-2], corners[1:-1], corners[2:]])
            faces[1::2] = faces[1::2, [1, 0, 2]]
        case _:
            faces = np.column_stack([np.full(max(len(corners) - 2, 0), corners[:1]), corners[1:-1], corners[2:]])
    return faces.astype(np.int32)


def _coordinates(
    document: _Document, attributes: dict[str, Any], which: int, faces: Integer[np.ndarray, "faces 3"]
) -> Float32[np.ndarray, "faces 3 2"]:
    """UVs at the corners, with v up as in the other formats."""
    found = _attribute(document, attributes, f"TEXCOORD_{which}", (2,)).astype(np.float32)
    if faces.size and faces.max() >= len(found):
        raise InputError(f"TEXCOORD_{which}: expected UVs of every vertex, found {len(found)}")
    found[:, 1] = 1 - found[:, 1]
    return found[faces]


def _bytes_of(values: np.ndarray) -> UInt8[np.ndarray, "verts 3"]:
    if values.dtype == np.uint8:
        return values
    if values.dtype.kind != "f":  # not declared as normalised, which colours are all the same
        values = values / np.iinfo(values.dtype).max
    return np.rint(np.clip(np.nan_to_num(values, nan=0, posinf=0, neginf=0), 0, 1) * 255).astype(np.uint8)


# --- materials ---------------------------------------------------------------------------------------------------


def _metal(document: _Document, primitive: _Primitive) -> dict[str, Any]:
    """The part of a primitive's material that holds its base colour."""
    if primitive.material is None:
        return {}
    return document.entry("materials", primitive.material).get("pbrMetallicRoughness", {})


def _textured(document: _Document, primitive: _Primitive) -> UInt8[np.ndarray, "verts 3"] | None:
    texture = _metal(document, primitive).get("baseColorTexture")
    if texture is None:
        return None
    mesh, which = primitive.mesh, _count(texture, "texCoord", 0)
    if which or mesh.uv is None:
        mesh = Mesh(mesh.vertices, mesh.faces, _coordinates(document, primitive.attributes, which, mesh.faces))
    image = document.entry("textures", texture.get("index")).get("source")
    return texture_colours(mesh, picture_pixels(document.bytes_of("images", image)))


def _base_colour(document: _Document, primitive: _Primitive) -> UInt8[np.ndarray, "verts 3"]:
    factor = _numbers(_metal(document, primitive), "baseColorFactor", np.ones(4))
    return np.tile(_bytes_of(factor[None, :3]), (len(primitive.mesh.vertices), 1))
