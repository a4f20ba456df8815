"""How good a registered frame is, from the scan alone: numbers, and a verdict with its reasons.

fit          template vertex to the scan's surface, over vertices with scan data; and scan point to template
border       template border to painted points, and painted points to the template's border curve
stretch      edge lengths over the template's
flips        faces that look the other way than the scan they lie on
intersections  faces that cut another face of the template

All but the intersections are also told vertex by vertex.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree

from capture4d.geometry.mesh import edge_lengths, edge_stretch, stretch_p99
from capture4d.geometry.point_grid import PointGrid
from capture4d.geometry.triangles import count_intersecting_faces, fan_distances
from registration.config import QualityConfig
from registration.correspondences import mesh_normals
from registration.register import FrameScan
from registration.template import TemplateAnalysis

__all__ = ["FrameQuality", "assess", "border_distances"]

Verdict = Literal["good", "check", "failed"]

COVERED_SPACINGS = 2.5
"""A vertex has scan data if a scan point lies within this many scan spacings of it, measured along the surface."""

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

    @staticmethod
    def unmeasured(count: int, reason: str) -> FrameQuality:
        """Of a frame with `count` vertices that failed before there was anything to measure."""
        nothing = np.full(count, np.nan)
        return FrameQuality("failed", (reason,), nothing, nothing, nothing, np.zeros(count, bool), {})

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
    length_factor: float = 1.0,
) -> FrameQuality:
    """Measure a registered frame against its scan.

    Args:
        length_factor: lengths are reported times this; the limits hold for them as they are.
    """
    normals = mesh_normals(vertices, analysis.faces)
    distance, nearest = scan.surface.grid.query(vertices)
    offset = vertices - scan.surface.points[nearest]
    scan_normals = scan.surface.normals[nearest]
    height = np.abs(np.einsum("va,va->v", offset, scan_normals))
    sideways = np.sqrt(np.maximum(distance**2 - height**2, 0.0))
    covered = sideways <= COVERED_SPACINGS * scan.surface.spacing
    residual = np.where(covered, height, np.nan)
    stretch = edge_stretch(vertices, analysis.edges, edge_lengths(analysis.rest, analysis.edges))
    against = (np.einsum("va,va->v", normals, scan_normals) < 0.0) & covered
    flipped = against[analysis.faces].all(axis=1)
    flipped_vertices = np.zeros(len(vertices), bool)
    flipped_vertices[analysis.faces[flipped]] = True
    at_vertices, border = _border_errors(analysis, scan, vertices)
    stride = max(1, len(scan.surface.points) // 4000)
    scan_fit = 1e3 * _points_to_template(scan.surface.points[::stride], vertices, analysis)
    fit = 1e3 * residual[covered]
    numbers = {
        "fit_mean_mm": _mean(fit),
        "fit_p95_mm": _percentile(fit, 95),
        "scan_fit_mean_mm": _mean(scan_fit),
        "scan_fit_p95_mm": _percentile(scan_fit, 95),
        "boundary_mean_mm": _mean(1e3 * border),
        "boundary_p95_mm": _percentile(1e3 * border, 95),
        "stretch_p99": stretch_p99(stretch),
        "flipped_faces": int(flipped.sum()),
        "self_intersections": count_intersecting_faces(vertices, analysis.faces),
        "covered_percent": 100.0 * float(covered.mean()),
    }
    verdict, reasons = _judge(numbers, len(analysis.faces), config, length_factor)
    return FrameQuality(
        verdict=verdict,
        reasons=reasons,
        residual_m=residual * length_factor,
        border_error_m=at_vertices * length_factor,
        stretch=_mean_of_edges(stretch, analysis.edges, len(vertices)),
        flipped=flipped_vertices,
        numbers={key: value * length_factor if key.endswith("_mm") else value for key, value in numbers.items()},
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


def _mean_of_edges(values: np.ndarray, edges: np.ndarray, count: int) -> Float64[np.ndarray, " verts"]:
    """Mean over the edges at each vertex; NaN where there are none."""
    ends = edges.T.reshape(-1)
    number = np.bincount(ends, minlength=count)
    return np.where(number > 0, np.bincount(ends, np.tile(values, 2), count) / np.maximum(number, 1), np.nan)


def _points_to_template(points: np.ndarray, vertices: np.ndarray, analysis: TemplateAnalysis) -> np.ndarray:
    """Distance to the faces around each point's nearest template vertex, metres."""
    used = np.unique(analysis.faces)
    cell = 2.0 * float(analysis.rest_lengths.mean())
    nearest = used[PointGrid.build(vertices[used], cell).query(points)[1]]
    return fan_distances(points, nearest, vertices, analysis.faces, analysis.fan_offsets, analysis.fan_faces)


def _judge(
    numbers: Mapping[str, float], faces: int, config: QualityConfig, length_factor: float
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
    if covered < config.min_covered_percent:
        failed.append(f"scan data for {covered:.0f} % < {config.min_covered_percent:g} % of vertices")
    if failed:
        return "failed", tuple(failed)
    return ("check", tuple(check)) if check else ("good", ())


def _short(value: float) -> str:
    return f"{value:.2f}" if value >= 0.1 else f"{value:.2g}"


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _percentile(values: np.ndarray, percent: float) -> float:
    return float(np.percentile(values, percent)) if len(values) else float("nan")
