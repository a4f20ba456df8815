"""What the browser is sent: a surface as a small glTF file, smooth, coloured or with a normal map.

Positions are whole numbers of 16 bits over the longest side of the surface (KHR_mesh_quantization, which three.js
reads): steps of 0.03 mm for a person. Normals are floats, for viser shades those of 8 bits as if each were along an
axis.

References: glTF 2.0 specification; KHR_mesh_quantization.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from capture4d.colours.spaces import linear_colours
from capture4d.geometry.mesh import vertex_normals
from capture4d.types import Mesh

__all__ = ["Dots", "Shown", "Surface", "corner_vertices", "surface_glb"]

_TYPES = {"f4": 5126, "u4": 5125, "u2": 5123, "u1": 5121}
_ARRAY, _INDICES = 34962, 34963
_LINEAR, _MIPMAPS, _CLAMP = 9729, 9987, 33071
_TABLE = np.rint(65535 * linear_colours(np.repeat(np.arange(256.0)[:, None], 3, axis=1))[:, 0]).astype("<u2")
"""glTF's COLOR_0 is linear light; 16 bits tell all sRGB bytes apart."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Something with faces."""

    mesh: Mesh
    """Metres, world. Its UVs, if it has a map, with V pointing up."""
    colours: UInt8[np.ndarray, "verts 3"] | tuple[int, int, int]
    """sRGB, of each vertex or of all."""
    normal_map: bytes | None = None
    """A PNG, +Y."""
    opacity: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Dots:
    """Something without."""

    points: Float32[np.ndarray, "points 3"]
    """Metres, world."""
    colours: UInt8[np.ndarray, "points 3"]


Shown = Surface | Dots


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """A mesh whose vertices are split along the seams of its UVs."""

    vertex: Int32[np.ndarray, " corners"]
    """The number each had before."""
    faces: Int32[np.ndarray, "faces 3"]
    uv: Float32[np.ndarray, "corners 2"]


def corner_vertices(mesh: Mesh) -> Corners:
    """The vertices of a mesh with UVs, each as often as it has UVs."""
    assert mesh.uv is not None
    keys = np.column_stack([mesh.faces.reshape(-1).astype(np.float64), mesh.uv.reshape(-1, 2)])
    rows, corners = np.unique(keys, axis=0, return_inverse=True)
    faces = corners.reshape(-1, 3).astype(np.int32)
    return Corners(rows[:, 0].astype(np.int32), faces, rows[:, 1:].astype(np.float32))


def surface_glb(surface: Surface, corners: Corners | None = None) -> bytes:
    """The surface as a binary glTF file, a node that is placed where it is.

    Args:
        corners: of its mesh, if it has a map and they are known.
    """
    mesh = surface.mesh
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    data = bytearray()

    def view(packed: bytes, **more: Any) -> int:
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(packed)} | more)
        data.extend(packed + b"\0" * (-len(packed) % 4))
        return len(views) - 1

    def add(values: np.ndarray, kind: str, **more: Any) -> int:
        """Rows of which each begins at a multiple of four bytes; components of `kind` alone count."""
        packed = np.ascontiguousarray(values)
        stride = packed.strides[0] if kind != "SCALAR" else None
        target = {"target": _INDICES} if stride is None else {"target": _ARRAY, "byteStride": stride}
        entry = {"bufferView": view(packed.tobytes(), **target), "componentType": _TYPES[packed.dtype.str[1:]]}
        accessors.append(entry | {"count": len(packed), "type": kind} | more)
        return len(accessors) - 1

    tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": "capture4d"}, "scene": 0, "scenes": [{}]}
    if len(mesh.vertices) and len(mesh.faces):
        split = corners or (corner_vertices(mesh) if surface.normal_map is not None and mesh.uv is not None else None)
        vertex = slice(None) if split is None else split.vertex
        faces = mesh.faces if split is None else split.faces
        low = mesh.vertices.min(axis=0)
        size = max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-6)
        places = np.rint((mesh.vertices - low) * (65535 / size)).astype("<u2")[vertex]
        ends = {"min": places.min(axis=0).tolist(), "max": places.max(axis=0).tolist()}
        normals = vertex_normals(mesh.vertices, mesh.faces).astype("<f4")[vertex]
        attributes = {
            "POSITION": add(_padded(places, 4), "VEC3", normalized=True, **ends),
            "NORMAL": add(normals, "VEC3"),
        }
        if not isinstance(surface.colours, tuple):
            light = np.full((len(mesh.vertices), 4), 65535, "<u2")
            light[:, :3] = _TABLE[surface.colours]
            attributes["COLOR_0"] = add(light[vertex], "VEC4", normalized=True)
        material = _material(surface)
        if split is not None and surface.normal_map is not None:
            downwards = np.column_stack([split.uv[:, 0], 1 - split.uv[:, 1]]).astype("<f4")
            attributes["TEXCOORD_0"] = add(downwards, "VEC2")
            tree |= {"images": [{"bufferView": view(surface.normal_map), "mimeType": "image/png"}]}
            tree |= {"textures": [{"source": 0, "sampler": 0}]}
            tree["samplers"] = [{"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}]
            material["normalTexture"] = {"index": 0}
        index = add(faces.reshape(-1).astype("<u2" if len(places) <= 65535 else "<u4"), "SCALAR")
        node = {"mesh": 0, "translation": low.astype(float).tolist(), "scale": [size] * 3}
        primitive = {"attributes": attributes, "indices": index, "material": 0}
        quantised = ["KHR_mesh_quantization"]
        tree |= {"extensionsUsed": quantised, "extensionsRequired": quantised, "materials": [material]}
        tree |= {"scenes": [{"nodes": [0]}], "nodes": [node], "meshes": [{"primitives": [primitive]}]}
        tree |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(data)}]}
    return _packed(tree, bytes(data))


def _padded(rows: np.ndarray, count: int) -> np.ndarray:
    """Rows of so many components, the last ones 0."""
    return np.column_stack([rows, np.zeros((len(rows), count - rows.shape[1]), rows.dtype)])


def _material(surface: Surface) -> dict[str, Any]:
    light = [1.0, 1.0, 1.0]
    if isinstance(surface.colours, tuple):
        light = linear_colours(np.array([surface.colours], float))[0].tolist()
    base = {"baseColorFactor": [*light, surface.opacity], "metallicFactor": 0.0, "roughnessFactor": 0.9}
    material: dict[str, Any] = {"doubleSided": True, "pbrMetallicRoughness": base}
    return material | ({"alphaMode": "BLEND"} if surface.opacity < 1 else {})


def _packed(tree: dict[str, Any], data: bytes) -> bytes:
    text = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if data:
        chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks
