"""How near a registered sequence, whoever made it, is to the truth of a synthetic take: the report's figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.app.report.metrics import METRICS, summarise, truth_measures
from capture4d.captures.capture import Capture
from capture4d.captures.truth import TruthModel, read_truth_model, read_truth_vertices
from capture4d.captures.work_folder import WorkFolder
from capture4d.errors import InputError
from capture4d.files.atomic import nan_to_none, write_json
from capture4d.runs.workers import run_jobs, shared
from capture4d.types import RegisteredSequence

__all__ = ["Score", "run"]

SCORE = "score.json"


@dataclass(frozen=True, slots=True)
class Score:
    """The figures, as in metrics.json of a report."""

    path: Path
    """Of the JSON that holds them, and those of each frame."""
    frames: int
    """How many of the sequence's were measured."""
    metrics: Mapping[str, float | None]
    without_scan: bool
    """Nothing is known of what was scanned: all vertices count as seen."""


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
    without_scan = not np.isfinite(registered.residual_m).any()
    if without_scan:
        registered = replace(registered, residual_m=np.zeros_like(registered.residual_m))
    known = {*capture.frame_ids}
    rows = [row for row, frame_id in enumerate(registered.frame_ids.tolist()) if frame_id in known]
    if not rows:
        raise InputError("expected frames that the capture has, found none of them", where=work.path)
    scene = _Scene(registered, capture, model)
    jobs = run_jobs(_measure, rows, prepare=shared(scene), workers=workers, label="measure against truth")
    measured = sorted(jobs, key=lambda record: record["frame_id"])
    # Verdicts and costs are a registration's to say; what is measured here is neither.
    graded = [{**record, "verdict": "good", "cpu_s": 0.0} for record in measured]
    found = {key: value for key, value in summarise(graded).items() if key in _keys(measured)}
    shown = [{"key": key, "unit": METRICS[key][0], "value": value} for key, value in found.items()]
    told = {"registration": digest, "capture": str(capture.path), "metrics": shown, "frames": measured}
    write_json(work.path / SCORE, told)
    return Score(work.path / SCORE, len(rows), found, without_scan)


def _keys(measured: list[dict[str, Any]]) -> set[str]:
    return {key for record in measured for key in record} | {"drift_mm_per_frame", "drift_ratio"}


def _measure(scene: _Scene, row: int) -> dict[str, Any]:
    frame_id = int(scene.registered.frame_ids[row])
    truth = read_truth_vertices(scene.capture, frame_id, model=scene.model)
    return nan_to_none({"frame_id": frame_id, **truth_measures(scene.registered, row, scene.model, truth)})
