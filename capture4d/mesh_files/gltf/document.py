"""A glTF file: its JSON, and the bytes that the JSON speaks of, wherever they are.

The numbers in such a file are followed, not believed: nothing is read from outside the file's folder, and no view
reaches beyond its bytes.
"""

from __future__ import annotations

import base64
import json
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from capture4d.errors import InputError
from capture4d.mesh_files.gltf.compression import MESHOPT, meshopt_bytes
from capture4d.mesh_files.gltf.entries import count_of, extension
from capture4d.mesh_files.materials import companion_anyhow

__all__ = ["MOST", "Document", "open_document"]

MOST = 100_000_000
"""Vertices, or faces, of a scene: a small file can place a mesh many times."""
_ZEROS_A_BYTE, _ZEROS_ALWAYS = 64, 65_536
"""Rows that an accessor without bytes may have: for each byte of the file and its buffers, or in any file."""
_JSON, _BINARY = b"JSON", b"BIN\0"
_READ = {
    "EXT_meshopt_compression",
    "EXT_texture_avif",
    "EXT_texture_webp",
    "KHR_animation_pointer",
    "KHR_draco_mesh_compression",
    "KHR_mesh_quantization",
    "KHR_meshopt_compression",
    "KHR_node_visibility",
    "KHR_texture_basisu",
    "KHR_texture_transform",
    "KHR_xmp_json_ld",
}
"""Extensions that may be required: they are read, refused where they are met, or mean nothing to a surface."""
_SURFACE_IS_THE_SAME = ("KHR_materials_", "KHR_lights_", "EXT_lights_")
"""What others begin with that may be: only how the surface is lit depends on them."""


@dataclass(frozen=True, slots=True, eq=False)
class Document:
    """The JSON of a file, and what is inside the file behind it."""

    path: Path
    tree: dict[str, Any]
    binary: bytes
    size: int
    """Bytes of the file itself."""
    kept: dict[tuple[str, Any], Any] = field(default_factory=dict)
    """What has been read or decompressed, that nothing is twice."""

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
        for name in MESHOPT:
            if (packed := extension(view, name)) is not None:
                if ("view", index) not in self.kept:
                    where = f"bufferViews[{index}]"
                    self.kept["view", index] = meshopt_bytes(name, where, packed, self._part(where, packed))
                return memoryview(self.kept["view", index]), count_of(packed, "byteStride")
        return self._part(f"bufferViews[{index}]", view), count_of(view, "byteStride", 0)

    def _part(self, where: str, view: dict[str, Any]) -> memoryview:
        start, length = count_of(view, "byteOffset", 0), count_of(view, "byteLength")
        data = self.bytes_of("buffers", view.get("buffer"))
        if start + length > len(data):
            raise InputError(f"{where}: expected {start + length} bytes, found {len(data)}")
        return memoryview(data)[start : start + length]

    def bytes_of(self, kind: str, index: Any) -> bytes:
        """Those of a buffer or an image: inside the file, in the JSON, or in a file beside it."""
        entry = self.entry(kind, index)
        if (kind, index) not in self.kept:
            self.kept[kind, index] = self._bytes_of(kind, index, entry)
        return self.kept[kind, index]

    def _bytes_of(self, kind: str, index: int, entry: dict[str, Any]) -> bytes:
        if kind == "images" and "bufferView" in entry:
            return bytes(self.view(entry["bufferView"])[0])
        uri = entry.get("uri")
        if uri is None and kind == "buffers" and index == 0 and self.binary:
            return self.binary
        if not isinstance(uri, str):
            raise InputError(f"{kind}[{index}]: expected bytes, found none")
        if uri[:5].lower() == "data:":
            head, comma, body = uri[5:].partition(",")
            if not comma:
                raise InputError(f"{kind}[{index}]: expected data after a comma, found {uri[:40]!r}")
            data = unquote_to_bytes(body)
            return _base64(f"{kind}[{index}]", data) if head.lower().rstrip().endswith(";base64") else data
        return self.beside(kind, uri).read_bytes()

    def beside(self, kind: str, uri: str) -> Path:
        """The file that a buffer or an image is in."""
        if re.match("(?!file:)[a-z][a-z0-9+.-]+://", uri, re.IGNORECASE):
            raise InputError(f"expected the name of a file, found '{uri[:80]}'")
        plain = re.sub("^file://+", "/", uri, flags=re.IGNORECASE)
        faults: list[InputError] = []
        for name in dict.fromkeys((unquote(plain), plain)):  # some programs write names as they are
            try:
                return companion_anyhow(self.path, name, "buffer" if kind == "buffers" else "texture")
            except InputError as fault:
                faults.append(fault)
        raise faults[0]

    def require_buffers_inside(self) -> None:
        """Refuse a file that names bytes which are not there, or elsewhere on this machine, even if it uses none."""
        buffers = self.tree.get("buffers")
        for each in buffers if isinstance(buffers, list) else []:
            uri = each.get("uri") if isinstance(each, dict) else None
            if isinstance(uri, str) and uri[:5].lower() != "data:":
                self.beside("buffers", uri)

    def zeros(self, where: str, count: int, width: int, dtype: np.dtype) -> np.ndarray:
        """Rows of an accessor that has no bytes of its own."""
        buffers = self.tree.get("buffers")
        elsewhere = [index for index, each in enumerate(buffers or []) if isinstance(each, dict) and "uri" in each]
        size = self.size + sum(len(self.bytes_of("buffers", index)) for index in elsewhere)
        most = min(MOST, max(_ZEROS_ALWAYS, _ZEROS_A_BYTE * size))
        if count > most:
            raise InputError(f"{where}: expected a buffer view, found none for {count} elements")
        return np.zeros((count, width), dtype)


def _base64(where: str, text: bytes) -> bytes:
    """Bytes of base64 in either alphabet, with or without its end."""
    text = re.sub(rb"\s+", b"", text).translate(bytes.maketrans(b"-_", b"+/")).rstrip(b"=")
    try:
        return base64.b64decode(text + b"=" * (-len(text) % 4), validate=True)
    except ValueError as error:
        raise InputError(f"{where}: expected base64, found something else ({error})") from None


def open_document(path: Path) -> Document:
    """A file of either kind, told by its first bytes.

    Raises:
        InputError: it is cut off, of another version, or needs what is not read.
    """
    data = path.read_bytes()
    text, binary = _chunks(data) if data[:4] == b"glTF" else (data, b"")
    if data[:4] != b"glTF" and data.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] != b"{":
        raise InputError(f"not a readable GLB file, cut off, or something else: begins with {data[:16]!r}")
    try:
        tree = json.loads(text.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"not a readable glTF file, cut off or damaged (not valid JSON: {error})") from None
    if not isinstance(tree, dict):
        raise InputError(f"not a readable GLB file, expected a JSON object, found {type(tree).__name__}")
    _require_readable(tree)
    document = Document(path, tree, binary, len(data))
    document.require_buffers_inside()
    return document


def _chunks(data: bytes) -> tuple[bytes, bytes]:
    """The JSON and the bytes of a binary file."""
    if len(data) < 20:
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
    return chunks.get(_JSON, b"").rstrip(b"\0"), chunks.get(_BINARY, b"")


def _require_readable(tree: dict[str, Any]) -> None:
    asset = tree.get("asset")
    asset = asset if isinstance(asset, dict) else {}
    version = str(asset.get("minVersion", asset.get("version", "2.0")))
    if not re.fullmatch(r"2(\.0)?", version) and ("minVersion" in asset or not version.startswith("2.")):
        raise InputError(f"expected version 2.0 of glTF, found {version[:40]!r}")
    required = tree.get("extensionsRequired") or []
    if not isinstance(required, list):
        raise InputError(f"extensionsRequired: expected a list, found {str(required)[:40]!r}")
    unknown = [name for name in map(str, required) if name not in _READ and not name.startswith(_SURFACE_IS_THE_SAME)]
    if unknown:
        raise InputError(f"expected a glTF file that can be read without extensions, found {', '.join(unknown)}")
