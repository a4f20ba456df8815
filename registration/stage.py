"""The registration stage: CAPTURE and WORK/garment in, WORK/registration out.

stage.json                what was run
garment.npz               the template
frames/000123.npz         vertices (V, 3) float32, verdict (0 good, 1 check, 2 failed), and per vertex (V,) residual_m,
                          border_error_m, stretch float32 and flipped bool, as in `FrameQuality`
metrics/000123.json       the frame's numbers, reasons and CPU time
vertices.npy              (T, V, 3) float32, all frames
metrics.jsonl             the frames' metrics, one per line
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from capture4d.body.binding import with_body_shape
from capture4d.captures.capture import (
    Capture,
    capture_digest,
    motion_digest,
    read_capture,
    read_template,
    template_digest,
)
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.work_folder import (
    REGISTER,
    VERDICTS,
    captured_motion,
    load_tracking,
    stack_vertices,
    tracking_digest,
)
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_bytes, write_json, write_npz
from capture4d.files.records import save_garment
from capture4d.runs.stage import Stage, StageResult, open_stage, require_complete
from capture4d.runs.workers import run_jobs
from capture4d.types import Body, Garment, PoseSequence
from registration.config import RegistrationConfig
from registration.sequence import FrameResult, Mover, register_run, segments
from registration.template import TemplateAnalysis, analyse_template

__all__ = ["run"]

SCHEMA = 3


@dataclass(frozen=True, slots=True)
class SegmentJob:
    """A segment of the take for one worker."""

    capture: Path
    garment_folder: Path
    body_folder: Path | None
    stage: Stage
    positions: range


def run(
    capture: Path,
    garment_folder: Path,
    output: Path,
    config: RegistrationConfig,
    *,
    body_folder: Path | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Register the template to every frame that has none yet.

    Args:
        body_folder: tracked body to move the template with; None takes the poses that the capture brings.
    Raises:
        InputError: the capture or the garments are missing or unfinished, the garments are those of another capture, or
            poses, body and template disagree.
    """
    description = read_capture(capture)
    command = f"capture4d extract {capture} --output {output.parent}"
    made_from = {"capture": capture_digest(description)}
    upstream = {
        "garment": require_complete(garment_folder, "extract", command, made_from=made_from),
        "template": template_digest(description),
    }
    if body_folder is not None:
        upstream["body"] = tracking_digest(body_folder, capture)
    elif digest := motion_digest(description):
        upstream["motion"] = digest
    stage = open_stage(output, name=REGISTER, schema=SCHEMA, config=config, upstream=upstream, overwrite=overwrite)
    _analysis.cache_clear()
    garment = _template(description, body_folder)
    if description.boundary_colours and not garment.loops:
        raise InputError(f"{capture}: expected a template with open borders, as its scans have; found none")
    if not (output / "garment.npz").is_file():
        save_garment(output / "garment.npz", garment)
    mover = _mover(description, body_folder, _analysis(capture, body_folder, config))
    frame_ids = description.frame_ids
    pending = set(stage.pending(frame_ids))
    jobs = [
        SegmentJob(capture, garment_folder, body_folder, stage, positions)
        for positions in segments(mover, len(frame_ids), config.sequence)
        if pending.intersection(frame_ids[position] for position in positions)
    ]
    for _ in run_jobs(
        partial(_register_job, config), jobs, workers=workers, label="register", units=lambda job: len(job.positions),
        finished=stage.count,
    ):  # fmt: skip
        pass
    gathered = all((output / name).is_file() for name in ("vertices.npy", "metrics.jsonl"))
    changed = bool(pending) or not gathered or not stage.was_complete
    if changed:
        _gather(stage, frame_ids)
    frames = [stage.frame_path(frame_id) for frame_id in frame_ids]
    return stage.finish([output / "garment.npz", output / "vertices.npy", *frames], changed=changed)


def _moving(capture: Capture, body_folder: Path | None) -> tuple[Body | None, PoseSequence | None]:
    """The body and its poses: those that were tracked, or those of the capture."""
    if body_folder is None:
        return captured_motion(capture)
    return load_tracking(body_folder)


def _template(capture: Capture, body_folder: Path | None) -> Garment:
    """The template on the person who moves it."""
    garment = read_template(capture)
    body, poses = _moving(capture, body_folder)
    return garment if body is None or poses is None else with_body_shape(garment, body, poses.shape)


def _mover(capture: Capture, body_folder: Path | None, analysis: TemplateAnalysis) -> Mover | None:
    return Mover.create(analysis, *_moving(capture, body_folder))


@lru_cache(maxsize=2)
def _analysis(capture: Path, body_folder: Path | None, config: RegistrationConfig) -> TemplateAnalysis:
    """One analysis per process, template and settings."""
    return analyse_template(_template(read_capture(capture), body_folder), config)


def _register_job(config: RegistrationConfig, job: SegmentJob) -> int:
    """Register and write the frames of a run; how many were new."""
    description = read_capture(job.capture)
    frame_ids = description.frame_ids
    analysis = _analysis(job.capture, job.body_folder, config)
    mover = _mover(description, job.body_folder, analysis)
    pending = set(job.stage.pending([frame_ids[position] for position in job.positions]))

    def done(frame_id: int) -> tuple[np.ndarray, bool] | None:
        if frame_id in pending:
            return None
        with np.load(job.stage.frame_path(frame_id), allow_pickle=False) as arrays:
            return arrays["vertices"], VERDICTS[int(arrays["verdict"])] != "failed"

    results = register_run(
        analysis,
        mover,
        job.positions,
        frame_ids,
        load=lambda frame_id: load_garment_scan(job.garment_folder / "frames" / f"{frame_id:06d}.npz", frame_id),
        done=done,
        config=config,
    )
    count = 0
    for result in results:
        _write_frame(job.stage, result)
        count += 1
    return count


def _write_frame(stage: Stage, result: FrameResult) -> None:
    """Metrics first: the frame counts as done once its npz is there."""
    numbers = {key: value if math.isfinite(value) else None for key, value in result.quality.numbers.items()}
    write_json(
        _metrics_path(stage, result.frame_id),
        {
            "frame_id": result.frame_id,
            "verdict": result.quality.verdict,
            "reasons": list(result.quality.reasons),
            **numbers,
            "cpu_s": round(result.cpu_s, 4),
            "started_from": result.started_from,
            "iterations": result.linear_iterations,
        },
    )
    write_npz(
        stage.frame_path(result.frame_id),
        vertices=result.vertices,
        **result.quality.vertex_arrays(),
        verdict=np.uint8(VERDICTS.index(result.quality.verdict)),
    )


def _metrics_path(stage: Stage, frame_id: int) -> Path:
    return stage.frame_path(frame_id, ".json", folder="metrics")


def _gather(stage: Stage, frame_ids: tuple[int, ...]) -> None:
    """Stack the frames and their metrics."""
    stack_vertices(stage, frame_ids)
    lines = [json.dumps(read_json(_metrics_path(stage, frame_id))) for frame_id in frame_ids]
    write_bytes(stage.path / "metrics.jsonl", ("\n".join(lines) + "\n").encode())
