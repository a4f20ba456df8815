"""A mesh as its file has it: polygons, cut into triangles and put together again; colours as numbers of any kind."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int32, Integer, UInt8

from capture4d.errors import InputError
from capture4d.types import Mesh
from capture4d.value_checks import outside

__all__ = [
    "MeshFile",
    "Painted",
    "colour_bytes",
    "fan_corners",
    "polygon_corners",
    "polygon_mesh",
    "unit_colours",
]

_SAME = np.iinfo(np.uint16).max // 255
"""Of a byte and of 16 bits: 255 is 65535."""


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


@dataclass(frozen=True, slots=True, eq=False)
class Painted:
    """A mesh file, and what it says of paint that lies in other files."""

    found: MeshFile
    uv: Float[np.ndarray, "faces 3 2"] | None = None
    """At the corners; NaN at those without any."""
    paint: Integer[np.ndarray, " faces"] | None = None
    """Which of `names`, or `images`, each face has, -1 for none; None if the file does not say."""
    names: tuple[str, ...] = ()
    """Of materials."""
    images: tuple[str, ...] = ()
    """Files of textures, where there are no materials."""
    libraries: tuple[str, ...] = ()
    """The files that hold the materials, as they are named."""


def fan_corners(sizes: np.ndarray) -> Integer[np.ndarray, "tris 3"]:
    """Cut polygons into fans: for each triangle, the positions of its corners in the list of all polygon corners."""
    if (sizes == 3).all():
        return np.arange(3 * len(sizes)).reshape(-1, 3)
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
    vertices: np.ndarray, corners: np.ndarray, sizes: np.ndarray, corner_uv: np.ndarray | None = None
) -> tuple[MeshFile, np.ndarray | None]:
    """A mesh from the flat list of all polygon corners, with the UVs of its triangles' corners.

    The mesh has UVs where every corner has; the file's notes say if only some have.
    """
    if sizes.size and sizes.min() < 3:
        raise InputError(f"face {int(sizes.argmin())}: expected at least 3 corners, found {sizes.min()}")
    if corners.size and outside(corners, len(vertices)):
        raise InputError(
            f"expected vertex indices from 0 to {len(vertices) - 1}, found {corners.min()}..{corners.max()}"
        )
    triangles = bool((sizes == 3).all())
    fan = None if triangles else fan_corners(sizes)
    faces = corners.reshape(-1, 3) if fan is None else corners[fan]
    uv, notes = None, ()
    if corner_uv is not None:
        corner_uv = corner_uv.astype(np.float32, copy=False)
        uv = corner_uv.reshape(-1, 3, 2) if fan is None else corner_uv[fan]
        absent = int(np.count_nonzero(~np.isfinite(corner_uv).all(axis=1)))
        if absent:
            notes = (f"{absent} of {len(corners)} corners have no UVs: the mesh is without",)
    mesh = Mesh(
        vertices.astype(np.float32, copy=False), faces.astype(np.int32, copy=False), uv if notes == () else None
    )
    return MeshFile(mesh, None, None if triangles else sizes.astype(np.int32), notes), uv


def colour_bytes(values: np.ndarray) -> tuple[UInt8[np.ndarray, "verts 3"], tuple[str, ...]]:
    """Colours of a file as bytes, scaled by their type, and what to note of them.

    Bytes are themselves, unsigned 16 bits go up to 65535. Other whole numbers are bytes that somebody gave more room,
    signed ones of 8 bits those of the same bits. Floats: see `unit_colours`. What is beyond is clipped; what is no
    number is black.
    """
    match values.dtype.kind, values.dtype.itemsize:
        case "u", 1:
            return values, ()
        case "i", 1:
            return values.view(np.uint8), ()
        case "u", 2:
            notes = ()
            if values.size and 1 < values.max() <= 255:
                notes = ("colours of 16 bits, none above 255: nearly black, if they are not bytes",)
            return np.rint(values / _SAME).astype(np.uint8), notes
        case "u" | "i", _:
            beyond = int(np.count_nonzero(((values < 0) | (values > 255)).any(axis=1)))
            notes = (f"{beyond} of {len(values)} colours are beyond 0 to 255: clipped",) if beyond else ()
            return np.clip(values, 0, 255).astype(np.uint8), notes
    absent = int(np.count_nonzero(~np.isfinite(values).all(axis=1)))
    notes = (f"{absent} of {len(values)} colours are no numbers: black",) if absent else ()
    finite = np.where(np.isfinite(values).all(axis=1, keepdims=True), values, 0)
    return np.rint(unit_colours(finite.astype(np.float64)) * 255).astype(np.uint8), notes


def unit_colours(values: Float64[np.ndarray, "colours 3"]) -> Float64[np.ndarray, "colours 3"]:
    """Finite colours that are from 0 to 1, or from 0 to 255, as the former.

    Few numbers prove nothing, for a scanner's arithmetic ends at 1.0003 now and then: those are from 0 to 255 of which
    more than one in a hundred is above 2, or that are all whole and not all 0 or 1.
    """
    if not values.size or values.max() <= 1:
        return np.clip(values, 0, 1)
    whole = bool((values == np.rint(values)).all())
    many = np.count_nonzero(values > 2) > values.size / 100 and np.count_nonzero(values > 2) > 1
    return np.clip(values / 255 if whole or many else values, 0, 1)
