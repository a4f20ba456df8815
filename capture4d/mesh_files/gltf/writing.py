"""A mesh with colours as a binary glTF file."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from jaxtyping import UInt8

from capture4d.colours.spaces import linear_colours
from capture4d.types import Mesh

__all__ = ["glb_bytes"]

_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_ARRAY, _INDICES = 34962, 34963


def glb_bytes(mesh: Mesh, colours: UInt8[np.ndarray, "verts 3"] | None) -> bytes:
    """Vertices, triangles and colours, in their order, as one primitive.

    COLOR_0 is linear, as the standard has it, and 16 bits wide, which tell all sRGB bytes apart.
    """
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    data = bytearray()

    def add(values: np.ndarray, component: int, target: int, **more: Any) -> int:
        packed = np.ascontiguousarray(values).tobytes()
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(packed), "target": target})
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        accessor = {"bufferView": len(views) - 1, "componentType": component, "count": len(values), "type": kind}
        accessors.append(accessor | more)
        data.extend(packed + b"\0" * (-len(packed) % 4))
        return len(accessors) - 1

    tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": "capture4d"}, "scene": 0, "scenes": [{}]}
    if len(mesh.vertices):
        points = mesh.vertices.astype("<f4")
        ends = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        attributes = {"POSITION": add(points, _FLOAT, _ARRAY, **ends)}
        if colours is not None:
            light = np.rint(65535 * linear_colours(colours.astype(np.float64))).astype("<u2")
            opaque = np.full((len(light), 1), 65535, "<u2")
            attributes["COLOR_0"] = add(np.hstack([light, opaque]), _USHORT, _ARRAY, normalized=True)
        primitive: dict[str, Any] = {"attributes": attributes, "mode": 4}
        if len(mesh.faces):
            primitive["indices"] = add(mesh.faces.reshape(-1).astype("<u4"), _UINT, _INDICES)
        else:
            primitive["mode"] = 0
        tree |= {"scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}]}
        tree |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(data)}]}
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if data:
        chunks += struct.pack("<I4s", len(data), b"BIN\0") + bytes(data)
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks
