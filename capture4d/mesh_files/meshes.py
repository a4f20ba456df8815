"""Mesh files: obj, ply, glb, gltf, stl and off in; obj, ply, glb and off out.

What a file says is kept: the order of its vertices and faces, unreferenced vertices, polygons. Nothing is merged, and
nothing is split at UV seams, because a template's vertex numbers mean something. Errors name the file, and in text
formats the line.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Int32, UInt8

from capture4d.errors import EmptyMeshError, InputError
from capture4d.files.atomic import write_bytes
from capture4d.files.reading import reading
from capture4d.mesh_files.glb import glb_bytes, read_coloured_glb, read_glb
from capture4d.mesh_files.materials import paint_at_vertices
from capture4d.mesh_files.obj import obj_bytes, read_obj
from capture4d.mesh_files.off import off_bytes, read_off
from capture4d.mesh_files.ply import ply_bytes, read_ply
from capture4d.mesh_files.polygons import MeshFile, Painted
from capture4d.mesh_files.stl import read_stl
from capture4d.types import Mesh

__all__ = ["READABLE", "WRITABLE", "MeshFile", "read_coloured_mesh", "read_mesh", "write_mesh"]

READABLE = (".obj", ".ply", ".glb", ".gltf", ".stl", ".off")
"""Endings of the files that are read, whatever their case."""
WRITABLE = (".obj", ".ply", ".glb", ".off")


def read_mesh(path: str | Path, *, faces_needed: bool = True) -> MeshFile:
    """Read a mesh.

    Args:
        faces_needed: whether vertices without a face, a point cloud, are a fault.
    Raises:
        InputError: the file is missing, damaged, of an unknown format, or holds no triangle or a NaN.
    """
    path = Path(path)
    with reading(path, "mesh file", absent="no such mesh file"):
        return _whole(_read(path).found, faces_needed)


def read_coloured_mesh(path: str | Path, *, faces_needed: bool = True) -> MeshFile:
    """Read a mesh with a colour per vertex: those of the file, else of its textures and materials, else None.

    An obj has them in its mtl files, each face's own; a ply as `comment TextureFile`; a glb as base colours. White at
    every vertex stands for no colour where there is a texture.

    Args:
        faces_needed: as in `read_mesh`.
    Raises:
        InputError: as `read_mesh`; or a texture that a face needs is missing or damaged.
    """
    path = Path(path)
    with reading(path, "mesh file", absent="no such mesh file"):
        if path.suffix.lower() in (".glb", ".gltf"):
            return _whole(read_coloured_glb(path), faces_needed)
        painted = _read(path)
        found = _whole(painted.found, faces_needed)
        if found.colours is None:
            colours, notes = paint_at_vertices(path, painted)
            return replace(found, colours=colours, notes=found.notes + notes)
        if not (found.colours == 255).all():
            return found
        try:
            colours, notes = paint_at_vertices(path, painted)
        except InputError as error:
            return replace(found, notes=(*found.notes, f"all vertices are white: {error}"))
        return found if colours is None else replace(found, colours=colours, notes=found.notes + notes)


def _read(path: Path) -> Painted:
    match path.suffix.lower():
        case ".obj":
            return read_obj(path)
        case ".ply":
            return read_ply(path)
        case ".glb" | ".gltf":
            return Painted(read_glb(path))
        case ".stl":
            return Painted(read_stl(path))
        case ".off":
            return Painted(read_off(path))
        case _:
            raise _unknown(path, READABLE)


def _whole(found: MeshFile, faces_needed: bool) -> MeshFile:
    if not len(found.mesh.faces) and (faces_needed or not len(found.mesh.vertices)):
        raise EmptyMeshError(f"empty mesh, found {len(found.mesh.vertices)} vertices and no faces")
    return found


def _unknown(path: Path, suffixes: tuple[str, ...]) -> InputError:
    return InputError(f"expected a mesh file ({', '.join(suffixes)}), found '{path.suffix}'", where=path)


def write_mesh(
    path: str | Path,
    mesh: Mesh,
    *,
    colours: UInt8[np.ndarray, "verts 3"] | None = None,
    polygon_sizes: Int32[np.ndarray, " polygons"] | None = None,
) -> None:
    """Write a mesh atomically, in the format its suffix names.

    OBJ and PLY keep the UVs and, given `polygon_sizes` as `read_mesh` returned them, the polygons. GLB and
    OFF have triangles only, and carry no UVs, for they could not without splitting vertices; OFF has no colours.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".obj":
            data = obj_bytes(mesh, colours, polygon_sizes)
        case ".ply":
            data = ply_bytes(mesh, colours, polygon_sizes)
        case ".glb":
            data = glb_bytes(mesh, colours)
        case ".off":
            data = off_bytes(mesh)
        case _:
            raise _unknown(path, WRITABLE)
    write_bytes(path, data)
