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
    uv, notes = _corner_uv(document, surfaces)
    mesh = Mesh(
        np.concatenate([surface.vertices for surface in surfaces]),
        np.concatenate([surface.faces + np.int32(first) for surface, first in zip(surfaces, firsts, strict=False)]),
        uv,
    )
    return MeshFile(mesh, base_colours(document, surfaces, pictures=pictures), notes=notes)


def _corner_uv(document: Document, surfaces: list[Primitive]) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """UVs at the corners of all faces, if every surface has them and all are numbers; a note if some are none."""
    found = [texture_coordinates(document, surface) for surface in surfaces]
    there = [
        uv.astype(np.float32)[surface.faces] for uv, surface in zip(found, surfaces, strict=True) if uv is not None
    ]
    bad = sum(not np.isfinite(corners).all() for corners in there)
    notes = (f"{bad} of {len(surfaces)} surfaces have UVs that are no numbers: the mesh is without",) if bad else ()
    return (None if bad or len(there) < len(surfaces) else np.concatenate(there)), notes
