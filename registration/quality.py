"""How good a registered frame is, from the scan alone: numbers, and a verdict with its reasons.

fit          template vertex to the scan's surface, over vertices with scan data; and scan point to template
border       template border to painted points, and painted points to the template's border curve
stretch      edge lengths over the template's
flips        faces that look the other way than the scan they lie on
intersections  faces that cut another face of the template
creases      edges that are folded sharply, though they are not at rest

All but the last two are also told vertex by vertex; what an eye judges place by place is told, and judged, region by
region as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64
from scipy.spatial import KDTree

from capture4d.geometry.mesh import edge_lengths, edge_stretch, stretch_p99
from capture4d.geometry.point_grid import PointGrid
from capture4d.geometry.triangles import fan_distances, self_intersections
from registration.config import QualityConfig
from registration.correspondences import ScanSurface, mesh_normals, of_another_part
from registration.register import FrameScan
from registration.template import TemplateAnalysis, fold_cosines

__all__ = ["REGION_MEASURES", "FrameQuality", "assess", "border_distances", "scan_distances"]

Verdict = Literal["good", "check", "failed"]

REGION_MEASURES = (
    "fit_p95_mm",
    "fit_max_mm",
    "fit_beyond_percent",
    "cut_percent",
    "creased_percent",
    "covered_percent",
)
"""What is told of each region: as in the whole frame; and shares of its faces that cut others."""

COVERED_SPACINGS = 2.0
"""A vertex has scan data if a scan point lies within this many scan spacings of it, measured along the surface."""

FAR_MM = 2.0
"""A vertex farther from its scan is far off: ten times the usual fit, and what one sees in a picture of the frame."""

PART_EDGES, PART_SHARE = 1.5, 0.7
"""Cloth farther away than so many mean edges at rest is another part of the template; a scan point shows that part, and
not the vertex it was found for, if it is nearer by this share. Stricter than in matching: what is left out here misses
in the measure only. Of what these leave out 98 % had no scan point within 5 mm of its true place."""

LOOKED_AT_SPACINGS = 2.0
"""A vertex farther than so many scan spacings from a surface that faces the other way lies behind it, unseen."""

CREASE_DEG = 60.0
"""An edge whose faces turn from each other by more, and by less at rest, is creased."""

BORDER_SEEN = 0.02
"""A border vertex without a painted point this near, metres, lies where the scan does not show the border."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameQuality:
    """Numbers, verdict and reasons of one frame."""

    verdict: Verdict
    reasons: tuple[str, ...]
    residual_m: Float64[np.ndarray, " verts"]
    """Distance to the scan's surface; NaN where the scan has no data near the vertex."""
    border_error_m: Float64[np.ndarray, " verts"]
    """Of border vertices, distance to the nearest painted point; NaN elsewhere, and where the scan does not show the
    border."""
    stretch: Float64[np.ndarray, " verts"]
    """Mean over the vertex's edges of their length over the template's; NaN without edges."""
    flipped: Bool[np.ndarray, " verts"]
    """Whether a face around the vertex looks the other way than the scan."""
    numbers: Mapping[str, float]
    """fit_mean_mm, fit_p95_mm, scan_fit_mean_mm, ..., as in metrics.jsonl; NaN where there is nothing to measure."""
    regions: Mapping[str, Mapping[str, float]]
    """The same of each region, as far as it is told there: `REGION_MEASURES`."""

    @staticmethod
    def unmeasured(count: int, reason: str) -> FrameQuality:
        """Of a frame with `count` vertices that failed before there was anything to measure."""
        nothing = np.full(count, np.nan)
        return FrameQuality("failed", (reason,), nothing, nothing, nothing, np.zeros(count, bool), {}, {})

    def vertex_arrays(self) -> dict[str, np.ndarray]:
        """What is known vertex by vertex, by name, as it is stored: (V,) float32 and bool."""
        return {
            "residual_m": self.residual_m.astype(np.float32),
            "border_error_m": self.border_error_m.astype(np.float32),
            "stretch": self.stretch.astype(np.float32),
            "flipped": self.flipped,
        }


def assess(
    analysis: TemplateAnalysis,
    scan: FrameScan,
    vertices: Float64[np.ndarray, "verts 3"],
    config: QualityConfig,
    *,
    regions: Mapping[str, Int32[np.ndarray, " region"]] | None = None,
    length_factor: float = 1.0,
) -> FrameQuality:
    """Measure a registered frame against its scan.

    Args:
        regions: vertices of each, as `registration.regions.find_regions` finds them.
        length_factor: lengths are reported times this; the limits hold for them as they are.
    """
    facing, height, covered = _seen(analysis, scan.surface, vertices, config.unfitted_mm / 1e3)
    residual = np.where(covered, height, np.nan)
    stretch = edge_stretch(vertices, analysis.edges, edge_lengths(analysis.rest, analysis.edges))
    against = (facing < 0.0) & covered
    flipped = against[analysis.faces].all(axis=1)
    flipped_vertices = np.zeros(len(vertices), bool)
    flipped_vertices[analysis.faces[flipped]] = True
    at_vertices, border = _border_errors(analysis, scan, vertices)
    scan_fit = 1e3 * scan_distances(analysis, scan, vertices)[0]
    fit = 1e3 * residual[covered]
    cut, creased = self_intersections(vertices, analysis.faces), _creased(analysis, vertices)
    numbers = {
        "fit_mean_mm": _mean(fit),
        "fit_p95_mm": _percentile(fit, 95),
        "fit_p99_mm": _percentile(fit, 99),
        "fit_max_mm": float(fit.max()) if len(fit) else float("nan"),
        "fit_beyond_percent": _mean(100.0 * (fit > FAR_MM)),
        "unfitted_vertices": int((fit > config.unfitted_mm).sum()) if config.unfitted_mm > 0.0 else 0,
        "scan_fit_mean_mm": _mean(scan_fit),
        "scan_fit_p95_mm": _percentile(scan_fit, 95),
        "boundary_mean_mm": _mean(1e3 * border),
        "boundary_p95_mm": _percentile(1e3 * border, 95),
        "stretch_p99": stretch_p99(stretch),
        "flipped_faces": int(flipped.sum()),
        "self_intersections": int(cut.sum()),
        "creased_percent": _mean(100.0 * creased),
        "covered_percent": 100.0 * float(covered.mean()),
    }
    told = {name: _of_region(analysis, members, residual, cut, creased) for name, members in (regions or {}).items()}
    verdict, reasons = _judge(numbers, told, len(analysis.faces), config, length_factor)
    return FrameQuality(
        verdict=verdict,
        reasons=reasons,
        residual_m=residual * length_factor,
        border_error_m=at_vertices * length_factor,
        stretch=_mean_of_edges(stretch, analysis.edges, len(vertices)),
        flipped=flipped_vertices,
        numbers=_scaled(numbers, length_factor),
        regions={name: _scaled(measures, length_factor) for name, measures in told.items()},
    )


def border_distances(
    analysis: TemplateAnalysis, scan: FrameScan, vertices: Float64[np.ndarray, "verts 3"]
) -> Float64[np.ndarray, " distances"]:
    """Distances, metres, from border vertices to painted points and from painted points to the border curve.

    Points of one loop are compared with that loop where the paint tells, others with the loops that no point names.
    Border vertices without painted points nearby are left out: there the scan does not show the border. A border that
    is far from its paint is noticed by the paint.
    """
    return _border_errors(analysis, scan, vertices)[1]


def _border_errors(
    analysis: TemplateAnalysis, scan: FrameScan, vertices: np.ndarray
) -> tuple[Float64[np.ndarray, " verts"], Float64[np.ndarray, " distances"]]:
    """Distance from each vertex to the paint, NaN but for border vertices that are seen; and all `border_distances`."""
    border = analysis.border
    at_vertices = np.full(len(vertices), np.nan)
    found: list[np.ndarray] = []
    for loop in np.unique(scan.border_loops):
        painted = scan.border_points[scan.border_loops == loop]
        own = ~np.isin(border.loops, scan.border_loops) if loop < 0 else border.loops == loop
        start, end = vertices[border.vertices[own]], vertices[border.after[own]]
        if not len(start) or not len(painted):
            continue
        distances = np.asarray(KDTree(painted).query(start)[0])
        seen = distances < BORDER_SEEN
        at_vertices[border.vertices[own][seen]] = distances[seen]
        found.append(distances[seen])
        steps = np.linspace(0.0, 1.0, 8, endpoint=False)[:, None, None]
        found.append(KDTree(((1.0 - steps) * start + steps * end).reshape(-1, 3)).query(painted)[0])
    return at_vertices, np.concatenate(found) if found else np.zeros(0)


def _seen(
    analysis: TemplateAnalysis, surface: ScanSurface, vertices: np.ndarray, unfitted: float
) -> tuple[Float64[np.ndarray, " verts"], Float64[np.ndarray, " verts"], Bool[np.ndarray, " verts"]]:
    """Of each vertex the cosine to the nearest scan point's normal, the distance to its plane, and whether the scan
    shows the vertex at all.

    Cloth in an armpit lies 2 to 5 cm behind the sleeve that hides it. That distance is no error, and the true cloth has
    it, too: what is nearest there is the scan of another part, or faces the other way. And cloth that is crumpled
    behind itself, farther than `unfitted` (metres; 0: no such cloth), finds only scan that other faces fit.
    """
    distance, nearest = surface.grid.query(vertices)
    points, normals = surface.points[nearest], surface.normals[nearest]
    above = np.einsum("va,va->v", vertices - points, normals)
    height = np.abs(above)
    sideways = np.sqrt(np.maximum(distance**2 - height**2, 0.0))
    facing = np.einsum("va,va->v", mesh_normals(vertices, analysis.faces), normals)
    away = distance > LOOKED_AT_SPACINGS * surface.spacing
    reach = PART_EDGES * float(analysis.rest_lengths.mean())
    every, doubtful = np.arange(len(vertices)), np.where(away, distance, 0.0)
    foreign = of_another_part(points, doubtful, every, vertices, analysis.rest, share=PART_SHARE, reach=reach)
    hidden = foreign | (away & (facing < 0.0))
    covered = (sideways <= COVERED_SPACINGS * surface.spacing) & ~hidden
    within = covered & (height > unfitted) & ((above < 0.0) | (facing < 0.0))
    doubted = np.flatnonzero(within) if unfitted > 0.0 else np.zeros(0, np.int64)
    if len(doubted):
        covered[doubted] = _face_distances(analysis, vertices, points[doubted])[0] > unfitted
    return facing, height, covered


def _creased(analysis: TemplateAnalysis, vertices: np.ndarray) -> Bool[np.ndarray, " edges"]:
    """Which edges are folded sharply now, but not at rest."""
    sharp = np.cos(np.radians(CREASE_DEG))
    return (fold_cosines(vertices, analysis.faces, analysis.edge_faces) < sharp) & (analysis.rest_folds >= sharp)


def _of_region(
    analysis: TemplateAnalysis, members: np.ndarray, residual: np.ndarray, cut: np.ndarray, creased: np.ndarray
) -> dict[str, float]:
    """The measures of a region; a face or an edge is in the region of its first vertex."""
    inside = np.zeros(len(residual), bool)
    inside[members] = True
    fit = 1e3 * residual[members]
    fit = fit[np.isfinite(fit)]
    return {
        "fit_p95_mm": _percentile(fit, 95),
        "fit_max_mm": float(fit.max()) if len(fit) else float("nan"),
        "fit_beyond_percent": _mean(100.0 * (fit > FAR_MM)),
        "cut_percent": _mean(100.0 * cut[inside[analysis.faces[:, 0]]]),
        "creased_percent": _mean(100.0 * creased[inside[analysis.edges[:, 0]]]),
        "covered_percent": 100.0 * len(fit) / len(members),
    }


def _scaled(numbers: Mapping[str, float], factor: float) -> dict[str, float]:
    """Lengths times a factor, other numbers as they are."""
    return {key: value * factor if key.endswith("_mm") else value for key, value in numbers.items()}


def _mean_of_edges(values: np.ndarray, edges: np.ndarray, count: int) -> Float64[np.ndarray, " verts"]:
    """Mean over the edges at each vertex; NaN where there are none."""
    ends = edges.T.reshape(-1)
    number = np.bincount(ends, minlength=count)
    return np.where(number > 0, np.bincount(ends, np.tile(values, 2), count) / np.maximum(number, 1), np.nan)


def scan_distances(
    analysis: TemplateAnalysis, scan: FrameScan, vertices: Float64[np.ndarray, "verts 3"]
) -> tuple[Float64[np.ndarray, " points"], Int64[np.ndarray, " points"]]:
    """Of some 4,000 scan points, the distance to the faces around each one's nearest template vertex, metres; and that
    vertex."""
    return _face_distances(analysis, vertices, scan.surface.points[:: max(1, len(scan.surface.points) // 4000)])


def _face_distances(
    analysis: TemplateAnalysis, vertices: np.ndarray, points: np.ndarray
) -> tuple[Float64[np.ndarray, " points"], Int64[np.ndarray, " points"]]:
    """Of each point, the distance to the faces around its nearest template vertex, metres; and that vertex."""
    used = np.unique(analysis.faces)
    cell = 2.0 * float(analysis.rest_lengths.mean())
    nearest = used[PointGrid.build(vertices[used], cell).query(points)[1]]
    away = fan_distances(points, nearest, vertices, analysis.faces, analysis.fan_offsets, analysis.fan_faces)
    return away, nearest.astype(np.int64)


def _judge(
    numbers: Mapping[str, float],
    regions: Mapping[str, Mapping[str, float]],
    faces: int,
    config: QualityConfig,
    length_factor: float,
) -> tuple[Verdict, tuple[str, ...]]:
    """The verdict, and why; the reasons give value and limit with lengths times `length_factor`."""
    share = 100.0 / max(faces, 1)
    flipped, cut = numbers["flipped_faces"] * share, numbers["self_intersections"] * share
    covered = numbers["covered_percent"]
    check, failed = [], []
    for name, value, doubtful, wrong, unit in (
        ("fit_mean_mm", numbers["fit_mean_mm"], config.fit_check_mm, config.fit_fail_mm, " mm"),
        ("boundary_mean_mm", numbers["boundary_mean_mm"], config.boundary_check_mm, config.boundary_fail_mm, " mm"),
        ("stretch_p99", numbers["stretch_p99"], config.stretch_check, config.stretch_fail, ""),
        ("flipped faces", flipped, config.flipped_check_percent, np.inf, " %"),
        ("self-intersecting faces", cut, config.intersections_check_percent, np.inf, " %"),
    ):
        factor = length_factor if unit == " mm" else 1.0
        if value > wrong:
            failed.append(f"{name} {_short(value * factor)} > {wrong * factor:.4g}{unit}")
        elif value > doubtful:
            check.append(f"{name} {_short(value * factor)} > {doubtful * factor:.4g}{unit}")
    if numbers["unfitted_vertices"] * share > config.unfitted_check_percent / 2.0:  # two faces to a vertex
        limit = config.unfitted_mm * length_factor
        check.append(f"{numbers['unfitted_vertices']} vertices with scan data more than {limit:.4g} mm from it")
    check += _doubts_of_regions(regions, config, length_factor)
    if covered < config.min_covered_percent:
        failed.append(f"scan data for {covered:.0f} % < {config.min_covered_percent:g} % of vertices")
    if failed:
        return "failed", tuple(failed)
    return ("check", tuple(check)) if check else ("good", ())


def _doubts_of_regions(
    regions: Mapping[str, Mapping[str, float]], config: QualityConfig, length_factor: float
) -> list[str]:
    """What an eye would stop at, the worst region of each kind; the others are counted."""
    doubts = []
    for key, limit, what in (
        ("fit_beyond_percent", config.region_far_percent, f"of its vertices beyond {FAR_MM * length_factor:g} mm"),
        ("cut_percent", config.region_cut_percent, "of its faces cut others"),
        ("creased_percent", config.region_creased_percent, "of its edges are creased"),
    ):
        broken = {name: measures[key] for name, measures in regions.items() if measures[key] > limit}
        if broken:
            worst = max(broken, key=lambda name: broken[name])
            others = f", and in {len(broken) - 1} more" if len(broken) > 1 else ""
            doubts.append(f"{worst}: {broken[worst]:.1f} % {what} > {limit:g} %{others}")
    return doubts


def _short(value: float) -> str:
    return f"{value:.2f}" if value >= 0.1 else f"{value:.2g}"


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _percentile(values: np.ndarray, percent: float) -> float:
    """`np.percentile`, whose checks take longer than a region's few hundred values."""
    if not len(values):
        return float("nan")
    place = percent / 100.0 * (len(values) - 1)
    lower = int(place)
    upper = min(lower + 1, len(values) - 1)
    found = np.partition(values, (lower, upper))
    return float(found[lower] + (found[upper] - found[lower]) * (place - lower))
