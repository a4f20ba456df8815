"""STL, text and binary: triangles, each with its own three points.

Points that are exactly equal become one vertex; vertices are in the order in which they are first seen, for the file
has no other. Its normals and colours are not read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Integer

from capture4d.errors import InputError
from capture4d.files.text_lines import TextLines, plain_text, without_indents
from capture4d.mesh_files.polygons import MeshFile
from capture4d.types import Mesh

__all__ = ["read_stl", "welded"]

_HEAD, _RECORD = 84, np.dtype([("normal", "<f4", 3), ("points", "<f4", (3, 3)), ("attributes", "<u2")])
_WORDS = ("facet", "outer loop", "vertex", "vertex", "vertex", "endloop", "endfacet")
_FACET = np.frombuffer(b"fovvvlf", np.uint8)
"""What tells the seven lines of a triangle: their first letters, of those that begin with 'end' the fourth."""


def read_stl(path: Path) -> MeshFile:
    """Read an STL file; `capture4d.mesh_files.meshes.read_mesh` is the way in.

    Raises:
        InputError: names the line of a text; the file is named there.
    """
    data = path.read_bytes()
    points = _binary(data) if _is_binary(data) else _text(data)
    vertices, corners = welded(points.reshape(-1, 3))
    return MeshFile(Mesh(vertices, corners.reshape(-1, 3)))


def welded(
    points: Float32[np.ndarray, "points 3"],
) -> tuple[Float32[np.ndarray, "verts 3"], Integer[np.ndarray, " points"]]:
    """Points without those that are equal to an earlier one, and which of them each point is."""
    points = points + np.float32(0)  # -0 is 0
    bits = np.ascontiguousarray(points).view(np.uint32).astype(np.uint64)
    keys = (bits * np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)).sum(axis=1)
    keys ^= keys >> np.uint64(29)
    first, which = np.unique(keys, return_index=True, return_inverse=True)[1:]
    if not np.array_equal(bits[first][which.reshape(-1)], bits):  # two points with one key
        first, which = np.unique(bits, axis=0, return_index=True, return_inverse=True)[1:]
    order = np.argsort(first)
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    return points[first[order]], rank[which.reshape(-1)]


def _is_binary(data: bytes) -> bool:
    """Some binary files begin with 'solid', which should tell texts."""
    if len(data) >= _HEAD and len(data) == _HEAD + _RECORD.itemsize * int.from_bytes(data[80:84], "little"):
        return True
    head = data[:512].removeprefix(b"\xef\xbb\xbf").lstrip()
    return head[:5].lower() != b"solid" or b"\0" in head


def _binary(data: bytes) -> np.ndarray:
    if len(data) < _HEAD:
        raise InputError(f"not a readable STL file, cut off: expected {_HEAD} bytes or more, found {len(data)}")
    count, there = int.from_bytes(data[80:84], "little"), (len(data) - _HEAD) // _RECORD.itemsize
    if count != there:
        raise InputError(f"cut off or damaged, expected {count} triangles, found the bytes of {there}")
    return np.frombuffer(data, _RECORD, count, _HEAD)["points"].astype(np.float32)


def _text(data: bytes) -> np.ndarray:
    lines = TextLines(without_indents(plain_text(data)))
    first, fourth = lines.letters(0), lines.letters(3)
    ends = first == ord("e")
    kinds = np.where(ends, fourth, first)
    kept = np.flatnonzero((first > 32) & (kinds != ord("s")))
    whole = len(kept) // 7 * 7
    wrong = np.flatnonzero(kinds[kept[:whole]] != np.tile(_FACET, whole // 7))
    if len(wrong):
        row = int(kept[wrong[0]])
        wanted = _WORDS[int(wrong[0]) % 7]
        raise lines.fault(row, f"expected '{wanted}', found '{lines.line(row)[:80].decode('utf-8', 'replace')}'")
    filled = np.flatnonzero(first > 32)
    if whole < len(kept) or not (ends & (fourth == ord("s")))[filled[-1]]:
        raise InputError(f"cut off, expected 'endsolid' in the end, after {whole // 7} whole triangles")
    vertex = kept[first[kept] == ord("v")]
    wrong = vertex[(lines.letters(1)[vertex] != ord("e")) | (lines.letters(5)[vertex] != ord("x"))]
    if len(wrong):
        raise lines.fault(int(wrong[0]), "expected a line of 'vertex x y z', found another")
    return lines.needed(vertex, 3, keyword=6).columns(3).astype(np.float32)
