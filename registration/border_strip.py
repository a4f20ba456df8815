"""The inner rim of a border's paint, on the template: all of it lies equally far from the border, for paint is wide.

Where a scan ends is a sample or several off the true border; where its paint begins is not. How wide the paint is the
template tells: of what lies under the rim as the template lies now, the median distance from the border. So the rim
says nothing of how far out a template should lie as a whole, which its lengths know, but draws it straight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32, Int64
from scipy.spatial import KDTree

from registration.solver import Rows, RowTerm
from registration.template import TemplateAnalysis

__all__ = ["BorderStrip", "PaintRim"]

STEPS = 4
"""Points along the edges of a face, and within it, at which distances from the border are known."""
ALONG = 4
"""Points along an edge of the border, of which the nearest tells the nearest edge."""
LEAST = 0.002
"""Nearer to the border, metres, nothing tells which way is inwards."""
GATE = 0.012
"""Distance from the rim to what of the template lies under it at most, metres."""
OFF_SCALE = 0.004
"""Scale of the Geman-McClure weights of how far off the paint's width a point is, metres."""
UNEVEN = 0.2
"""Paint whose width differs by more than this share of it, in the median, is not of one width. Of ten shirts: 0.04 to
0.07."""


@dataclass(frozen=True, slots=True, eq=False)
class BorderStrip:
    """Points of a template's faces near its borders, evenly over each face."""

    corners: Int32[np.ndarray, "points 3"]
    """Vertices of each one's face."""
    shares: Float64[np.ndarray, "points 3"]
    """Its barycentric coordinates there."""
    distance: Float64[np.ndarray, " points"]
    """From the border, at rest, metres."""
    ends: Int32[np.ndarray, "points 2"]
    """The edge of the border that is nearest at rest."""
    place: Float64[np.ndarray, " points"]
    """Share of the way along that edge."""

    @staticmethod
    def of(analysis: TemplateAnalysis, reach: float) -> BorderStrip:
        """What is nearer to the border than `reach`, metres; straight through the air, which over a paint's width is as
        far as along the cloth."""
        rest, border = analysis.rest, analysis.border
        edges = np.stack([border.vertices, border.after], axis=1)
        places = np.tile((np.arange(ALONG) + 0.5) / ALONG, len(edges))
        curve = KDTree(_between(rest, np.repeat(edges, ALONG, axis=0), places))
        longest = float(analysis.rest_lengths.max(initial=0.0))
        near = np.isfinite(curve.query(rest, distance_upper_bound=reach + longest)[0])
        faces = analysis.faces[near[analysis.faces].any(axis=1)]
        first, second = (each.reshape(-1) for each in np.mgrid[: STEPS + 1, : STEPS + 1])
        inside = first + second <= STEPS
        grid = np.stack([first, second, STEPS - first - second], axis=1)[inside] / STEPS
        corners, shares = np.repeat(faces, len(grid), axis=0), np.tile(grid, (len(faces), 1))
        points = np.einsum("pc,pca->pa", shares, rest[corners])
        found, samples = curve.query(points, distance_upper_bound=reach)
        near, nearest = np.isfinite(found), np.asarray(samples)
        corners, shares, points, ends = corners[near], shares[near], points[near], edges[nearest[near] // ALONG]
        along = rest[ends[:, 1]] - rest[ends[:, 0]]
        share = np.einsum("pa,pa->p", points - rest[ends[:, 0]], along) / np.maximum((along**2).sum(axis=1), 1e-24)
        place = np.clip(share, 0.0, 1.0)
        distance = np.linalg.norm(points - _between(rest, ends, place), axis=1)
        kept = distance > LEAST
        return BorderStrip(corners[kept], shares[kept], distance[kept], ends[kept], place[kept])

    def under(
        self, points: Float64[np.ndarray, "points 3"], vertices: Float64[np.ndarray, "verts 3"]
    ) -> tuple[Int64[np.ndarray, " found"], Float64[np.ndarray, "found 3"], Float64[np.ndarray, " found"]]:
        """What of the strip lies under some points: the nearest of its points, which way is inwards there, and how far
        from the border, at rest, the places under them are. Points of which nothing is within the gate are left out.

        Args:
            vertices: of the template, as it lies, metres.
        """
        here = np.einsum("pc,pca->pa", self.shares, vertices[self.corners])
        tree = KDTree(here, balanced_tree=False, compact_nodes=False)
        away, index = tree.query(points, distance_upper_bound=GATE)
        found = np.isfinite(away)
        nearest = np.asarray(index)[found]
        inwards = here[nearest] - _between(vertices, self.ends[nearest], self.place[nearest])
        inwards /= np.maximum(np.linalg.norm(inwards, axis=1, keepdims=True), 1e-12)
        distance = self.distance[nearest] + np.einsum("pa,pa->p", points[found] - here[nearest], inwards)
        return nearest, inwards, distance


@dataclass(frozen=True, slots=True, eq=False)
class PaintRim:
    """Where the paint of a scan's borders begins, and the template's strip that it is compared with."""

    strip: BorderStrip
    points: Float64[np.ndarray, "points 3"]
    """Metres."""

    @staticmethod
    def of(
        analysis: TemplateAnalysis,
        points: Float64[np.ndarray, "points 3"],
        border_points: Float64[np.ndarray, "border 3"],
    ) -> PaintRim | None:
        """None where there is no rim, or the paint is not equally wide all along.

        Args:
            border_points: where the scan shows the border itself, as well as it does, metres.
        """
        if not len(points) or not len(border_points) or not len(analysis.border.vertices):
            return None
        apart = KDTree(border_points).query(points)[0]
        width = float(np.median(apart))
        if float(np.median(np.abs(apart - width))) > UNEVEN * width:
            return None
        return PaintRim(BorderStrip.of(analysis, width + 1.5 * GATE), points)

    def terms(self, vertices: Float64[np.ndarray, "verts 3"], weight: float) -> list[RowTerm]:
        """Slide what lies under the rim inwards or outwards, until all of it is equally far from the border; nothing
        where the template lies elsewhere."""
        nearest, inwards, distance = self.strip.under(self.points, vertices)
        count = len(nearest)
        if not count:
            return []
        off = distance - np.median(distance)
        weights = weight / count / (1.0 + (off / OFF_SCALE) ** 2) ** 2
        rows = Rows(
            np.arange(0, 3 * count + 1, 3, dtype=np.int32),
            self.strip.corners[nearest].reshape(-1),
            self.strip.shares[nearest].reshape(-1, 1),
        )
        metric = weights[:, None, None] * (inwards[:, :, None] * inwards[:, None, :])
        return [RowTerm(rows, metric, -off[:, None] * inwards)]


def _between(vertices: np.ndarray, ends: np.ndarray, place: np.ndarray) -> Float64[np.ndarray, "points 3"]:
    """Points on edges."""
    return (1.0 - place)[:, None] * vertices[ends[:, 0]] + place[:, None] * vertices[ends[:, 1]]
