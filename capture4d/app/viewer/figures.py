"""Figures that each vertex of a registration has, and their colours.

distance to scan      the registered vertex to the scan's surface; nothing where the scan has no data
distance to truth     to the noise-free surface of a synthetic take
off its true place    to where the same material point truly is
stretch               the most that an edge around it is longer than in the template, times
motion                since the frame before, metres a second
inside the body       depth under the skin of the limb that carries the vertex, or of another; 0 outside
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from capture4d.app.drawing.render import heat_colours
from capture4d.captures.evaluation import correspondence_errors, material_points
from capture4d.captures.truth import TruthModel
from capture4d.geometry.mesh import edge_lengths, unique_edges
from capture4d.geometry.ray_casting import surface_distances
from capture4d.types import Garment

__all__ = [
    "FIGURES",
    "FIT",
    "INSIDE",
    "MOTION",
    "PLACE",
    "STRETCH",
    "TRUTH",
    "Figure",
    "StretchOf",
    "figure_colours",
    "speeds",
    "truth_figure_mm",
]

FIT, TRUTH, PLACE = "distance to scan", "distance to truth", "off its true place"
STRETCH, MOTION, INSIDE = "stretch", "motion", "inside the body"


@dataclass(frozen=True, slots=True)
class Figure:
    """What is told of a figure beside its colours."""

    unit: str
    low: float
    """What the coldest colour stands for."""
    high: float
    """What the hottest stands for, unless somebody says otherwise."""


FIGURES = {
    FIT: Figure("mm", 0.0, 2.0),
    TRUTH: Figure("mm", 0.0, 2.0),
    PLACE: Figure("mm", 0.0, 10.0),
    STRETCH: Figure("times", 1.0, 1.4),
    MOTION: Figure("m/s", 0.0, 2.0),
    INSIDE: Figure("mm", 0.0, 5.0),
}


def figure_colours(name: str, values: Float[np.ndarray, " verts"], high: float) -> UInt8[np.ndarray, "verts 3"]:
    """sRGB, pale at the low end, dark violet at `high`, turquoise beyond; grey where there is no value."""
    return heat_colours(np.asarray(values, np.float64), low=FIGURES[name].low, high=high)


class StretchOf:
    """How far the edges around each vertex are stretched.

    Args:
        garment: its template on the person who wears it.
    """

    def __init__(self, garment: Garment) -> None:
        template = garment.template
        self._edges = unique_edges(template.faces)
        self._lengths = np.maximum(edge_lengths(template.vertices.astype(np.float64), self._edges), 1e-12)

    def __call__(self, vertices: Float[np.ndarray, "verts 3"]) -> Float[np.ndarray, " verts"]:
        stretch = edge_lengths(vertices.astype(np.float64), self._edges) / self._lengths
        most = np.zeros(len(vertices))
        for side in range(2):
            np.maximum.at(most, self._edges[:, side], stretch)
        return most


def truth_figure_mm(
    name: str, vertices: Float[np.ndarray, "verts 3"], fine: Float[np.ndarray, "fine 3"], model: TruthModel
) -> Float[np.ndarray, " verts"]:
    """TRUTH or PLACE, millimetres."""
    if name == TRUTH:
        return 1e3 * surface_distances(model.fine.with_vertices(fine), vertices)
    places = material_points(fine, model.fine.faces, model.template_faces, model.template_barycentric)
    return 1e3 * correspondence_errors(vertices, places)


def speeds(before: Float[np.ndarray, "verts 3"], now: Float[np.ndarray, "verts 3"], seconds: float) -> np.ndarray:
    """MOTION, metres a second, (V,)."""
    return np.linalg.norm(now.astype(np.float64) - before, axis=1) / max(seconds, 1e-9)
