"""A sewing pattern: panels in one plane domain, their edges, and the curves that they are drafted from.

Letters: panel coordinates (u, v) in metres; u across the body, v along the grain, up. Edges of the same name are sewn
together, sampled at equal fractions of arc length, so that vertices of both sides coincide one to one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

__all__ = [
    "Edge",
    "Panel",
    "Pattern",
    "bezier",
    "curve_length",
    "lay_out",
    "line",
    "mirrored_name",
    "polygon_area",
    "resample",
]

LAYOUT_GAP_M = 0.05
"""Free space between panels of the plane domain."""


@dataclass(frozen=True, slots=True)
class Edge:
    """One side of a panel: a densely sampled curve, (n, 2) metres, and the seam or border it belongs to."""

    curve: np.ndarray
    name: str
    """Edges of the same name are sewn together; a name of `Pattern.borders` is an open border."""
    reverse: bool = False
    """Whether the seam runs against the curve."""


@dataclass(frozen=True, slots=True)
class Panel:
    """A closed outline, counter-clockwise, made of edges; each starts where the one before ends."""

    name: str
    edges: tuple[Edge, ...]
    origin: np.ndarray = field(default_factory=lambda: np.zeros(2))
    """Where the draft's own origin lies in the plane domain."""


@dataclass(frozen=True, slots=True)
class Pattern:
    """Panels in one plane domain."""

    panels: tuple[Panel, ...]
    borders: tuple[str, ...]
    """Names of the open borders: the garment's boundary loops."""


def bezier(*control: tuple[float, float], count: int = 200) -> np.ndarray:
    t = np.linspace(0, 1, count)[:, None]
    points = [np.broadcast_to(np.asarray(point, float), (count, 2)) for point in control]
    while len(points) > 1:
        points = [(1 - t) * a + t * b for a, b in pairwise(points)]
    return points[0]


def line(start: tuple[float, float], end: tuple[float, float]) -> np.ndarray:
    return np.linspace(start, end, 50)


def curve_length(curve: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum())


def lay_out(panels: tuple[Panel, ...]) -> tuple[Panel, ...]:
    """Move the panels side by side, lower edges at v = 0."""
    placed, cursor = [], 0.0
    for panel in panels:
        outline = np.concatenate([edge.curve for edge in panel.edges])
        low, high = outline.min(axis=0), outline.max(axis=0)
        shift = np.array([cursor - low[0], -low[1]])
        cursor += high[0] - low[0] + LAYOUT_GAP_M
        edges = tuple(Edge(edge.curve + shift, edge.name, edge.reverse) for edge in panel.edges)
        placed.append(Panel(panel.name, edges, origin=shift))
    return tuple(placed)


def polygon_area(outline: np.ndarray) -> float:
    x, y = outline.T
    return 0.5 * float(np.abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def resample(curve: np.ndarray, segments: int) -> np.ndarray:
    """(segments + 1, 2) points at equal arc length."""
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    wanted = np.linspace(0, along[-1], segments + 1)
    return np.stack([np.interp(wanted, along, curve[:, axis]) for axis in range(2)], axis=1)


def mirrored_name(name: str) -> str:
    """The name of a panel's, or an edge's, mirror image: left is right."""
    swapped = {"left": "right", "right": "left"}
    return "_".join(swapped.get(word, word) for word in name.split("_"))
