"""A sequence of meshes, whatever holds it: a folder with a mesh file a frame, USD, Alembic, GLB, a point
cache."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from capture4d.app.importing.config import ImportConfig
from capture4d.captures.scan_files import list_scans
from capture4d.errors import InputError
from capture4d.mesh_files.animated.alembic import read_alembic
from capture4d.mesh_files.animated.glb import read_glb
from capture4d.mesh_files.animated.moving_mesh import MovingMesh
from capture4d.mesh_files.animated.point_caches import read_mdd, read_pc2
from capture4d.mesh_files.animated.usd import read_usd
from capture4d.mesh_files.meshes import read_mesh
from capture4d.types import Mesh
from capture4d.units import METRES

__all__ = ["read_sequence", "sequence_files"]


def sequence_files(path: Path) -> list[Path]:
    """The files that a sequence is read from.

    Raises:
        InputError: there are none.
    """
    if not path.is_dir():
        return [path]
    found = list(list_scans(path).scans.values())
    if not found:
        raise InputError("expected mesh files with a frame's number in their names, found none", where=path)
    return found


def read_sequence(path: Path, template: Mesh, config: ImportConfig) -> MovingMesh:
    """The template in each frame, metres, Y up, with a rate.

    Args:
        template: whose vertices, in whose order, every frame has.
    Raises:
        InputError: a file is damaged, is none of the kinds that are read, has other vertices or faces, or nobody knows
            the rate.
    """
    found = _opened(path, template, config)
    if found.fps is None and config.fps is None:
        raise InputError("--fps: expected the frame rate, which these files do not tell, found none", where=path)
    if len(found.mesh.vertices) != len(template.vertices):
        raise InputError(
            f"expected the {len(template.vertices)} vertices of the template, in its order, found "
            f"{len(found.mesh.vertices)}; export without splitting vertices at seams or normals",
            where=path,
        )
    if not _have_same_faces(found.mesh, template):
        raise InputError(
            "expected the faces of the template, found others: the order of its vertices is lost", where=path
        )
    return replace(found, mesh=template, fps=config.fps or found.fps, frames=partial(_placed, found, config, path))


def _opened(path: Path, template: Mesh, config: ImportConfig) -> MovingMesh:
    if path.is_dir():
        sequence_files(path)
        files = list_scans(path).scans
        first = read_mesh(next(iter(files.values()))).mesh
        return MovingMesh(first, np.array(list(files), np.int32), None, partial(_of_files, files, len(first.vertices)))
    match path.suffix.lower():
        case ".usd" | ".usda" | ".usdc" | ".usdz":
            return read_usd(path)
        case ".abc":
            return read_alembic(path, config.fps)
        case ".glb" | ".gltf":
            return read_glb(path, config.fps)
        case ".pc2":
            return read_pc2(path, template)
        case ".mdd":
            if config.fps is None:
                raise InputError(
                    "--fps: expected the frame rate, which an mdd file does not tell, found none", where=path
                )
            return read_mdd(path, template, config.fps)
        case suffix:
            kinds = "a folder of mesh files, or .usd, .usda, .usdc, .usdz, .abc, .glb, .gltf, .pc2, .mdd"
            raise InputError(f"expected {kinds}, found '{suffix}'", where=path)


def _of_files(files: Mapping[int, Path], count: int) -> Iterator[np.ndarray]:
    for path in files.values():
        vertices = read_mesh(path).mesh.vertices
        if len(vertices) != count:
            raise InputError(f"expected {count} vertices, as in the first frame, found {len(vertices)}", where=path)
        yield vertices


def _have_same_faces(found: Mesh, template: Mesh) -> bool:
    """Whichever corner comes first, and in whatever order the faces are."""
    if len(found.faces) != len(template.faces):
        return False
    return np.array_equal(_canonical(found.faces), _canonical(template.faces))


def _canonical(faces: np.ndarray) -> np.ndarray:
    start = faces.argmin(axis=1)
    turned = np.stack([faces[np.arange(len(faces)), (start + step) % 3] for step in range(3)], axis=1)
    return turned[np.lexsort(turned.T[::-1])]


def _placed(found: MovingMesh, config: ImportConfig, path: Path) -> Iterator[np.ndarray]:
    scale = METRES[config.units] if config.units != "auto" else 1.0
    for frame_id, vertices in zip(found.frame_ids.tolist(), found.frames(), strict=True):
        if not np.isfinite(vertices).all():
            raise InputError(f"frame {frame_id}: expected finite vertices, found NaN or inf", where=path)
        placed = vertices * np.float32(scale)
        yield (placed[:, [0, 2, 1]] * (1, 1, -1) if config.up == "z" else placed).astype(np.float32)
