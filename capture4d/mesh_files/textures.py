"""Textures: the colours of a picture at the vertices of a mesh.

The image is read at every face corner, between pixels, and a vertex takes the mean of its corners: across a seam both
sides show the same paint.
"""

from __future__ import annotations

from typing import Literal, assert_never

import numpy as np
from jaxtyping import Float, Float64, Integer, UInt8

from capture4d.types import Mesh

__all__ = ["Wrap", "mean_at_vertices", "of_faces_at_vertices", "sampled"]

_EDGE = 1e-4
"""How far beyond its edge a texture does not begin again: rounding put the coordinate there."""
Wrap = Literal["repeat", "mirror", "clamp"]
"""How a texture goes on beyond its edges."""


def sampled(
    image: UInt8[np.ndarray, "rows columns 3"],
    uv: Float[np.ndarray, "points 2"],
    *,
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat"),
) -> Float64[np.ndarray, "points 3"]:
    """A picture between its pixels; v = 1 is its first row.

    Args:
        wrap: what is beyond 0 to 1, along u and along v.
    """
    rows, columns = image.shape[:2]
    inside = np.column_stack([_inside(along, how) for along, how in zip(uv.astype(np.float64).T, wrap, strict=True)])
    across = np.clip(inside[:, 0] * columns - 0.5, 0, columns - 1)
    down = np.clip((1 - inside[:, 1]) * rows - 0.5, 0, rows - 1)
    left, top = np.floor(across).astype(int), np.floor(down).astype(int)
    right, bottom = np.minimum(left + 1, columns - 1), np.minimum(top + 1, rows - 1)
    x, y = (across - left)[:, None], (down - top)[:, None]
    upper = (1 - x) * image[top, left] + x * image[top, right]
    lower = (1 - x) * image[bottom, left] + x * image[bottom, right]
    return (1 - y) * upper + y * lower


def _inside(along: Float64[np.ndarray, " points"], wrap: Wrap) -> Float64[np.ndarray, " points"]:
    """A texture coordinate, from 0 to 1."""
    match wrap:
        case "repeat":
            near = (along >= -_EDGE) & (along <= 1 + _EDGE)
            return np.where(near, np.clip(along, 0, 1), along - np.floor(along))
        case "mirror":
            return 1 - np.abs(np.mod(along, 2) - 1)
        case "clamp":
            return np.clip(along, 0, 1)
        case _:
            assert_never(wrap)


def mean_at_vertices(
    vertex: Integer[np.ndarray, " corners"], colours: Float[np.ndarray, "corners 3"], count: int
) -> UInt8[np.ndarray, "verts 3"]:
    """The mean of the colours at a vertex's corners; black where it has none.

    Args:
        vertex: that of each corner.
        count: of all vertices.
    """
    corners = np.maximum(np.bincount(vertex, minlength=count), 1)
    sums = [np.bincount(vertex, colours[:, channel], minlength=count) for channel in range(3)]
    return np.clip(np.rint(np.stack(sums, axis=1) / corners[:, None]), 0, 255).astype(np.uint8)


def of_faces_at_vertices(
    mesh: Mesh, colours: Float64[np.ndarray, "faces 3"]
) -> tuple[UInt8[np.ndarray, "verts 3"] | None, tuple[str, ...]]:
    """Colours of faces as the mean at each vertex, and a note of the vertices that have none, which are black.

    Args:
        colours: from 0 to 255; NaN for faces without.
    """
    known = np.isfinite(colours).all(axis=1)
    if not known.any():
        return None, ()
    corners = np.repeat(colours[known], 3, axis=0)
    count = len(mesh.vertices)
    bare = len(np.unique(mesh.faces)) - len(np.unique(mesh.faces[known]))
    notes = (f"{bare} of {count} vertices are in no coloured face: black",) if bare else ()
    return mean_at_vertices(mesh.faces[known].reshape(-1), corners, count), notes
