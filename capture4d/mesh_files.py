"""Mesh files: obj, ply and glb in; obj, ply and glb out.

What a file says is kept: the order of its vertices and faces, unreferenced vertices, polygons. Nothing is merged, and
nothing is split at UV seams, because a template's vertex numbers mean something. Errors name the file, and in text
formats the line.

OBJ is read here because no packaged reader keeps vertex order across UV seams and names the faulty line; PLY and GLB
are trimesh's.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int32, Integer, UInt8

from capture4d.errors import InputError
from capture4d.types import Mesh
from capture4d.workdir import write_bytes

__all__ = ["MESH_SUFFIXES", "MeshFile", "read_mesh", "write_mesh"]

MESH_SUFFIXES = (".obj", ".ply", ".glb")


@dataclass(frozen=True, slots=True, eq=False)
class MeshFile:
    """A mesh as its file has it."""

    mesh: Mesh
    """Polygons are cut into fans of triangles around their first corner, in file order."""
    colours: UInt8[np.ndarray, "verts 3"] | None = None
    """sRGB per vertex."""
    polygon_sizes: Int32[np.ndarray, " polygons"] | None = None
    """Corners of each face of the file; None if all are triangles."""


def read_mesh(path: str | Path) -> MeshFile:
    """Read a mesh.

    Raises:
        InputError: the file is missing, damaged, of an unknown format, or holds no triangle or a NaN.
    """
    path = Path(path)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"{path}: expected a mesh file ({', '.join(MESH_SUFFIXES)}), found '{path.suffix}'")
    if not path.is_file():
        raise InputError(f"{path}: no such mesh file")
    read = {".obj": _read_obj, ".ply": _read_ply, ".glb": _read_glb}[path.suffix.lower()]
    try:
        found = read(path)
    except InputError as error:
        raise InputError(error if str(error).startswith(str(path)) else f"{path}: {error}") from None
    if not len(found.mesh.faces):
        raise InputError(f"{path}: empty mesh, found {len(found.mesh.vertices)} vertices and no faces")
    return found


def write_mesh(
    path: str | Path,
    mesh: Mesh,
    *,
    colours: UInt8[np.ndarray, "verts 3"] | None = None,
    polygon_sizes: Int32[np.ndarray, " polygons"] | None = None,
) -> None:
    """Write a mesh atomically, in the format its suffix names.

    OBJ and PLY keep the UVs and, given `polygon_sizes` as `read_mesh` returned them, the polygons. GLB has triangles
    only, and carries no UVs, for it could not without splitting vertices.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".obj":
            data = _obj_bytes(mesh, colours, polygon_sizes)
        case ".ply":
            data = _ply_bytes(mesh, colours, polygon_sizes)
        case ".glb":
            data = _glb_bytes(mesh, colours)
        case suffix:
            raise InputError(f"{path}: expected a mesh file ({', '.join(MESH_SUFFIXES)}), found '{suffix}'")
    write_bytes(path, data)


def _fan_corners(sizes: np.ndarray) -> Integer[np.ndarray, "tris 3"]:
    """Cut polygons into fans: for each triangle, the positions of its corners in the list of all polygon corners."""
    first = np.cumsum(sizes) - sizes
    triangles = sizes - 2
    step = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    start = np.repeat(first, triangles)
    return np.column_stack([start, start + step + 1, start + step + 2])


def _polygon_corners(sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of the fan: for each polygon corner, the triangle and the corner of it that hold its vertex."""
    polygon = np.repeat(np.arange(len(sizes)), sizes)
    corner = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    first_triangle = (np.cumsum(sizes - 2) - (sizes - 2))[polygon]
    return first_triangle + np.maximum(corner - 2, 0), np.minimum(corner, 2)


def _polygon_mesh(
    vertices: np.ndarray, corners: np.ndarray, sizes: np.ndarray, corner_uv: np.ndarray | None
) -> tuple[Mesh, np.ndarray | None]:
    """Mesh and polygon sizes from the flat list of all polygon corners."""
    fan = _fan_corners(sizes)
    uv = None if corner_uv is None else corner_uv[fan].astype(np.float32)
    if corners.size and (corners.min() < 0 or corners.max() >= len(vertices)):
        raise InputError(f"expected vertex indices from 0 to {len(vertices) - 1}, found {corners.min()}..{corners.max()}")
    mesh = Mesh(vertices.astype(np.float32), corners[fan].astype(np.int32), uv)
    return mesh, None if (sizes == 3).all() else sizes.astype(np.int32)


# --- OBJ ---------------------------------------------------------------------------------------------------------


def _read_obj(path: Path) -> MeshFile:
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
                    vertices.append(_obj_numbers(fields[1:7], at_least=3))
                elif fields[0] == "vt":
                    texture.append(_obj_numbers(fields[1:3], at_least=2))
                elif fields[0] == "f":
                    if len(fields) < 4:
                        raise InputError(f"expected a face of at least 3 corners, found {len(fields) - 1}")
                    sizes.append(len(fields) - 1)
                    face_lines.append(number)
                    for field in fields[1:]:
                        vertex, _, rest = field.partition("/")
                        uv = rest.partition("/")[0]
                        corners.append(_obj_index(vertex, len(vertices)))
                        corner_texture.append(_obj_index(uv, len(texture)) if uv else -1)
            except InputError as error:
                raise InputError(f"{path}:{number}: {error}") from None

    size_of = np.array(sizes, np.int64)
    corner_of = np.array(corners, np.int64)
    texture_of = np.array(corner_texture, np.int64)
    for name, indices, count in (("vertex", corner_of, len(vertices)), ("texture coordinate", texture_of, len(texture))):
        beyond = np.flatnonzero(indices >= count)
        if len(beyond):
            line = face_lines[int(np.searchsorted(np.cumsum(size_of), beyond[0], side="right"))]
            raise InputError(f"{path}:{line}: {name} {indices[beyond[0]] + 1} does not exist, the file has {count}")

    coloured = bool(vertices) and all(len(vertex) == 6 for vertex in vertices)
    table = np.array([vertex if coloured else vertex[:3] for vertex in vertices], np.float64).reshape(len(vertices), -1)
    has_uv = len(texture_of) and (texture_of >= 0).all()
    corner_uv = np.array(texture, np.float64)[texture_of] if has_uv else None
    mesh, polygon_sizes = _polygon_mesh(table[:, :3].reshape(-1, 3), corner_of, size_of, corner_uv)
    return MeshFile(mesh, _colour_bytes(table[:, 3:]) if coloured else None, polygon_sizes)


def _obj_numbers(fields: list[str], *, at_least: int) -> list[float]:
    try:
        numbers = [float(field) for field in fields]
    except ValueError:
        raise InputError(f"expected numbers, found '{' '.join(fields)}'") from None
    if len(numbers) < at_least:
        raise InputError(f"expected at least {at_least} numbers, found {len(numbers)}")
    if not np.isfinite(numbers).all():
        raise InputError(f"expected finite numbers, found '{' '.join(fields)}'")
    return numbers


def _obj_index(text: str, count: int) -> int:
    """OBJ counts from 1, or backwards from the latest entry with -1."""
    try:
        index = int(text)
    except ValueError:
        raise InputError(f"expected an index, found '{text}'") from None
    if index == 0 or index < -count:
        raise InputError(f"expected an index from 1, or from -1 down to -{count}, found {index}")
    return index - 1 if index > 0 else count + index


def _obj_bytes(mesh: Mesh, colours: np.ndarray | None, polygon_sizes: np.ndarray | None) -> bytes:
    # 9 significant digits give a float32 back exactly.
    if colours is None:
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    else:
        rows = zip(mesh.vertices.tolist(), (colours / 255.0).tolist(), strict=True)
        lines = [f"v {x:.9g} {y:.9g} {z:.9g} {r:.6f} {g:.6f} {b:.6f}" for (x, y, z), (r, g, b) in rows]

    sizes = np.full(len(mesh.faces), 3) if polygon_sizes is None else polygon_sizes
    triangle, corner = _polygon_corners(sizes)
    tokens = [str(index + 1) for index in mesh.faces[triangle, corner].tolist()]
    if mesh.uv is not None:
        points, texture = np.unique(mesh.uv[triangle, corner], axis=0, return_inverse=True)
        lines += [f"vt {u:.9g} {v:.9g}" for u, v in points.tolist()]
        tokens = [f"{token}/{index + 1}" for token, index in zip(tokens, texture.reshape(-1).tolist(), strict=True)]
    rest = iter(tokens)
    lines += ["f " + " ".join(itertools.islice(rest, size)) for size in sizes.tolist()]
    return ("\n".join(lines) + "\n").encode()


# --- PLY ---------------------------------------------------------------------------------------------------------


def _read_ply(path: Path) -> MeshFile:
    from trimesh.exchange.ply import load_ply

    with path.open("rb") as file:
        try:
            elements = load_ply(file, fix_texture=False, skip_materials=True)["metadata"]["_ply_raw"]
        except Exception as error:  # whatever trimesh meets in a damaged file
            raise InputError(f"{path}: not a readable PLY file, cut off or damaged ({_one_line(error)})") from None

    vertex = _ply_columns(path, elements, "vertex")
    face = _ply_columns(path, elements, "face")
    if not {"x", "y", "z"} <= vertex.keys():
        raise InputError(f"{path}: expected vertices with x, y and z, found {', '.join(vertex) or 'none'}")
    vertices = np.column_stack([vertex[axis].astype(np.float64) for axis in "xyz"])
    colours = None
    if {"red", "green", "blue"} <= vertex.keys():
        colours = _colour_bytes(np.column_stack([vertex[channel] for channel in ("red", "green", "blue")]))

    rows = next((face[name] for name in ("vertex_indices", "vertex_index") if name in face), [])
    sizes = np.array([len(row) for row in rows], np.int64)
    if len(sizes) and sizes.min() < 3:
        raise InputError(f"{path}: face {int(sizes.argmin())}: expected at least 3 corners, found {sizes.min()}")
    corners = _flat(rows, np.int64)

    corner_uv = None
    if "texcoord" in face:
        flat = _flat(face["texcoord"], np.float64)
        corner_uv = flat.reshape(-1, 2) if flat.size == 2 * corners.size else None
    else:
        for u, v in (("s", "t"), ("u", "v"), ("texture_u", "texture_v")):
            if {u, v} <= vertex.keys() and (not corners.size or 0 <= corners.min() <= corners.max() < len(vertices)):
                corner_uv = np.column_stack([vertex[u], vertex[v]])[corners]
    mesh, polygon_sizes = _polygon_mesh(vertices, corners, sizes, corner_uv)
    return MeshFile(mesh, colours, polygon_sizes)


def _ply_columns(path: Path, elements: Any, name: str) -> dict[str, Any]:
    """Property name -> one value, or one row of a list property, per element; complete or an error."""
    element = elements.get(name, {"length": 0})
    data = element.get("data")
    if not element["length"]:
        return {}
    columns: dict[str, Any] = {}
    for key in element["properties"]:
        try:
            column = data[key]
        except (TypeError, KeyError, ValueError):
            raise InputError(f"{path}: cut off or damaged, no '{key}' of '{name}'") from None
        if column.dtype.names:  # a list property of a binary file: (length, entries)
            if (column["f0"] != column["f0"][0]).any():
                raise InputError(f"{path}: damaged, '{key}' of '{name}' has entries of unexpected length")
            column = column["f1"]
        if len(column) != element["length"]:
            raise InputError(f"{path}: cut off, expected {element['length']} of '{name}', found {len(column)}")
        columns[key] = column[:, 0] if column.ndim == 2 and "(" not in str(element["properties"][key]) and column.shape[1] == 1 else column
    return columns


def _flat(rows: Any, dtype: type) -> np.ndarray:
    if isinstance(rows, np.ndarray) and rows.dtype != object:
        return rows.reshape(-1).astype(dtype)
    return np.fromiter(itertools.chain.from_iterable(rows), dtype)


def _ply_bytes(mesh: Mesh, colours: np.ndarray | None, polygon_sizes: np.ndarray | None) -> bytes:
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
    triangle, corner = _polygon_corners(sizes)
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
    return ("\n".join(header) + "\n").encode() + vertices.tobytes() + b"".join(_ply_faces(sizes, corners, uv))


def _ply_faces(sizes: np.ndarray, corners: np.ndarray, uv: np.ndarray | None) -> Iterable[bytes]:
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


# --- GLB ---------------------------------------------------------------------------------------------------------


def _read_glb(path: Path) -> MeshFile:
    import trimesh

    try:
        scene = trimesh.load_scene(path, file_type="glb", process=False, skip_materials=True)
        mesh: Any = scene.to_mesh() if scene.geometry else trimesh.Trimesh()
    except Exception as error:  # whatever trimesh meets in a damaged file
        raise InputError(f"{path}: not a readable GLB file, cut off or damaged ({_one_line(error)})") from None
    visual = mesh.visual
    colours = visual.vertex_colors[:, :3].astype(np.uint8) if visual.kind == "vertex" else None
    coordinates = getattr(visual, "uv", None)
    faces = np.asarray(mesh.faces, np.int32).reshape(-1, 3)
    uv = None if coordinates is None else np.asarray(coordinates, np.float32)[faces]
    return MeshFile(Mesh(np.asarray(mesh.vertices, np.float32).reshape(-1, 3), faces, uv), colours)


def _glb_bytes(mesh: Mesh, colours: np.ndarray | None) -> bytes:
    import trimesh

    model = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)
    data = trimesh.Scene(model).export(file_type="glb")
    assert isinstance(data, bytes)
    return data


# --- shared ------------------------------------------------------------------------------------------------------


def _colour_bytes(values: np.ndarray) -> UInt8[np.ndarray, "verts 3"]:
    """Files hold colours as bytes, or as fractions of one."""
    if values.dtype == np.uint8:
        return values
    scale = 255 if values.size and values.max() <= 1 else 1
    return np.clip(np.rint(values * scale), 0, 255).astype(np.uint8)


def _one_line(error: BaseException) -> str:
    return " ".join(f"{error}".split())[:200] or type(error).__name__
