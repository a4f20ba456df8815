"""Mesh files: obj, ply and glb in; obj, ply and glb out.

What a file says is kept: the order of its vertices and faces, unreferenced vertices, polygons. Nothing is merged, and
nothing is split at UV seams, because a template's vertex numbers mean something. Errors name the file, and in text
formats the line.
"""

from __future__ import annotations

import re
import struct
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int32, UInt8

from capture4d.errors import EmptyMeshError, InputError
from capture4d.files.atomic import write_bytes
from capture4d.files.obj import obj_bytes, read_obj
from capture4d.files.ply import ply_bytes, read_ply
from capture4d.files.polygons import MeshFile
from capture4d.files.textures import texture_colours
from capture4d.types import Mesh

__all__ = ["MESH_SUFFIXES", "MeshFile", "read_coloured_mesh", "read_mesh", "write_mesh"]

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
        raise error if str(error).startswith(str(path)) else type(error)(f"{path}: {error}") from None
    if not len(found.mesh.faces):
        raise EmptyMeshError(f"{path}: empty mesh, found {len(found.mesh.vertices)} vertices and no faces")
    return found


def read_coloured_mesh(path: str | Path) -> MeshFile:
    """Read a mesh with a colour per vertex: those of the file, else its texture's at the vertices, else None.

    A texture is the one image that an obj's mtl file names as map_Kd, a ply's `comment TextureFile`, or a glb holds as
    base colour.

    Raises:
        InputError: as `read_mesh`; or the texture is missing or damaged.
    """
    path = Path(path)
    found = read_mesh(path)
    if found.colours is not None:
        return found
    if path.suffix.lower() != ".glb":
        picture = _texture_file(path)
        if picture is None or found.mesh.uv is None:
            return found
        return replace(found, colours=texture_colours(found.mesh, _picture_file(picture, path)))
    try:
        mesh, pixels = _textured_glb(path)
    except Exception as error:  # whatever trimesh and Pillow meet in a damaged file
        raise InputError(f"{path}: not a readable texture, damaged or too large ({_one_line(error)})") from None
    if pixels is None or mesh.uv is None:
        return found
    return replace(found, mesh=mesh, colours=texture_colours(mesh, pixels))


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


def _textured_glb(path: Path) -> tuple[Mesh, UInt8[np.ndarray, "rows columns 3"] | None]:
    """The mesh with its UVs, and the pixels of its base colour or None."""
    import trimesh

    scene = trimesh.load_scene(path, file_type="glb", process=False)
    model: Any = scene.to_mesh()
    material = getattr(model.visual, "material", None)
    uv = getattr(model.visual, "uv", None)
    faces = np.asarray(model.faces, np.int32).reshape(-1, 3)
    corners = None if uv is None else np.asarray(uv, np.float32)[faces]
    mesh = Mesh(np.asarray(model.vertices, np.float32).reshape(-1, 3), faces, corners)
    picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if picture is None and _names_a_texture(path):  # trimesh passes over what Pillow cannot open
        raise InputError("the base colour cannot be opened")
    return mesh, None if picture is None else _pixels(picture)


def _names_a_texture(path: Path) -> bool:
    """By the JSON at the head of a glb."""
    with path.open("rb") as file:
        (length,) = struct.unpack("<12xI", file.read(16))
        return b'"baseColorTexture"' in file.read(length + 4)


def _texture_file(path: Path) -> Path | None:
    """The one image that the head of an obj (by its mtl) or a ply names."""
    with path.open("rb") as file:
        head = file.read(65_536).decode("utf-8", errors="replace")
    if path.suffix.lower() == ".ply":
        names = re.findall(r"^comment TextureFile (.+?)\s*$", head.partition("end_header")[0], re.M)
    else:
        names = []
        for library in re.findall(r"^mtllib (.+?)\s*$", head, re.M):
            materials = path.parent / library
            if not materials.is_file():
                raise InputError(f"{materials}: no such file, the materials of {path.name}")
            lines = materials.read_text(encoding="utf-8", errors="replace")
            names += re.findall(r"^\s*map_Kd (?:-\S+ \S+ )*(.+?)\s*$", lines, re.M)
    textures = sorted({path.parent / name for name in names})
    if len(textures) > 1:
        raise InputError(f"{path}: expected one texture, found {', '.join(texture.name for texture in textures)}")
    return textures[0] if textures else None


def _picture_file(picture: Path, path: Path) -> UInt8[np.ndarray, "rows columns 3"]:
    from PIL import Image

    if not picture.is_file():
        raise InputError(f"{picture}: no such file, the texture of {path.name}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # it stops at twice that by itself
            with Image.open(picture) as image:
                return _pixels(image)
    except Exception as error:  # whatever Pillow's readers meet in a damaged file
        raise InputError(f"{picture}: not a readable image, damaged or too large ({_one_line(error)})") from None


def _pixels(image: Any) -> UInt8[np.ndarray, "rows columns 3"]:
    return np.array(image.convert("RGB"))


def _glb_bytes(mesh: Mesh, colours: np.ndarray | None) -> bytes:
    import trimesh

    model = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)
    data = trimesh.Scene(model).export(file_type="glb")
    assert isinstance(data, bytes)
    return data


def _one_line(error: BaseException) -> str:
    return " ".join(f"{error}".split())[:200] or type(error).__name__
