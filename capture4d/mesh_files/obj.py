"""Wavefront OBJ.

Read here because no packaged reader keeps the order of vertices across UV seams and names the faulty line.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np

from capture4d.errors import InputError
from capture4d.files.text_lines import Numbers, plain_text
from capture4d.mesh_files.materials import decoded
from capture4d.mesh_files.obj_lines import Tables, at_once, line_by_line
from capture4d.mesh_files.polygons import Painted, colour_bytes, polygon_corners, polygon_mesh
from capture4d.types import Mesh

__all__ = ["obj_bytes", "read_obj"]

_KEYWORDS = b"vt vn vp o g s mg mtllib usemtl maplib usemap p l cstype deg lod bevel c_interp d_interp".split()
"""What an OBJ without vertices and faces may begin with."""


def read_obj(path: Path) -> Painted:
    """Read an OBJ file; `capture4d.mesh_files.meshes.read_mesh` is the way in.

    Raises:
        InputError: names the line; the file is named there.
    """
    text = plain_text(path.read_bytes())
    tables = at_once(text)
    if tables is None:
        tables = line_by_line(text)
    if not len(tables.vertices.counts) and not len(tables.sizes):
        _require_keyword(text)
    return _assembled(tables)


def _require_keyword(text: bytes) -> None:
    """A file without a mesh is an empty one if its first line is one of an OBJ, and else something else."""
    for number, line in enumerate(text.split(b"\n"), start=1):
        words = line.split(None, 1)
        if words and not words[0].startswith(b"#"):
            if words[0].lower() not in _KEYWORDS:
                raise InputError(f"not an OBJ file, found '{decoded(line[:40])}'", line=number)
            return


def _assembled(tables: Tables) -> Painted:
    vertices, texture = tables.vertices, tables.texture
    corner_uv = None
    if (tables.corner_texture >= 0).any():
        rows = np.full((len(texture.counts) + 1, 2), np.nan, np.float32)  # the last one is that of -1
        rows[:-1, 0] = texture.flat[texture.first[:-1]]
        rows[:-1, 1] = 0
        two = texture.counts >= 2
        rows[:-1, 1][two] = texture.flat[texture.first[:-1][two] + 1]
        corner_uv = rows[tables.corner_texture]
    found, uv = polygon_mesh(vertices.columns(3), tables.corners, tables.sizes, corner_uv)
    colours, notes = _colours(vertices)
    paint = np.repeat(tables.material, tables.sizes - 2) if tables.names.materials else None
    return Painted(
        replace(found, colours=colours, notes=found.notes + notes),
        uv,
        paint,
        names=tuple(decoded(each) for each in tables.names.materials),
        libraries=tuple(decoded(each) for each in tables.names.libraries),
    )


def _colours(vertices: Numbers) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Colours that stand behind the coordinates: of six numbers the last three.

    Of seven, the fourth is a weight if it is 1 everywhere and the seventh is not, else the seventh is an opacity.
    """
    counts, first = vertices.counts, vertices.first[:-1]
    six, seven = counts == 6, counts == 7
    coloured = np.flatnonzero(six | seven)
    if not len(coloured):
        return None, ()
    behind = np.full(len(counts), 3)
    rows = first[seven]
    if len(rows) and (vertices.flat[rows + 3] == 1).all() and not (vertices.flat[rows + 6] == 1).all():
        behind[seven] = 4
    values = vertices.flat[(first + behind)[coloured, None] + np.arange(3)]
    found, notes = colour_bytes(values)
    if len(coloured) == len(counts):
        return found, notes
    colours = np.zeros((len(counts), 3), np.uint8)
    colours[coloured] = found
    absent = len(counts) - len(coloured)
    return colours, (*notes, f"{absent} of {len(counts)} vertices have no colour: black")


def obj_bytes(mesh: Mesh, colours: np.ndarray | None, polygon_sizes: np.ndarray | None) -> bytes:
    # 9 significant digits give a float32 back exactly.
    if colours is None:
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    else:
        rows = zip(mesh.vertices.tolist(), (colours / 255.0).tolist(), strict=True)
        lines = [f"v {x:.9g} {y:.9g} {z:.9g} {r:.6f} {g:.6f} {b:.6f}" for (x, y, z), (r, g, b) in rows]

    sizes = np.full(len(mesh.faces), 3) if polygon_sizes is None else polygon_sizes
    triangle, corner = polygon_corners(sizes)
    tokens = [str(index + 1) for index in mesh.faces[triangle, corner].tolist()]
    if mesh.uv is not None:
        points, texture = np.unique(mesh.uv[triangle, corner], axis=0, return_inverse=True)
        lines += [f"vt {u:.9g} {v:.9g}" for u, v in points.tolist()]
        tokens = [f"{token}/{index + 1}" for token, index in zip(tokens, texture.reshape(-1).tolist(), strict=True)]
    rest = iter(tokens)
    lines += ["f " + " ".join(itertools.islice(rest, size)) for size in sizes.tolist()]
    return ("\n".join(lines) + "\n").encode()
