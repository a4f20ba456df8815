"""From a coloured scan of hundreds of thousands of vertices to the few thousand points that tracking reads.

One point a cell of a grid, so that dense parts of a scan do not outweigh sparse ones. Cells are larger on the garment,
which says less about the body. What has the garment's colour or a border's paint is cloth, the rest is skin or suit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from capture4d.colours.labels import classify_colours, settle_labels
from capture4d.colours.printed_cloth import label_print
from capture4d.colours.spaces import Colour
from capture4d.errors import InputError
from capture4d.geometry.mesh_kernels import open_vertices, vertex_normals_kernel
from capture4d.tracking.config import SamplingConfig
from capture4d.types import Scan

__all__ = ["ScanPoints", "scan_points", "subsample"]


@dataclass(frozen=True, slots=True, eq=False)
class ScanPoints:
    """What tracking sees of a scan."""

    points: Float64[np.ndarray, "points 3"]
    """Metres."""
    normals: Float64[np.ndarray, "points 3"]
    """Outwards."""
    cloth: Bool[np.ndarray, " points"]
    """On the garment; the others are on skin or suit."""


def subsample(scan: ScanPoints, count: int) -> ScanPoints:
    """Every so-many-th point; points are in random order."""
    if len(scan.points) <= count:
        return scan
    kept = np.linspace(0, len(scan.points) - 1, count).astype(int)
    return ScanPoints(scan.points[kept], scan.normals[kept], scan.cloth[kept])


def scan_points(
    scan: Scan,
    garment_colour: Colour,
    paints: tuple[Colour, ...],
    config: SamplingConfig,
    *,
    printed: bool = False,
    source: str = "scan",
) -> ScanPoints:
    """Points, normals and labels of a scan, in random but fixed order.

    Vertices on open edges are left out: their normals are half a neighbourhood's.

    Args:
        printed: the garment has many colours, and is what lies between the paint.
    Raises:
        InputError: there is nothing left of the scan.
    """
    faces = scan.mesh.faces
    vertices = scan.mesh.vertices.astype(np.float64)
    labels = settle_labels(faces, classify_colours(scan.colours, garment_colour, paints))
    if printed:
        labels = label_print(faces, labels)
    normals = vertex_normals_kernel(vertices, faces)
    on_edge, used = open_vertices(faces, len(vertices))
    usable = used & ~on_edge & normals.any(axis=1)
    if not usable.any():
        raise InputError("expected a surface to track, found no faces", where=source)
    order = np.random.default_rng(0).permutation(np.flatnonzero(usable))
    cloth = labels[order] > 0
    kept = np.concatenate(
        [
            _one_a_cell(vertices, order[~cloth], config.body_cell_m),
            _one_a_cell(vertices, order[cloth], config.cloth_cell_m),
        ]
    )
    kept = np.random.default_rng(1).permutation(kept)
    return ScanPoints(vertices[kept], normals[kept], labels[kept] > 0)


def _one_a_cell(vertices: np.ndarray, candidates: np.ndarray, size: float) -> np.ndarray:
    cells = np.floor(vertices[candidates] / size).astype(np.int64) & 0x1FFFFF
    _, first = np.unique(cells @ np.array([1 << 42, 1 << 21, 1]), return_index=True)
    return candidates[np.sort(first)]
