"""What the colours of one scan say, against what its take promises."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from scipy.spatial import KDTree

from capture4d.colours.labels import FIRST_PAINT, GARMENT, classify_colours
from capture4d.colours.spaces import colour_angles, to_lab
from capture4d.preflight.facts import Paints
from capture4d.types import Mesh, Scan

__all__ = ["ColourStatistics", "colour_statistics", "paint_labels"]

STRAY_DISTANCE_M = 0.06
"""Paint farther from the cloth than this is on something else: bands are a few centimetres wide."""
WEDGE_DEG = 30.0
"""Hues within this angle of the garment's are the garment's, however pale."""


@dataclass(frozen=True, slots=True, eq=False)
class ColourStatistics:
    """Colours of one scan. Shares are of its vertices."""

    chroma: float
    """CIELAB chroma that one vertex in a hundred exceeds."""
    clipped: float
    """Share of vertices at or near white in every channel."""
    garment: float
    """Share of garment-coloured vertices."""
    garment_chroma: float
    """Chroma that a hundredth of the vertices of the garment's hue exceed: a grey suit has some hue, but little chroma.
    NaN where there are hardly any."""
    garment_spread: float
    """Angle in linear RGB, radians, that 95 % of the garment's vertices keep to the garment's colour; NaN likewise."""
    borders: tuple[float, ...]
    """Share of each paint."""
    stray: tuple[float, ...]
    """Share of each paint's vertices that are far from any cloth."""


def paint_labels(colours: UInt8[np.ndarray, "verts 3"], paints: Paints) -> UInt8[np.ndarray, " verts"]:
    """What each vertex is, as `classify_colours` says; all 0 where the garment's colour is not known."""
    if paints.garment is None:
        return np.zeros(len(colours), np.uint8)
    return classify_colours(colours, paints.garment, paints.borders)


def colour_statistics(scan: Scan, labels: UInt8[np.ndarray, " verts"], paints: Paints) -> ColourStatistics:
    """Colours of a scan, against what its take promises.

    Args:
        labels: of the vertices, as `paint_labels` gives them.
    """
    lab = to_lab(scan.colours)
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    garment_chroma = spread = float("nan")
    if paints.garment is not None:
        wanted = to_lab(np.array([paints.garment], np.uint8))[0]
        turn = np.angle((lab[:, 1] + 1j * lab[:, 2]) * (wanted[1] - 1j * wanted[2]))
        own = (np.abs(turn) < np.radians(WEDGE_DEG)) & (chroma > 2)
        if own.mean() > 0.01:
            garment_chroma = float(np.percentile(chroma[own], 99))
        if (labels == GARMENT).mean() > 0.01:
            spread = float(np.percentile(colour_angles(scan.colours[labels == GARMENT], paints.garment), 95))
    count = max(len(labels), 1)
    borders = tuple(float((labels == FIRST_PAINT + i).sum() / count) for i in range(len(paints.borders)))
    return ColourStatistics(
        chroma=float(np.percentile(chroma, 99)) if len(chroma) else 0.0,
        clipped=float((scan.colours >= 250).all(axis=1).mean()) if len(chroma) else 0.0,
        garment=float((labels == GARMENT).mean()),
        garment_chroma=garment_chroma,
        garment_spread=spread,
        borders=borders,
        stray=_stray_shares(scan.mesh, labels, len(paints.borders)),
    )


def _stray_shares(mesh: Mesh, labels: np.ndarray, paints: int) -> tuple[float, ...]:
    """Of each paint, how much lies too far from cloth to be its border."""
    cloth = mesh.vertices[labels == GARMENT]
    if not len(cloth):
        return (0.0,) * paints
    tree = KDTree(cloth[:: max(1, len(cloth) // 20_000)], balanced_tree=False, compact_nodes=False)
    shares = []
    for paint in range(FIRST_PAINT, FIRST_PAINT + paints):
        points = mesh.vertices[labels == paint]
        points = points[:: max(1, len(points) // 2000)]
        far = tree.query(points, distance_upper_bound=STRAY_DISTANCE_M)[0] if len(points) else np.zeros(0)
        shares.append(float(np.isinf(far).mean()) if len(far) else 0.0)
    return tuple(shares)
