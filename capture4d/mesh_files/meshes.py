"""Mesh files: obj, ply and glb in; obj, ply and glb out.

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
from capture4d.files.pictures import read_picture
from capture4d.files.reading import reading
from capture4d.mesh_files.glb import glb_bytes, read_coloured_glb, read_glb
from capture4d.mesh_files.obj import obj_bytes, read_obj
from capture4d.mesh_files.ply import ply_bytes, read_ply
from capture4d.mesh_files.polygons import MeshFile
from capture4d.mesh_files.textures import named_texture, texture_colours
from capture4d.types import Mesh

__all__ = ["READABLE", "WRITABLE", "MeshFile", "read_coloured_mesh", "read_mesh", "write_mesh"]

READABLE = (".obj", ".ply", ".glb", ".gltf", ".stl", ".off")
"""Endings of the files that are read, whatever their case."""
WRITABLE = (".obj", ".ply", ".glb")


def read_mesh(path: str | Path, *, faces_needed: bool = True) -> MeshFile:
    """Read a mesh.

    Args:
        faces_needed: whether vertices without a face, a point cloud, are a fault.
    Raises:
        InputError: the file is missing, damaged, of an unknown format, or holds no triangle or a NaN.
    """
    path = Path(path)
    with reading(path, "mesh file", absent="no such mesh file"):
        return _whole(_read(path), faces_needed)


def read_coloured_mesh(path: str | Path, *, faces_needed: bool = True) -> MeshFile:
    """Read a mesh with a colour per vertex: those of the file, else its texture's at the vertices, else None.

    A texture is the one image that an obj's mtl file names as map_Kd, a ply's `comment TextureFile`, or what a glb
    holds as base colours.

    Raises:
        InputError: as `read_mesh`; or the texture is missing or damaged.
    """
    path = Path(path)
    with reading(path, "mesh file", absent="no such mesh file"):
        if path.suffix.lower() in (".glb", ".gltf"):
            return _whole(read_coloured_glb(path), faces_needed)
        found = _whole(_read(path), faces_needed)
        if found.colours is not None:
            return found
        picture = named_texture(path)
        if picture is None or found.mesh.uv is None:
            return found
        return replace(found, colours=texture_colours(found.mesh, read_picture(picture)))


def _read(path: Path) -> MeshFile:
    match path.suffix.lower():
        case ".obj":
            return read_obj(path)
        case ".ply":
            return read_ply(path)
        case ".glb" | ".gltf":
            return read_glb(path)
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
            data = glb_bytes(mesh, colours)
        case _:
            raise _unknown(path, WRITABLE)
    write_bytes(path, data)
