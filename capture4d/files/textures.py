"""Colours of a textured scan at its vertices.

The image is read at every face corner, between pixels, and a vertex takes the mean of its corners: across a seam both
sides show the same paint.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from capture4d.errors import InputError
from capture4d.types import Mesh

__all__ = ["texture_colours"]


def texture_colours(mesh: Mesh, image: UInt8[np.ndarray, "rows columns 3"]) -> UInt8[np.ndarray, "verts 3"]:
    """Sample a texture at the vertices of a mesh with UVs; vertices that no face uses are black.

    Args:
        image: sRGB; v = 1 is its first row, as in obj files. UVs beyond 0 to 1 repeat it.
    Raises:
        InputError: the mesh has no UVs.
    """
    if mesh.uv is None:
        raise InputError("a texture needs UVs, found none")
    rows, columns = image.shape[:2]
    uv = mesh.uv.reshape(-1, 2).astype(np.float64)
    inside = np.where((uv >= 0) & (uv <= 1), uv, uv - np.floor(uv))
    across = np.clip(inside[:, 0] * columns - 0.5, 0, columns - 1)
    down = np.clip((1 - inside[:, 1]) * rows - 0.5, 0, rows - 1)
    left, top = np.floor(across).astype(int), np.floor(down).astype(int)
    right, bottom = np.minimum(left + 1, columns - 1), np.minimum(top + 1, rows - 1)
    x, y = (across - left)[:, None], (down - top)[:, None]
    upper = (1 - x) * image[top, left] + x * image[top, right]
    lower = (1 - x) * image[bottom, left] + x * image[bottom, right]
    corners = (1 - y) * upper + y * lower
    vertex = mesh.faces.reshape(-1)
    count = np.maximum(np.bincount(vertex, minlength=len(mesh.vertices)), 1)
    sums = [np.bincount(vertex, corners[:, channel], minlength=len(mesh.vertices)) for channel in range(3)]
    return np.clip(np.rint(np.stack(sums, axis=1) / count[:, None]), 0, 255).astype(np.uint8)
