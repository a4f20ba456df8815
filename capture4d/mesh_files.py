"""Mesh files: obj, ply and glb in; obj, ply and glb out.

What a file says is kept: the order of its vertices and faces, unreferenced vertices, polygons. Nothing is merged, and
nothing is split at UV seams, because a template's vertex numbers mean something. Errors name the file, and in text
formats the line.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int32, UInt8

from capture4d.errors import InputError
from capture4d.obj_format import obj_bytes, read_obj
from capture4d.ply_format import ply_bytes, read_ply
from capture4d.polygons import MeshFile
from capture4d.types import Mesh
from capture4d.workdir import write_bytes

__all__ = ["MESH_SUFFIXES", "MeshFile", "read_mesh", "write_mesh"]

MESH_SUFFIXES = (".obj", ".ply", ".glb")


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
    read = {".obj": read_obj, ".ply": read_ply, ".glb": _read_glb}[path.suffix.lower()]
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
            data = obj_bytes(mesh, colours, polygon_sizes)
        case ".ply":
            data = ply_bytes(mesh, colours, polygon_sizes)
        case ".glb":
            data = _glb_bytes(mesh, colours)
        case suffix:
            raise InputError(f"{path}: expected a mesh file ({', '.join(MESH_SUFFIXES)}), found '{suffix}'")
    write_bytes(path, data)


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


def _one_line(error: BaseException) -> str:
    return " ".join(f"{error}".split())[:200] or type(error).__name__
