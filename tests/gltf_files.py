"""glTF files made from a few lines, as tests of several modules need them."""

import base64
import json
import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np

Layout = Literal["plain", "gaps", "sparse", "over zeros"]
LAYOUTS: tuple[Layout, ...] = ("plain", "gaps", "sparse", "over zeros")
DTYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}


class GltfFile:
    """A JSON and its bytes, filled view by view."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}],
            "accessors": [],
            "bufferViews": [],
            "buffers": [{}],
        }

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """A new entry of one of the lists; its number."""
        self.tree.setdefault(kind, []).append(entry)
        return len(self.tree[kind]) - 1

    def view(self, data: bytes, **more: Any) -> int:
        start = len(self.data)
        self.data += data + b"\0" * (-len(data) % 4)
        return self.add("bufferViews", {"buffer": 0, "byteOffset": start, "byteLength": len(data)} | more)

    def accessor(
        self, values: np.ndarray, component: int = 5126, layout: Layout = "plain", *, fractions: bool = False
    ) -> int:
        """Numbers as they are to lie in the file, which says that they are fractions of the largest if they are."""
        values = np.asarray(values).astype(DTYPES[component])
        table = values.reshape(len(values), -1)
        kind = "SCALAR" if values.ndim == 1 else {2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}[table.shape[1]]
        entry: dict[str, Any] = {"componentType": component, "count": len(values), "type": kind}
        if fractions:
            entry["normalized"] = True
        some = np.arange(1, len(table), 2)
        if layout == "gaps":
            stride = -(-table.nbytes // len(table) // 4) * 4 + 8
            rows = b"".join(row.tobytes().ljust(stride, b"\x7f") for row in table)
            entry |= {"bufferView": self.view(b"\x55" * 4 + rows, byteStride=stride), "byteOffset": 4}
        elif layout == "plain":
            entry["bufferView"] = self.view(table.tobytes())
        else:
            if layout == "over zeros":
                some = np.flatnonzero(table.any(axis=1))
            else:
                base = table.copy()
                base[some] = 1
                entry["bufferView"] = self.view(base.tobytes())
            entry["sparse"] = {
                "count": len(some),
                "indices": {"bufferView": self.view(b"\0" * 4 + some.astype("<u2").tobytes()), "byteOffset": 4,
                            "componentType": 5123},
                "values": {"bufferView": self.view(table[some].tobytes())},
            }  # fmt: skip
        return self.add("accessors", entry)

    def primitive(self, attributes: dict[str, int], mesh: int = 0, **more: Any) -> dict[str, Any]:
        """A primitive of accessors; what is not given is left out."""
        entry = {"attributes": attributes} | more
        self.tree["meshes"][mesh]["primitives"].append(entry)
        return entry

    def texture(self, picture: bytes, **transform: Any) -> dict[str, Any]:
        """A base colour texture of an image in the file."""
        image = self.add("images", {"bufferView": self.view(picture), "mimeType": "image/png"})
        found: dict[str, Any] = {"index": self.add("textures", {"source": image})}
        if transform:
            found["extensions"] = {"KHR_texture_transform": transform}
        return found

    def glb(self) -> bytes:
        self.tree["buffers"][0]["byteLength"] = len(self.data)
        return glb(self.tree, bytes(self.data))

    def save(self, path: Path, *, uri: str | None = None) -> Path:
        """As a binary file, or as JSON with its bytes inside or under a name beside it."""
        if path.suffix == ".glb":
            path.write_bytes(self.glb())
            return path
        tree = json.loads(json.dumps(self.tree))
        tree["buffers"][0] = {"byteLength": len(self.data), "uri": uri}
        if uri is None:
            body = base64.b64encode(bytes(self.data)).decode()
            tree["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{body}"
        path.write_text(json.dumps(tree))
        return path


def glb(tree: dict[str, Any], binary: bytes) -> bytes:
    """A file of a JSON and its bytes."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def grid(side: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3) of a bent sheet, faces, and UVs (V, 2) with v down; nothing of it lies outside 0 to 1."""
    across, along = (part.ravel() for part in np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side)))
    vertices = np.column_stack([across, along, across * along]).astype(np.float32)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate(
        [
            np.column_stack([corner, corner + 1, corner + side + 1]),
            np.column_stack([corner, corner + side + 1, corner + side]),
        ]
    )
    return vertices, faces, np.column_stack([across, 1 - along]).astype(np.float32)
