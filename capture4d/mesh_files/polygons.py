"""A mesh as its file has it: polygons, cut into triangles and put together again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int32, Integer, UInt8

from capture4d.errors import InputError
from capture4d.types import Mesh

__all__ = ["MeshFile", "colour_bytes", "fan_corners", "polygon_corners", "polygon_mesh"]


@dataclass(frozen=True, slots=True, eq=False)
class MeshFile:
    """A mesh as its file has it."""

    mesh: Mesh
    """Polygons are cut into fans of triangles around their first corner, in file order."""
    colours: UInt8[np.ndarray, "verts 3"] | None = None
    """sRGB per vertex."""
    polygon_sizes: Int32[np.ndarray, " polygons"] | None = None
    """Corners of each face of the file; None if all are triangles."""
    notes: tuple[str, ...] = ()
    """What in the file could not be used, though the rest could: a line each, as for a person."""


def fan_corners(sizes: np.ndarray) -> Integer[np.ndarray, "tris 3"]:
    """Cut polygons into fans: for each triangle, the positions of its corners in the list of all polygon corners."""
    first = np.cumsum(sizes) - sizes
    triangles = sizes - 2
    step = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    start = np.repeat(first, triangles)
    return np.column_stack([start, start + step + 1, start + step + 2])


def polygon_corners(sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of the fan: for each polygon corner, the triangle and the corner of it that hold its vertex."""
    polygon = np.repeat(np.arange(len(sizes)), sizes)
    corner = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    first_triangle = (np.cumsum(sizes - 2) - (sizes - 2))[polygon]
    return first_triangle + np.maximum(corner - 2, 0), np.minimum(corner, 2)


def polygon_mesh(
    vertices: np.ndarray, corners: np.ndarray, sizes: np.ndarray, corner_uv: np.ndarray | None
) -> tuple[Mesh, np.ndarray | None]:
    """Mesh and polygon sizes from the flat list of all polygon corners."""
    if sizes.size and sizes.min() < 3:
        raise InputError(f"face {int(sizes.argmin())}: expected at least 3 corners, found {sizes.min()}")
    fan = fan_corners(sizes)
    uv = None if corner_uv is None else corner_uv[fan].astype(np.float32)
    if corners.size and (corners.min() < 0 or corners.max() >= len(vertices)):
        raise InputError(
            f"expected vertex indices from 0 to {len(vertices) - 1}, found {corners.min()}..{corners.max()}"
        )
    mesh = Mesh(vertices.astype(np.float32), corners[fan].astype(np.int32), uv)
    return mesh, None if (sizes == 3).all() else sizes.astype(np.int32)


def colour_bytes(values: np.ndarray) -> UInt8[np.ndarray, "verts 3"]:
    """Files hold colours as bytes, or as fractions of one."""
    if values.dtype == np.uint8:
        return values
    values = np.nan_to_num(values, nan=0, posinf=255, neginf=0)
    scale = 255 if values.size and values.max() <= 1 else 1
    return np.clip(np.rint(values * scale), 0, 255).astype(np.uint8)
