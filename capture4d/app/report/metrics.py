"""What the report says about a take: the metrics, from the frames' records and from the truth.

docs/reference/report.md explains them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from capture4d.captures.evaluation import (
    border_errors,
    correspondence_errors,
    drift_per_frame,
    drift_ratio,
    material_points,
    truth_distances,
)
from capture4d.captures.truth import TruthModel
from capture4d.captures.work_folder import VERDICTS
from capture4d.types import RegisteredSequence

__all__ = ["METRICS", "column", "own_measures", "region_rows", "shown", "summarise", "truth_measures"]

FAR_MM = 2.0
"""A vertex farther off than this is counted in `..._beyond_percent`."""

METRICS: Mapping[str, tuple[str, str, str]] = {
    "fit_mean_mm": ("mm", "lower", "template vertices to the scan's surface, where it has data"),
    "fit_p95_mm": ("mm", "lower", "the same, 95th percentile of a frame"),
    "fit_p99_mm": ("mm", "lower", "the same, 99th percentile of a frame"),
    "fit_max_mm": ("mm", "lower", "the same, the farthest vertex of the take"),
    "fit_beyond_percent": ("%", "lower", "template vertices with scan data that are more than 2 mm from it"),
    "scan_fit_mean_mm": ("mm", "lower", "scan points to the template"),
    "scan_fit_p95_mm": ("mm", "lower", "the same, 95th percentile of a frame"),
    "boundary_mean_mm": ("mm", "lower", "template border to the painted border of the scan, and back"),
    "boundary_p95_mm": ("mm", "lower", "the same, 95th percentile of a frame"),
    "covered_percent": ("%", "higher", "template vertices with scan data"),
    "stretch_p99": (
        "",
        "lower",
        "edge length over that on the pattern, or the template without one, 99th percentile of a frame",
    ),
    "stretch_p99_worst": ("", "lower", "the same of the worst frame"),
    "flipped_faces": ("", "lower", "faces against the scan they lie on, per frame"),
    "self_intersections": ("", "lower", "faces that cut another, per frame"),
    "creased_percent": ("%", "lower", "edges folded by more than 60 degrees, though not at rest"),
    "seam_mm": ("mm", "lower", "what joining two segments adds to a frame's motion, worst frame"),
    "frames_good_percent": ("%", "higher", "frames with the verdict good"),
    "frames_check": ("", "lower", "frames with the verdict check"),
    "frames_failed": ("", "lower", "frames with the verdict failed"),
    "cpu_s": ("s", "lower", "CPU time per frame, median"),
    "track_good_percent": ("%", "higher", "frames in which the tracked body has the verdict good"),
    "track_median_mm": ("mm", "lower", "points on skin and suit to the tracked body, median of a frame"),
    "track_cpu_s": ("s", "lower", "CPU time of tracking per frame, median"),
    "joint_mean_mm": ("mm", "lower", "tracked joints that were seen to their true places"),
    "joint_max_mm": ("mm", "lower", "the same, worst joint of a frame"),
    "truth_distance_mean_mm": ("mm", "lower", "template vertices with scan data to the noise-free surface"),
    "truth_distance_p95_mm": ("mm", "lower", "the same, 95th percentile of a frame"),
    "truth_distance_p99_mm": ("mm", "lower", "the same, 99th percentile of a frame"),
    "truth_distance_max_mm": ("mm", "lower", "the same, the farthest vertex of the take"),
    "truth_distance_beyond_percent": ("%", "lower", "of the same vertices, those more than 2 mm off"),
    "truth_hidden_mean_mm": ("mm", "lower", "template vertices without scan data to the noise-free surface"),
    "truth_hidden_p95_mm": ("mm", "lower", "the same, 95th percentile of a frame"),
    "truth_return_mean_mm": ("mm", "lower", "the noise-free surface to the template"),
    "truth_return_p95_mm": ("mm", "lower", "the same, 95th percentile of a frame"),
    "correspondence_mean_mm": ("mm", "lower", "template vertices to the true places of the same material"),
    "correspondence_p95_mm": ("mm", "lower", "the same, 95th percentile of a frame"),
    "drift_mm_per_frame": ("mm", "lower", "slope of the correspondence error over the frames"),
    "drift_ratio": ("", "lower", "correspondence error of the last 20 frames over that of the first 20"),
    "border_mean_mm": ("mm", "lower", "template border to the true border curve, and back"),
    "border_p95_mm": ("mm", "lower", "the same, 95th percentile of a frame"),
}
"""Unit, better direction and meaning of every metric. Unless it says otherwise, it is the mean over the frames."""

OF_FRAMES = ("joint_max_mm",)
"""Largest of a frame, averaged over the frames; the other largest ones are those of the take."""
REGION_MEASURES: Mapping[str, Callable[[np.ndarray], Any]] = {
    "fit_p95_mm": np.mean,
    "fit_max_mm": np.max,
    "fit_beyond_percent": np.max,
    "cut_percent": np.max,
    "creased_percent": np.max,
    "covered_percent": np.min,
}


def summarise(records: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """The take's metrics from its frames' records; None where no frame has the number."""
    count = {verdict: sum(record["verdict"] == verdict for record in records) for verdict in VERDICTS}
    special = {
        "frames_good_percent": 100 * count["good"] / len(records),
        "frames_check": float(count["check"]),
        "frames_failed": float(count["failed"]),
        "cpu_s": float(np.nanmedian(column(records, "cpu_s"))),
    }
    stretch = column(records, "stretch_p99")
    if np.isfinite(stretch).any():
        special["stretch_p99_worst"] = float(np.nanmax(stretch))
    seams = column([record for record in records if "seam_mm" in record], "seam_mm")
    if len(seams):
        special["seam_mm"] = float(seams.max())
    summary: dict[str, float | None] = {}
    correspondence = column(records, "correspondence_mean_mm")
    measured = np.flatnonzero(np.isfinite(correspondence))
    if len(measured) > 1:
        gap = (measured[-1] - measured[0]) / (len(measured) - 1)
        special["drift_mm_per_frame"] = drift_per_frame(correspondence[measured]) / gap
        special["drift_ratio"] = drift_ratio(correspondence[measured])
    for key in METRICS:
        if key in special:
            summary[key] = special[key]
        elif any(key in record for record in records):
            values = column(records, key)
            found = values[np.isfinite(values)]
            of_take = np.max if key.endswith("_max_mm") and key not in OF_FRAMES else np.mean
            summary[key] = float(of_take(found)) if len(found) else None
    return summary


def region_rows(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float | None]]:
    """Of each region of the garment: its usual fit, and its worst frame in every other measure.

    Empty where the registration has not told regions apart.
    """
    found: dict[str, list[Mapping[str, Any]]] = {}
    for record in records:
        for name, measures in record.get("regions", {}).items():
            found.setdefault(name, []).append(measures)

    def over(name: str, key: str, how: Callable[[np.ndarray], Any]) -> float | None:
        values = column(found[name], key)
        values = values[np.isfinite(values)]
        return float(how(values)) if len(values) else None

    return {name: {key: over(name, key, how) for key, how in REGION_MEASURES.items()} for name in found}


def truth_measures(
    registered: RegisteredSequence,
    row: int,
    model: TruthModel,
    truth_vertices: np.ndarray,
    *,
    covered: np.ndarray | None = None,
) -> dict[str, float]:
    """The measures against truth of one frame, millimetres.

    Args:
        covered: (V,) bool, vertices that the scan shows; those that were registered to it if absent.
    """
    garment = registered.garment
    vertices = np.asarray(registered.vertices[row])
    mesh, truth = garment.template.with_vertices(vertices), model.fine.with_vertices(truth_vertices)
    seen = np.isfinite(registered.residual_m[row]) if covered is None else covered
    away, back = truth_distances(mesh, truth)
    there, hidden = away[seen], away[~seen]
    places = material_points(truth_vertices, truth.faces, model.template_faces, model.template_barycentric)
    border = border_errors(
        {name: vertices[loop] for name, loop in garment.loops.items()},
        {name: truth_vertices[loop] for name, loop in model.loops.items()},
    )
    measures = {}
    for name, errors in (
        ("truth_distance", there),
        ("truth_hidden", hidden),
        ("truth_return", back),
        ("correspondence", correspondence_errors(vertices, places)),
        ("border", border),
    ):
        if len(errors):
            measures[f"{name}_mean_mm"] = 1e3 * float(errors.mean())
            measures[f"{name}_p95_mm"] = 1e3 * float(np.percentile(errors, 95))
    if len(there):
        measures["truth_distance_p99_mm"] = 1e3 * float(np.percentile(there, 99))
        measures["truth_distance_max_mm"] = 1e3 * float(there.max())
        measures["truth_distance_beyond_percent"] = 100 * float((1e3 * there > FAR_MM).mean())
    return measures


def own_measures(
    records: Sequence[Mapping[str, Any]],
    registered: Sequence[Mapping[str, Any]],
    tracked: Sequence[Mapping[str, Any]] = (),
) -> list[dict[str, Any]]:
    """What the report alone has measured of each frame, against the truth, for who compares reports.

    Args:
        records: the frames' records with all measures; `registered`, those that the registration has written.
        tracked: tracking's records, with the measures of joints.
    """
    joints = {record["frame_id"]: record for record in tracked}
    rows = []
    for record, written in zip(records, registered, strict=True):
        found = {key: value for key, value in record.items() if key not in written}
        joint = joints.get(record["frame_id"], {})
        found |= {key: joint[key] for key in ("joint_mean_mm", "joint_max_mm") if key in joint}
        if found:
            rows.append({"frame_id": record["frame_id"], **found})
    return rows


def column(records: Sequence[Mapping[str, Any]], key: str) -> np.ndarray:
    """One number of every frame; NaN where it was not measured."""
    return np.array([math.nan if record.get(key) is None else record[key] for record in records], float)


def shown(value: float | None) -> str:
    """A figure as pages print it: whole numbers whole, others with three digits, a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == round(value) and abs(value) < 1e6:
        return f"{value:.0f}"
    return f"{value:.3g}"
