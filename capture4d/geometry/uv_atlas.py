"""UV coordinates of a template: are they fit for use, and new ones where they are not.

Fresh UVs are cut by xatlas (MIT) and scaled to metres, as those of a sewing pattern are. xatlas mirrors charts where
that packs better, which turns normal maps inside out; so the charts are turned back and laid out on shelves here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int32

from capture4d.geometry.mesh import connected_components, face_areas
from capture4d.geometry.uv_layout import island_boxes, shelve
from capture4d.heavy_imports import njit
from capture4d.types import Mesh

__all__ = ["UvReport", "check_uv", "fresh_uv"]

GRID = 1024
"""Cells along the longer side of the atlas in which overlaps are counted."""
LARGEST = 100.0
"""UVs are shares of an image, tiles of one, or metres on a pattern; beyond this they are none of it."""
MARGIN_M = 0.01
"""Between fresh charts."""
FAULTY_PERCENT = 1.0
"""Share of the atlas, or of the faces, that may be at fault."""


@dataclass(frozen=True, slots=True)
class UvReport:
    """What is wrong with the UVs of a mesh."""

    present: bool
    in_range: bool = True
    overlap_percent: float = 0.0
    """Of the used cells of the atlas, those that two faces claim."""
    flipped_percent: float = 0.0
    """Faces wound against most others."""
    degenerate_percent: float = 0.0
    """Faces without area."""

    def faults(self) -> tuple[str, ...]:
        """One phrase each; empty if the UVs can be used."""
        if not self.present:
            return ("no UVs",)
        shares = {
            "of the atlas used twice": self.overlap_percent,
            "of the faces flipped": self.flipped_percent,
            "of the faces without area": self.degenerate_percent,
        }
        faults = [f"{value:.1f} % {what}" for what, value in shares.items() if value > FAULTY_PERCENT]
        return (*faults, *(() if self.in_range else (f"UVs beyond {LARGEST:g}",)))


def check_uv(mesh: Mesh) -> UvReport:
    """Look for what makes UVs useless (a Mesh has no NaN): huge values, overlaps, flipped and collapsed faces."""
    if mesh.uv is None:
        return UvReport(present=False)
    uv = mesh.uv.astype(np.float64)
    doubled = _signed_areas(uv)
    scale = np.abs(doubled).max(initial=0.0)
    flat = np.abs(doubled) <= 1e-9 * scale
    positive = np.count_nonzero(doubled[~flat] > 0)
    flipped = min(positive, np.count_nonzero(~flat) - positive)
    extent = np.ptp(uv.reshape(-1, 2), axis=0).max()
    cells = (uv - uv.reshape(-1, 2).min(axis=0)) * (GRID / max(extent, 1e-12))
    counts = _cover(np.ascontiguousarray(cells), GRID)
    return UvReport(
        present=True,
        in_range=bool(np.abs(uv).max(initial=0.0) <= LARGEST),
        overlap_percent=100.0 * int(np.count_nonzero(counts > 1)) / max(int(np.count_nonzero(counts)), 1),
        flipped_percent=100 * int(flipped) / len(uv),
        degenerate_percent=100 * int(np.count_nonzero(flat)) / len(uv),
    )


def fresh_uv(mesh: Mesh) -> Float32[np.ndarray, "faces 3 2"]:
    """Cut a mesh into charts and lay them out side by side: UVs per face corner, in metres, none mirrored."""
    import xatlas

    _, indices, places = xatlas.parametrize(mesh.vertices, mesh.faces.astype(np.uint32))
    corners, places = indices.astype(np.int32), places.astype(np.float64)
    chart = connected_components(corners, len(places))
    areas = np.bincount(chart[corners[:, 0]], _signed_areas(places[corners]), minlength=chart.max() + 1)
    places[:, 0] *= np.where(areas < 0, -1.0, 1.0)[chart]
    on_mesh = face_areas(mesh.vertices.astype(np.float64), mesh.faces).sum()
    places *= np.sqrt(2 * on_mesh / max(np.abs(areas).sum(), 1e-12))
    return (places + _shelves(places, chart)[chart])[corners].astype(np.float32)


def _shelves(places: Float[np.ndarray, "places 2"], chart: Int32[np.ndarray, " places"]) -> np.ndarray:
    """Where to move each chart, (C, 2), so that together they are about square."""
    low, high = island_boxes(places, chart)
    sizes = high - low + MARGIN_M
    width = max(float(np.sqrt(sizes.prod(axis=1).sum())), float(sizes[:, 0].max()))
    return shelve(sizes, width) - low


def _signed_areas(uv: Float[np.ndarray, "faces 3 2"]) -> Float[np.ndarray, " faces"]:
    """Twice the areas, positive where counter-clockwise."""
    along, across = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]


@njit(cache=True)
def _cover(uv, size):
    """How many faces hold the centre of each cell; a centre on an edge is nobody's, so that neighbours share none."""
    counts = np.zeros((size, size), np.int32)
    for f in range(len(uv)):
        a, b, c = uv[f, 0], uv[f, 1], uv[f, 2]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0.0:
            continue
        left, right = min(a[0], b[0], c[0]), max(a[0], b[0], c[0])
        low, high = min(a[1], b[1], c[1]), max(a[1], b[1], c[1])
        for y in range(max(int(low), 0), min(int(high) + 1, size)):
            for x in range(max(int(left), 0), min(int(right) + 1, size)):
                px, py = x + 0.5, y + 0.5
                w0 = ((b[0] - px) * (c[1] - py) - (b[1] - py) * (c[0] - px)) / area
                w1 = ((c[0] - px) * (a[1] - py) - (c[1] - py) * (a[0] - px)) / area
                if w0 > 1e-9 and w1 > 1e-9 and 1.0 - w0 - w1 > 1e-9:
                    counts[y, x] += 1
    return counts
