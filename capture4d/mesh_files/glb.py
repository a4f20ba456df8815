"""glTF 2.0 files, `.glb` and `.gltf`: the surfaces of the scene as one mesh, and a mesh as a `.glb`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from capture4d.mesh_files.gltf.base_colours import base_colours, texture_coordinates
from capture4d.mesh_files.gltf.document import Document, open_document
from capture4d.mesh_files.gltf.primitives import Primitive, primitives
from capture4d.mesh_files.gltf.writing import glb_bytes
from capture4d.mesh_files.polygons import MeshFile
from capture4d.types import Mesh

__all__ = ["glb_bytes", "read_coloured_glb", "read_glb"]


def read_glb(path: Path) -> MeshFile:
    """Read a glTF file; `capture4d.mesh_files.meshes.read_mesh` is the way in.

    UVs are those that the base colour texture is read with. Surfaces that have a texture have no colours here.

    Raises:
        InputError: the file is damaged, or holds what is not read; the message need not name it.
    """
    return _read(path, pictures=False)


def read_coloured_glb(path: Path) -> MeshFile:
    """The same, with textures in the colours."""
    return _read(path, pictures=True)


def _read(path: Path, *, pictures: bool) -> MeshFile:
    document = open_document(path)
    surfaces = list(primitives(document))
    if not surfaces:
        return MeshFile(Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)))
    firsts = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
    mesh = Mesh(
        np.concatenate([surface.vertices for surface in surfaces]),
        np.concatenate([surface.faces + np.int32(first) for surface, first in zip(surfaces, firsts, strict=False)]),
        _corner_uv(document, surfaces),
    )
    return MeshFile(mesh, base_colours(document, surfaces, pictures=pictures))


def _corner_uv(document: Document, surfaces: list[Primitive]) -> np.ndarray | None:
    """UVs at the corners of all faces, if every surface has them and all are numbers."""
    corners = []
    for surface in surfaces:
        uv = texture_coordinates(document, surface)
        if uv is None or not np.isfinite(uv := uv.astype(np.float32)).all():
            return None
        corners.append(uv[surface.faces])
    return np.concatenate(corners)
