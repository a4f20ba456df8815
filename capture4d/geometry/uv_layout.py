"""Where the UV islands of a template lie in the unit square of its maps.

Sewing patterns keep UVs in metres. For an image they are scaled alike and laid out side by side, with room for
padding; a layout that already fits an image is kept.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Integer

from capture4d.errors import InputError
from capture4d.geometry.mesh import face_areas
from capture4d.geometry.tangents import TangentLayout
from capture4d.types import Mesh

__all__ = [
    "Layout",
    "island_boxes",
    "millimetres_per_texel",
    "pack_islands",
    "require_uvs",
    "shelve",
    "unit_square",
]

Layout = Literal["auto", "keep", "pack"]
METRIC_TOLERANCE = 0.35
"""UVs whose lengths are those of the mesh, give or take this share, are a pattern in metres: the mesh may lie stretched
on another body."""
CANDIDATES = 240


def unit_square(mesh: Mesh, *, layout: Layout = "auto", gap: float) -> Mesh:
    """The mesh with its UVs in the unit square.

    Args:
        layout: `keep` the UVs, `pack` the islands anew, or `auto`: keep what lies in the unit square, pack a pattern
            in metres.
        gap: room between packed islands, as a share of the square's side.
    Raises:
        InputError: there are no UVs, they have no area, or they are neither in the unit square nor a pattern in metres.
    """
    uv = require_uvs(mesh)
    low, high = float(uv.min(initial=0)), float(uv.max(initial=0))
    fits = low >= 0 and high <= 1
    if layout == "keep" or (layout == "auto" and not fits and not _is_metric(mesh)):
        if fits:
            return mesh
        raise InputError(f"template: expected UVs in the unit square, or a pattern in metres, found values from "
                         f"{low:.3g} to {high:.3g}")  # fmt: skip
    if layout == "auto" and fits:
        return mesh
    islands = TangentLayout(mesh.faces, uv).islands()
    return Mesh(mesh.vertices, mesh.faces, pack_islands([uv], [islands], gap=gap)[0])


def require_uvs(mesh: Mesh) -> Float32[np.ndarray, "F 3 2"]:
    """
    Raises:
        InputError: there are no UVs, or all faces have shrunk to nothing in them.
    """
    if mesh.uv is None:
        raise InputError("template: expected UVs, found none; `capture4d template --uv fresh` cuts some")
    if _uv_area(mesh) <= 0:
        raise InputError("template: expected UVs that spread the surface out, found none with any area")
    return mesh.uv


def pack_islands(
    uvs: list[Float[np.ndarray, "_ 3 2"]], islands: list[Int32[np.ndarray, " _"]], *, gap: float
) -> list[Float32[np.ndarray, "_ 3 2"]]:
    """Lay out islands in rows, the tall ones first, in as many unit squares as there are entries, all at one scale.

    The scale is the largest at which the rows fit.
    """
    boxes = [_boxes(uv, island) for uv, island in zip(uvs, islands, strict=True)]
    widest = max(float(high[:, axis].max() - low[:, axis].min()) for low, high in boxes for axis in range(2))
    least = max(float((high - low).max()) for low, high in boxes)
    for side in np.geomspace(least, 2 * widest + least, CANDIDATES) / (1 - gap):
        shifts = [_rows(high - low, side, gap * side) for low, high in boxes]
        if all(shift is not None for shift in shifts):
            return [
                np.clip((uv + (shift - low)[island][:, None]) / side, 0, 1).astype(np.float32)
                for uv, island, (low, _), shift in zip(uvs, islands, boxes, shifts, strict=True)
                if shift is not None
            ]
    raise InputError(f"template: expected UV islands that fit a square, found {sum(len(low) for low, _ in boxes)} that "
                     f"leave no room for a gap of {100 * gap:.1f} % between them")  # fmt: skip


def millimetres_per_texel(mesh: Mesh, size: int) -> float:
    """Length on the mesh that one texel shows, in the mean over the surface."""
    assert mesh.uv is not None
    return 1e3 * float(np.sqrt(face_areas(mesh.vertices.astype(float), mesh.faces).sum() / _uv_area(mesh))) / size


def _uv_area(mesh: Mesh) -> float:
    assert mesh.uv is not None
    along, across = (mesh.uv[:, k].astype(float) - mesh.uv[:, 0] for k in (1, 2))
    return float(np.abs(along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]).sum() / 2)


def _is_metric(mesh: Mesh) -> bool:
    on_mesh = float(face_areas(mesh.vertices.astype(float), mesh.faces).sum())
    return bool(abs(np.sqrt(_uv_area(mesh) / max(on_mesh, 1e-12)) - 1) < METRIC_TOLERANCE)


def island_boxes(
    points: Float[np.ndarray, "points 2"], islands: Integer[np.ndarray, " points"]
) -> tuple[Float64[np.ndarray, "islands 2"], Float64[np.ndarray, "islands 2"]]:
    """Lower and upper corner of the box around each island; which one a point belongs to is counted from 0."""
    count = int(islands.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, islands, points.astype(float))
    np.maximum.at(high, islands, points.astype(float))
    return low, high


def shelve(sizes: Float64[np.ndarray, "boxes 2"], width: float) -> Float64[np.ndarray, "boxes 2"]:
    """Lower left corners of boxes on shelves: the tall ones first, from left to right, row upon row.

    Args:
        width: of the shelves; a box that is wider has one of its own and juts out.
    """
    corners = np.empty_like(sizes)
    x = y = height = 0.0
    for index in np.argsort(-sizes[:, 1], kind="stable"):
        wide, tall = sizes[index]
        if x + wide > width and x > 0:
            x, y, height = 0.0, y + height, 0.0
        corners[index] = x, y
        x += wide
        height = max(height, tall)
    return corners


def _boxes(uv: np.ndarray, island: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return island_boxes(uv.reshape(-1, 2), np.repeat(island, 3))


def _rows(sizes: np.ndarray, side: float, gap: float) -> np.ndarray | None:
    """Lower left corners of boxes in a square of this side, half a gap around each; None if they do not fit."""
    boxes, room = sizes + gap, side + 1e-12
    corners = shelve(boxes, room)
    return corners + gap / 2 if (corners + boxes <= room).all() else None
