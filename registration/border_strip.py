"""The inner rim of a border's paint, on the template: all of a loop's lies equally far from it, for paint is wide.

Where a scan ends is a sample or several off the true border; where its paint begins is not. How wide the paint is the
template tells: of what lies under a loop's rim as the template lies now, the median distance from the loop. So the rim
says nothing of how far out a loop should lie as a whole, which its lengths know, but draws it straight. A hem may be
painted more widely than a cuff; a loop whose paint is not of one width, or of which little is seen, is left to the
points on the border itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64
from scipy.spatial import KDTree

from registration.register import FrameScan
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
WIDEST = 0.1
"""What begins farther from every point on the border, metres, is no border's paint."""
BESIDE, COVERED = 0.03, 0.5
"""A loop is held by the rim if this share of it has some of the rim within so far along it, metres."""
TOGETHER = 0.003
"""Loops painted equally widely share their distance, which draws sleeves of one length, unless their own is farther off
than this, metres: then a border hangs low as a whole. Two shirts' borders: 0.90 mm with it, 1.12 without."""
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
    loops: Int32[np.ndarray, " points"]
    """The loop that it is of."""
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
        edge = nearest[near] // ALONG
        corners, shares, points, ends = corners[near], shares[near], points[near], edges[edge]
        along = rest[ends[:, 1]] - rest[ends[:, 0]]
        share = np.einsum("pa,pa->p", points - rest[ends[:, 0]], along) / np.maximum((along**2).sum(axis=1), 1e-24)
        place = np.clip(share, 0.0, 1.0)
        distance = np.linalg.norm(points - _between(rest, ends, place), axis=1)
        kept = distance > LEAST
        loops = border.loops[edge[kept]]
        return BorderStrip(corners[kept], shares[kept], distance[kept], ends[kept], loops, place[kept])

    def under(self, points: Float64[np.ndarray, "points 3"], vertices: Float64[np.ndarray, "verts 3"]) -> UnderRim:
        """What of the strip lies under some points, where anything does within the gate.

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
        return UnderRim(found, nearest, inwards, distance)


@dataclass(frozen=True, slots=True, eq=False)
class UnderRim:
    """What of a strip lies under some points."""

    found: Bool[np.ndarray, " points"]
    """Points under which something does; the rest is of these alone."""
    nearest: Int64[np.ndarray, " found"]
    """The nearest point of the strip."""
    inwards: Float64[np.ndarray, "found 3"]
    """Unit direction away from the border there."""
    distance: Float64[np.ndarray, " found"]
    """How far from the border the place under each is, at rest, metres."""


@dataclass(frozen=True, slots=True, eq=False)
class PaintRim:
    """Where the paint of a scan's borders begins, and the template's strip that it is compared with."""

    analysis: TemplateAnalysis
    strip: BorderStrip
    points: Float64[np.ndarray, "points 3"]
    """Metres."""
    widths: Float64[np.ndarray, " points"]
    """How far each is from the border as the scan shows it, metres."""

    @staticmethod
    def of(
        analysis: TemplateAnalysis,
        points: Float64[np.ndarray, "points 3"],
        border_points: Float64[np.ndarray, "border 3"],
    ) -> PaintRim | None:
        """None where there is no rim.

        Args:
            border_points: where the scan shows the border itself, as well as it does, metres.
        """
        if not len(points) or not len(border_points) or not len(analysis.border.vertices):
            return None
        widths = KDTree(border_points).query(points)[0]
        near = widths < WIDEST
        if not near.any():
            return None
        reach = float(np.percentile(widths[near], 95)) + 1.5 * GATE
        return PaintRim(analysis, BorderStrip.of(analysis, reach), points[near], widths[near])

    def terms(
        self, scan: FrameScan, vertices: Float64[np.ndarray, "verts 3"], weight: float
    ) -> tuple[list[RowTerm], FrameScan]:
        """Slide what lies under the rim inwards or outwards, until all of a loop's is equally far from it; and the scan
        with those points alone on its borders that belong to other loops. No term where the template lies elsewhere.
        """
        under = self.strip.under(self.points, vertices)
        off, held = self._loops(under)
        others = self._without(held, scan, vertices)
        loop = self.strip.loops[under.nearest]
        used = held[loop]
        count = int(used.sum())
        if not count:
            return [], others
        nearest, inwards, off = under.nearest[used], under.inwards[used], (under.distance - off[loop])[used]
        weights = weight / count / (1.0 + (off / OFF_SCALE) ** 2) ** 2
        rows = Rows(
            np.arange(0, 3 * count + 1, 3, dtype=np.int32),
            self.strip.corners[nearest].reshape(-1),
            self.strip.shares[nearest].reshape(-1, 1),
        )
        metric = weights[:, None, None] * (inwards[:, :, None] * inwards[:, None, :])
        return [RowTerm(rows, metric, -off[:, None] * inwards)], others

    def others(self, scan: FrameScan, vertices: Float64[np.ndarray, "verts 3"]) -> FrameScan:
        """The scan with those points alone on its borders that belong to loops which the rim does not hold."""
        return self._without(self._loops(self.strip.under(self.points, vertices))[1], scan, vertices)

    def _loops(self, under: UnderRim) -> tuple[Float64[np.ndarray, " loops"], Bool[np.ndarray, " loops"]]:
        """How far from each loop the rim lies, in the median with loops of its width, and whether the rim holds it."""
        border, rest = self.analysis.border, self.analysis.rest
        width_of, away, held = (
            np.zeros(len(border.names)),
            np.zeros(len(border.names)),
            np.zeros(len(border.names), bool),
        )
        loop, widths = self.strip.loops[under.nearest], self.widths[under.found]
        for each in np.unique(loop):
            own = loop == each
            away[each] = np.median(under.distance[own])
            width = width_of[each] = float(np.median(widths[own]))
            even = float(np.median(np.abs(widths[own] - width))) <= UNEVEN * width
            seen = KDTree(rest[self.strip.ends[under.nearest[own]].reshape(-1)])
            beside = seen.query(rest[border.vertices[border.loops == each]])[0] < BESIDE
            held[each] = even and bool(beside.mean() >= COVERED)
        shared = away.copy()
        for each in np.flatnonzero(held):
            alike = held & (np.abs(width_of - width_of[each]) <= UNEVEN * width_of[each])
            common = float(np.median(under.distance[alike[loop]]))
            shared[each] = common if abs(common - away[each]) < TOGETHER else away[each]
        return shared, held

    def _without(self, held: np.ndarray, scan: FrameScan, vertices: np.ndarray) -> FrameScan:
        """The scan without the points on borders that are held; each is of the loop it names, or of the nearest."""
        border = self.analysis.border
        nearest = np.asarray(KDTree(vertices[border.vertices]).query(scan.border_points)[1])
        loops = np.where(scan.border_loops >= 0, scan.border_loops, border.loops[nearest])
        kept = ~held[loops]
        return replace(scan, border_points=scan.border_points[kept], border_loops=scan.border_loops[kept])


def _between(vertices: np.ndarray, ends: np.ndarray, place: np.ndarray) -> Float64[np.ndarray, "points 3"]:
    """Points on edges."""
    return (1.0 - place)[:, None] * vertices[ends[:, 0]] + place[:, None] * vertices[ends[:, 1]]
