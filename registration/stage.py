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

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capture4d.body.binding import with_body_shape
from capture4d.captures.capture import Capture
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.work_folder import (
    REGISTER,
    VERDICTS,
    load_records,
    load_tracking,
    stack_vertices,
    tracking_digest,
)
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import nan_to_none, read_json, write_json, write_json_lines, write_npz
from capture4d.files.records import save_garment
from capture4d.runs.stage import Stage, StageResult, open_stage, require_complete
from capture4d.runs.workers import run_jobs, shared
from registration.config import RegistrationConfig
from registration.predictions import Mover
from registration.sequence import FrameResult, register_run, segments
from registration.template import TemplateAnalysis, analyse_template

__all__ = ["run"]

SCHEMA = 4


@dataclass(frozen=True, slots=True, eq=False)
class _Take:
    """What all segments of a take share: the template on the person who moves it, ready to be registered."""

    analysis: TemplateAnalysis
    mover: Mover | None
    config: RegistrationConfig
    frame_ids: tuple[int, ...]
    garment_folder: Path
    stage: Stage


def run(
    capture: Capture,
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
        InputError: the garments are missing or unfinished, or those of another capture, or poses, body and template
            disagree.
    """
    command = f"capture4d extract {capture.path} --output {output.parent}"
    made_from = {"capture": capture.digest}
    upstream = {
        "garment": require_complete(garment_folder, "extract", command, made_from=made_from),
        "template": capture.template_digest,
    }
    if body_folder is not None:
        upstream["body"] = tracking_digest(body_folder, capture)
    elif capture.motion_digest:
        upstream["motion"] = capture.motion_digest
    stage = open_stage(output, name=REGISTER, schema=SCHEMA, config=config, upstream=upstream, overwrite=overwrite)
    moving = capture.posed_body if body_folder is None else load_tracking(body_folder)
    garment = capture.template if moving is None else with_body_shape(capture.template, moving[0], moving[1].shape)
    if capture.boundary_colours and not garment.loops:
        raise InputError("expected a template with open borders, as its scans have; found none", where=capture.path)
    if not (output / "garment.npz").is_file():
        save_garment(output / "garment.npz", garment)
    pending = set(stage.pending(capture.frame_ids))
    if pending:
        analysis = analyse_template(garment, config)
        mover = None if moving is None else Mover.create(analysis, *moving)
        take = _Take(analysis, mover, config, capture.frame_ids, garment_folder, stage)
        jobs = _segments(take, pending)
        for _ in run_jobs(
            _register_segment, jobs, prepare=shared(take), workers=workers, label="register", units=len,
            finished=stage.count,
        ):  # fmt: skip
            pass
    gathered = all((output / name).is_file() for name in ("vertices.npy", "metrics.jsonl"))
    changed = bool(pending) or not gathered or not stage.was_complete
    if changed:
        _gather(stage, capture.frame_ids)
    frames = [stage.frame_path(frame_id) for frame_id in capture.frame_ids]
    return stage.finish(
        [output / "garment.npz", output / "vertices.npy", *frames],
        changed=changed,
        frames=len(frames),
        failed={
            record["frame_id"]: "; ".join(record["reasons"])
            for record in load_records(output)
            if record["verdict"] == "failed"
        },
    )


def _segments(take: _Take, pending: set[int]) -> list[range]:
    """Positions of frames that belong together, where any of them is still to be done."""
    return [
        positions
        for positions in segments(take.mover, len(take.frame_ids), take.config.sequence)
        if pending.intersection(take.frame_ids[position] for position in positions)
    ]


def _register_segment(take: _Take, positions: range) -> int:
    """Register and write the frames of a segment; how many were new."""
    frame_ids, stage = take.frame_ids, take.stage
    pending = set(stage.pending([frame_ids[position] for position in positions]))

    def done(frame_id: int) -> tuple[np.ndarray, bool] | None:
        if frame_id in pending:
            return None
        with ArrayFile(stage.frame_path(frame_id)) as arrays:
            return arrays["vertices"], VERDICTS[int(arrays["verdict"])] != "failed"

    results = register_run(
        take.analysis,
        take.mover,
        positions,
        frame_ids,
        load=lambda frame_id: load_garment_scan(take.garment_folder / "frames" / f"{frame_id:06d}.npz", frame_id),
        done=done,
        config=take.config,
    )
    count = 0
    for result in results:
        _write_frame(stage, result)
        count += 1
    return count


def _write_frame(stage: Stage, result: FrameResult) -> None:
    """Metrics first: the frame counts as done once its npz is there."""
    numbers = nan_to_none(result.quality.numbers)
    write_json(
        _metrics_path(stage, result.frame_id),
        {
            "frame_id": result.frame_id,
            "verdict": result.quality.verdict,
            "reasons": list(result.quality.reasons),
            **numbers,
            "regions": {name: nan_to_none(measures) for name, measures in result.quality.regions.items()},
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
    records = (read_json(_metrics_path(stage, frame_id)) for frame_id in frame_ids)
    write_json_lines(stage.path / "metrics.jsonl", records)
