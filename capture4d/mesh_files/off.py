"""OFF of Geomview, as text: corners, with colours of vertices (COFF) or of faces."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from capture4d.errors import InputError
from capture4d.files.text_lines import Numbers, TextLines, number, plain_text, spans, without_indents
from capture4d.mesh_files.polygons import MeshFile, colour_bytes, polygon_mesh
from capture4d.mesh_files.textures import of_faces_at_vertices
from capture4d.types import Mesh

__all__ = ["off_bytes", "read_off"]

_KEYWORD = re.compile(rb"((?:ST|C|N)*)(4)?(n)?OFF(?![A-Z])(.*)", re.IGNORECASE)
"""Geomview has the letters in the order ST, C, N, MeshLab in another one."""
_DIGITS = 12
"""Behind the point: a float32 of a micrometre comes back."""
_COMMENT = re.compile(rb"#[^\n]*")


@dataclass(frozen=True, slots=True, eq=False)
class _Head:
    """What the first lines say of those behind them."""

    vertices: int
    faces: int
    rows: np.ndarray
    """The lines behind the head that are not blank."""
    normals: bool = False
    coloured: bool = False
    textured: bool = False
    colours_first: bool = False
    """Of what stands behind the coordinates."""


def read_off(path: Path) -> MeshFile:
    """Read an OFF file; `capture4d.mesh_files.meshes.read_mesh` is the way in.

    Raises:
        InputError: names the line; the file is named there.
    """
    text = plain_text(path.read_bytes())
    lines = TextLines(without_indents(_COMMENT.sub(b"", text) if b"#" in text else text))
    head = _head(lines)
    if len(head.rows) < head.vertices + head.faces:
        raise InputError(
            f"cut off, expected lines of {head.vertices} vertices and {head.faces} faces, found {len(head.rows)}"
        )
    least = 3 + 3 * head.normals + 3 * head.coloured + 2 * head.textured
    numbers = lines.needed(head.rows[: head.vertices], least)
    rows = head.rows[head.vertices : head.vertices + head.faces]
    faces = lines.needed(rows)
    first, counts = faces.first[:-1], faces.counts
    sizes = faces.flat[first]
    wrong = np.flatnonzero(~((sizes >= 0) & (sizes < counts) & (sizes == np.rint(sizes))))
    if len(wrong):
        size = sizes[wrong[0]]
        raise lines.fault(int(rows[wrong[0]]), f"expected {size:g} corners, found {counts[wrong[0]] - 1} numbers")
    sizes = sizes.astype(np.int64)
    corners = faces.flat[spans(first + 1, sizes)]
    if not (corners == np.rint(corners)).all():
        raise InputError(f"expected whole numbers as corners, found {corners[corners != np.rint(corners)][0]:g}")
    corners = np.clip(corners, -1, 2**31).astype(np.int64)
    uv = _ends(numbers)[corners.clip(0, head.vertices - 1)] if head.textured and head.vertices else None
    found, _ = polygon_mesh(numbers.columns(3), corners, sizes, uv)
    if head.coloured:
        behind = 6 if head.normals and not (head.colours_first and _colours_before_normals(numbers)) else 3
        colours, notes = colour_bytes(numbers.flat[numbers.first[:-1, None] + behind + np.arange(3)])
    else:
        colours, notes = _of_faces(found, faces, sizes)
    return replace(found, colours=colours, notes=found.notes + notes)


def _head(lines: TextLines) -> _Head:
    rows = lines.filled
    line = lines.line(int(rows[0])).strip() if len(rows) else b""
    keyword = _KEYWORD.fullmatch(line)
    rest = (keyword[4] if keyword else line).strip()
    if keyword and rest.upper().startswith(b"BINARY"):
        raise InputError("expected an OFF file of text, found a binary one")
    if keyword and (keyword[2] or keyword[3] == b"n" or (keyword[1].endswith(b"n") and b"OFF" in line)):
        raise InputError(f"expected three dimensions, found '{line[:20].decode('utf-8', 'replace')}'")
    rows = rows[1:]
    if keyword and not rest and len(rows):
        rest, rows = lines.line(int(rows[0])), rows[1:]
    try:
        counts = [number(word) for word in rest.split()]
        if len(counts) < 2 or any(count < 0 or count != int(count) for count in counts[:2]):
            raise ValueError
    except (ValueError, OverflowError):
        wanted = "counts of vertices and faces" if keyword else "it to begin with 'OFF'"
        raise InputError(
            f"not an OFF file, expected {wanted}, found '{rest[:40].decode('utf-8', 'replace')}'"
        ) from None
    letters = re.findall("ST|C|N", keyword[1].decode().upper()) if keyword else []
    return _Head(
        int(counts[0]),
        int(counts[1]),
        rows,
        normals="N" in letters,
        coloured="C" in letters,
        textured="ST" in letters,
        colours_first=letters[:2] == ["N", "C"],
    )


def _colours_before_normals(numbers: Numbers) -> bool:
    """MeshLab writes NCOFF, and then colours before normals; others who write NCOFF mean what it says.

    The normal is the one of length 1.
    """
    one = numbers.flat[numbers.first[:-1, None] + 3 + np.arange(3)]
    return not bool((np.abs(np.linalg.norm(one, axis=1) - 1) < 0.01).mean() > 0.5)


def _ends(numbers: Numbers) -> np.ndarray:
    """(lines, 2): the last two numbers of each line."""
    return numbers.flat[numbers.first[1:, None] + np.array([-2, -1])]


def _of_faces(found: MeshFile, faces: Numbers, sizes: np.ndarray) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Colours that stand behind the corners of faces, at the vertices; None if there are none."""
    behind = faces.first[:-1] + 1 + sizes
    coloured = np.flatnonzero(faces.counts - 1 - sizes >= 3)
    if not len(coloured):
        return None, ()
    values, notes = colour_bytes(faces.flat[behind[coloured, None] + np.arange(3)])
    of_face = np.full((len(sizes), 3), np.nan)
    of_face[coloured] = values
    at_vertices, more = of_faces_at_vertices(found.mesh, np.repeat(of_face, sizes - 2, axis=0))
    return at_vertices, notes + more


def off_bytes(mesh: Mesh) -> bytes:
    """The text of a mesh; OFF as trimesh writes it has no colours."""
    import trimesh
    from trimesh.exchange.off import export_off

    return export_off(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), digits=_DIGITS).encode()
