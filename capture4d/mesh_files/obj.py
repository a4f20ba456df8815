"""Wavefront OBJ.

Read here because no packaged reader keeps the order of vertices across UV seams and names the faulty line.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from capture4d.errors import InputError, NotFiniteError
from capture4d.mesh_files.polygons import MeshFile, colour_bytes, polygon_corners, polygon_mesh
from capture4d.types import Mesh

__all__ = ["obj_bytes", "read_obj"]

_MOST = 2**31 - 1
"""What our own indices can count."""


def read_obj(path: Path) -> MeshFile:
    """Read an OBJ file; `capture4d.mesh_files.meshes.read_mesh` is the way in.

    Raises:
        InputError: names the line; the file is named there.
    """
    vertices: list[list[float]] = []
    texture: list[list[float]] = []
    corners: list[int] = []
    corner_texture: list[int] = []
    sizes: list[int] = []
    face_lines: list[int] = []

    with path.open(encoding="utf-8", errors="replace") as lines:
        for number, line in enumerate(lines, start=1):
            fields = line.split()
            if not fields:
                continue
            try:
                if fields[0] == "v":
                    vertices.append(_numbers(fields[1:7], at_least=3))
                elif fields[0] == "vt":
                    texture.append(_numbers(fields[1:3], at_least=2))
                elif fields[0] == "f":
                    if len(fields) < 4:
                        raise InputError(f"expected a face of at least 3 corners, found {len(fields) - 1}")
                    sizes.append(len(fields) - 1)
                    face_lines.append(number)
                    for field in fields[1:]:
                        vertex, _, rest = field.partition("/")
                        uv = rest.partition("/")[0]
                        corners.append(_index(vertex, len(vertices)))
                        corner_texture.append(_index(uv, len(texture)) if uv else -1)
            except InputError as error:
                raise type(error)(error.reason, line=number) from None

    size_of = np.array(sizes, np.int64)
    corner_of = np.array(corners, np.int64)
    texture_of = np.array(corner_texture, np.int64)
    for name, indices, count in (
        ("vertex", corner_of, len(vertices)),
        ("texture coordinate", texture_of, len(texture)),
    ):
        beyond = np.flatnonzero(indices >= count)
        if len(beyond):
            line = face_lines[int(np.searchsorted(np.cumsum(size_of), beyond[0], side="right"))]
            raise InputError(f"{name} {indices[beyond[0]] + 1} does not exist, the file has {count}", line=line)

    coloured = bool(vertices) and all(len(vertex) == 6 for vertex in vertices)
    table = np.array([vertex if coloured else vertex[:3] for vertex in vertices], np.float64)
    table = table.reshape(-1, 6 if coloured else 3)
    has_uv = len(texture_of) and (texture_of >= 0).all()
    corner_uv = np.array(texture, np.float64)[texture_of] if has_uv else None
    mesh, polygon_sizes = polygon_mesh(table[:, :3], corner_of, size_of, corner_uv)
    return MeshFile(mesh, colour_bytes(table[:, 3:]) if coloured else None, polygon_sizes)


def _numbers(fields: list[str], *, at_least: int) -> list[float]:
    try:
        numbers = [float(field) for field in fields]
    except ValueError:
        raise InputError(f"expected numbers, found '{' '.join(fields)[:80]}'") from None
    if len(numbers) < at_least:
        raise InputError(f"expected at least {at_least} numbers, found {len(numbers)}")
    if not np.isfinite(numbers).all():
        raise NotFiniteError(f"expected finite numbers, found '{' '.join(fields)[:80]}'")
    return numbers


def _index(text: str, count: int) -> int:
    """OBJ counts from 1, or backwards from the latest entry with -1."""
    try:
        index = int(text)
    except ValueError:
        raise InputError(f"expected an index, found '{text[:80]}'") from None
    if abs(index) > _MOST:
        raise InputError(f"expected an index of at most {_MOST}, found '{text[:80]}'")
    if index == 0 or index < -count:
        raise InputError(f"expected an index from 1, or from -1 down to -{count}, found {index}")
    return index - 1 if index > 0 else count + index


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
