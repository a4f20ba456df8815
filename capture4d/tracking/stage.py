"""The stage that tracks the body: CAPTURE in, WORK/body out.

stage.json               what was run
body.npz                 the body that was tracked: the capture's, else the built-in one
frames/000123.npz        first pass, forwards: where the next frame starts from
leads/, seams/           where segments overlap: the later one's frames, and how far apart they are (`first_pass`)
shape.json               the shape of the take, which all frames have contributed to, and the frames it had then
refined/000123.npz       second pass: rotations, translation, seen joints
metrics/000123.json      verdict (good, check, lost), reasons, limbs that nobody scanned, numbers and CPU time
poses.npz                the take's poses and shape, as a capture would bring them
metrics.jsonl            the frames' metrics, one per line

In the first pass a frame is made from its scan and the one or two that it starts from: what is changed there goes
on to the frames after it in its segment, and what is added behind the last begins with it. In the second it is made
from its scan, itself and its neighbours in the first, and the shape; so the shape, once it is found, stays until it is
to be renewed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.body.anny import load_anny
from capture4d.captures.capture import Capture
from capture4d.captures.scan_states import replaced_scan, require_same_take
from capture4d.captures.take_colours import colours_of_take, kept_colours, take_colours
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import read_json, read_json_lines, write_json_lines
from capture4d.files.records import load_body, save_body, save_poses
from capture4d.runs.changes import StageChanges, say
from capture4d.runs.frame_lists import listed
from capture4d.runs.growing import GrowingStage, Pending, open_growing_stage, stage_changes
from capture4d.runs.made import Ledger, digest_of
from capture4d.runs.stage import StageResult
from capture4d.runs.workers import run_jobs
from capture4d.tracking.config import SequenceConfig, TrackingConfig
from capture4d.tracking.first_pass import FirstPass, follow_frames, require_found, seams_of
from capture4d.tracking.limbs import guessed_limbs
from capture4d.tracking.second_pass import refine_frame, refine_jobs
from capture4d.tracking.sequence import outlying
from capture4d.tracking.take import (
    TakeShape,
    TrackedTake,
    kept_shape,
    prepared_take,
    reads_of,
    refined_paths,
    take_shape,
)
from capture4d.types import PoseSequence

__all__ = ["changes", "run"]

SCHEMA = 7
NAME = "track"


def run(
    capture: Capture,
    output: Path,
    config: TrackingConfig,
    *,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Track the body through every frame.

    Raises:
        InputError: the capture is damaged, none of its scans can be read, or the start is no pose of its body.
    """
    start = Path(config.start)
    if start.is_file() and start.resolve().is_relative_to(output.resolve()):
        raise InputError(
            "start: expected a motion file outside of the folder that is written, found one in it", where=start
        )
    if not overwrite:
        require_same_take(output, capture)
    stage = open_growing_stage(
        output,
        name=NAME,
        schema=SCHEMA,
        config=config,
        reads=reads_of(capture, config),
        sources={"capture": capture.path},
        overwrite=overwrite,
    )
    body_path = output / "body.npz"
    stage.make_unless_standing(
        body_path,
        lambda: save_body(body_path, capture.body or load_anny()),
        inputs={"body": capture.body_digest or "built-in"},
    )
    colours = colours_of_take(capture, output)
    take = TrackedTake(capture, stage, config, colours.colours)
    take = follow_frames(take, workers)
    stage = take.stage
    require_found(take)
    shape = take_shape(take)
    kept = {"shape": shape.frames, "colours": "" if colours.newly else colours.frames}
    jobs = refine_jobs(take, shape)
    if jobs:
        _say_kept(output.name, {what: frames for what, frames in kept.items() if frames}, capture.frame_ids)
        prepare = partial(prepared_take, take)
        for _ in run_jobs(refine_frame, jobs, prepare=prepare, workers=workers, label="refine poses"):
            pass
        stage = stage.with_notes()
    _gather(replace(take, stage=stage), shape)
    return stage.finish_growing(
        [body_path, output / "poses.npz", *refined_paths(take)],
        frames=len(capture.frame_ids),
        failed={
            record["frame_id"]: "; ".join(record["reasons"])
            for record in read_json_lines(output / "metrics.jsonl")
            if record["verdict"] == "lost"
        },
    )


def changes(capture: Capture, output: Path, config: TrackingConfig) -> StageChanges:
    """What `run` would do, and why; nothing is done."""

    def pending(ledger: Ledger) -> Pending:
        kept = None if capture.garment_colour is not None else kept_colours(capture, output)
        if capture.garment_colour is None and kept is None:
            return Pending(capture.frame_ids)
        stage = GrowingStage(output, {}, ledger=ledger)
        take = TrackedTake(capture, stage, config, take_colours(capture) if kept is None else kept.colours)
        if not (output / "body.npz").is_file() or ledger.of(output / "body.npz") is None:
            return Pending(capture.frame_ids)
        shape = kept_shape(take)
        return _pending(take, shape).keeping(
            *([f"shape, found from frames {shape.frames}"] if shape else []),
            *([f"colours, learned from frames {kept.frames}"] if kept else []),
        )

    return stage_changes(
        output, name=NAME, schema=SCHEMA, config=config, reads=reads_of(capture, config), pending=pending
    )


def _pending(take: TrackedTake, shape: TakeShape | None) -> Pending:
    """Frames that are to be tracked."""
    capture, ledger, stage = take.capture, take.stage.ledger, take.stage
    frame_ids = capture.frame_ids
    replaced = [each for each in frame_ids if replaced_scan(ledger, stage.frame_path(each), capture, each)]
    todo = FirstPass.of(take).todo()
    if not todo.is_any:
        again = frame_ids if shape is None else tuple(job.frame_id for job in refine_jobs(take, shape))
        return Pending(again, replaced=tuple(replaced))
    missing = (each for each in frame_ids if ledger.sound(stage.frame_path(each)) is None)
    certain = {*todo.certain, *replaced, *missing}
    following = tuple(each for each in todo.following if each not in certain)
    return Pending(tuple(sorted(certain)), following, tuple(replaced))


def _say_kept(name: str, kept: Mapping[str, str], frame_ids: Sequence[int]) -> None:
    now = listed(frame_ids, most=0)
    for what, frames in kept.items():
        if frames != now:
            say(f"{name}: the {what} of the take stays as frames {frames} gave it; --renew {what} finds it anew")


def _with_take(records: Sequence[dict[str, Any]], config: SequenceConfig) -> list[dict[str, Any]]:
    """The frames' records, flagged where only the whole take shows that something is wrong."""
    medians = np.array([np.nan if record["median_m"] is None else record["median_m"] for record in records], np.float64)
    usual, outliers = outlying(medians, config)
    found = [record for record in records if record["verdict"] != "lost"]
    ids = [record["frame_id"] for record in found]
    guessed = dict(zip(ids, guessed_limbs([record["unseen"] for record in found]), strict=True))
    flagged = []
    for record, median, is_outlier in zip(records, medians, outliers, strict=True):
        reasons = list(record["reasons"])
        if is_outlier:
            reasons.append(
                f"skin and suit lie {1e3 * median:.1f} mm from the body, {1e3 * usual:.1f} is usual in this take"
            )
        if guessed.get(record["frame_id"]):
            reasons.append(f"not scanned, so guessed: {', '.join(guessed[record['frame_id']])}")
        verdict = record["verdict"] if record["verdict"] == "lost" or not reasons else "check"
        flagged.append({**record, "verdict": verdict, "reasons": reasons})
    return flagged


def _gather(take: TrackedTake, shape: TakeShape) -> None:
    """Poses and metrics of all frames."""
    stage, capture = take.stage, take.capture
    refined = stage.digest_of_all(refined_paths(take))
    followed = stage.digest_of_all([stage.frame_path(frame_id) for frame_id in capture.frame_ids])
    poses, metrics = stage.path / "poses.npz", stage.path / "metrics.jsonl"
    seams = seams_of(take)
    shared = {"refined": refined, "settings": digest_of([take.settings_digest(), shape.coefficients, capture.fps])}
    stage.make_unless_standing(poses, lambda: _save_poses(take, shape, poses), inputs=shared)
    stage.make_unless_standing(
        metrics,
        lambda: _save_metrics(take, seams, metrics),
        inputs={**shared, "followed": followed, **({"seams": digest_of([*seams.items()])} if seams else {})},
    )


def _save_poses(take: TrackedTake, shape: TakeShape, path: Path) -> None:
    rotations, translations = [], []
    for each in refined_paths(take):
        with ArrayFile(each) as arrays:
            rotations.append(arrays["rotations"])
            translations.append(arrays["translation"])
    names = load_body(take.stage.path / "body.npz").joint_names
    save_poses(
        path,
        PoseSequence(
            np.stack(rotations),
            np.stack(translations),
            np.array(shape.coefficients, np.float32),
            np.array(take.capture.frame_ids, np.int32),
            take.capture.fps,
            names,
        ),
    )


def _save_metrics(take: TrackedTake, seams: Mapping[int, Mapping[str, Any]], path: Path) -> None:
    paths = (take.stage.frame_path(frame_id, ".json", folder="metrics") for frame_id in take.capture.frame_ids)
    records = _with_take([read_json(each) for each in paths], take.config.sequence)
    write_json_lines(path, [_with_seam(each, seams.get(each["frame_id"]), take.config.sequence) for each in records])


def _with_seam(record: dict[str, Any], seam: Mapping[str, Any] | None, config: SequenceConfig) -> dict[str, Any]:
    """A frame's record, flagged where a segment begins that could not be compared with the one before, or differs."""
    if seam is None:
        return record
    apart, reasons = seam["seam_mm"], list(record["reasons"])
    if not seam["continues"] and (apart is None or apart > config.seam_mm):
        how = "no frame was found by both" if apart is None else f"they are {apart:.0f} mm apart"
        reasons.append(f"a segment begins here, and cannot be joined with the one before: {how}")
    verdict = "check" if reasons and record["verdict"] == "good" else record["verdict"]
    return {**record, "verdict": verdict, "reasons": reasons, "seam_mm": None if apart is None else round(apart, 3)}
