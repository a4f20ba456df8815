"""How near a registered sequence, whoever made it, is to the truth of a synthetic take: the report's figures.

Which vertices the scan shows is told by where they truly are, not by the registration, so that all sequences of a take
are measured on the same ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from capture4d.app.report.metrics import METRICS, summarise, truth_measures
from capture4d.captures.capture import Capture, read_scan
from capture4d.captures.evaluation import material_points
from capture4d.captures.truth import TruthModel, read_truth_frame, read_truth_model, read_truth_vertices
from capture4d.captures.work_folder import WorkFolder
from capture4d.errors import InputError
from capture4d.files.atomic import nan_to_none, write_json
from capture4d.runs.workers import run_jobs, shared
from capture4d.types import RegisteredSequence

__all__ = ["Score", "run"]

SCORE = "score.json"
SEEN_M = 0.005
"""A vertex is seen where a scan has garment this near to its true place: scans have a point every 1 to 5 mm."""


@dataclass(frozen=True, slots=True)
class Score:
    """The figures, as in metrics.json of a report."""

    path: Path
    """Of the JSON that holds them, and those of each frame."""
    frames: int
    """How many of the sequence's were measured."""
    metrics: Mapping[str, float | None]
    without_scan: int
    """Frames whose scan cannot be read: all vertices count as seen there."""


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    registered: RegisteredSequence
    capture: Capture
    model: TruthModel


def run(work: WorkFolder, capture: Capture, *, workers: int = 1) -> Score:
    """Measure every frame whose truth is known; WORK/score.json.

    Raises:
        InputError: the capture has no truth, it is of another template, or of none of the frames.
    """
    digest, registered, model = work.registered_digest, work.registered, read_truth_model(capture)
    if model is None:
        raise InputError("expected the truth of a synthetic take in truth/, found none", where=capture.path)
    count = len(registered.garment.template.vertices)
    if count != len(model.template_faces):
        expected = f"the capture's template, of {len(model.template_faces)} vertices"
        raise InputError(f"expected {expected}, found one of {count}", where=work.path)
    known = {*capture.frame_ids}
    rows = [row for row, frame_id in enumerate(registered.frame_ids.tolist()) if frame_id in known]
    if not rows:
        raise InputError("expected frames that the capture has, found none of them", where=work.path)
    scene = _Scene(registered, capture, model)
    jobs = run_jobs(_measure, rows, prepare=shared(scene), workers=workers, label="measure against truth")
    found_all = sorted(jobs, key=lambda job: job[0]["frame_id"])
    measured = [record for record, _ in found_all]
    # Verdicts and costs are a registration's to say; what is measured here is neither.
    graded = [{**record, "verdict": "good", "cpu_s": 0.0} for record in measured]
    found = {key: value for key, value in summarise(graded).items() if key in _keys(measured)}
    shown = [{"key": key, "unit": METRICS[key][0], "value": value} for key, value in found.items()]
    told = {"registration": digest, "capture": str(capture.path), "metrics": shown, "frames": measured}
    write_json(work.path / SCORE, told)
    return Score(work.path / SCORE, len(rows), found, sum(not read for _, read in found_all))


def _keys(measured: list[dict[str, Any]]) -> set[str]:
    return {key for record in measured for key in record} | {"drift_mm_per_frame", "drift_ratio"}


def _measure(scene: _Scene, row: int) -> tuple[dict[str, Any], bool]:
    """The figures of a frame, and whether its scan told what is seen."""
    frame_id = int(scene.registered.frame_ids[row])
    truth = read_truth_vertices(scene.capture, frame_id, model=scene.model)
    points = _garment_points(scene.capture, frame_id)
    covered = np.ones(len(scene.model.template_faces), bool)
    if points is not None:
        model = scene.model
        places = material_points(truth, model.fine.faces, model.template_faces, model.template_barycentric)
        covered = np.isfinite(KDTree(points).query(places, distance_upper_bound=SEEN_M)[0])
    measures = truth_measures(scene.registered, row, scene.model, truth, covered=covered)
    return nan_to_none({"frame_id": frame_id, **measures}), points is not None


def _garment_points(capture: Capture, frame_id: int) -> np.ndarray | None:
    """Points of a scan that are garment or its paint, by the truth; None if the scan cannot be read."""
    try:
        points = read_scan(capture, frame_id).mesh.vertices
    except InputError:
        return None
    labels = read_truth_frame(capture, frame_id).labels
    return points[labels > 0] if len(labels) == len(points) else points
