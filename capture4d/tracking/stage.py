"""The stage that tracks the body: CAPTURE in, WORK/body out.

stage.json               what was run
body.npz                 the body that was tracked: the capture's, else the built-in one
frames/000123.npz        first pass, forwards: where the next frame starts from
refined/000123.npz       second pass: rotations, translation, seen joints
metrics/000123.json      verdict (good, check, lost), reasons, limbs that nobody scanned, numbers and CPU time
poses.npz                the take's poses and shape, as a capture would bring them
metrics.jsonl            the frames' metrics, one per line
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.body.anny import load_anny
from capture4d.body.posed_surface import BodyState
from capture4d.captures.capture import Capture, read_scan, scan_path
from capture4d.captures.take_colours import KnownColours, take_colours
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import (
    file_digest,
    nan_to_none,
    read_json,
    read_json_lines,
    write_json,
    write_json_lines,
    write_npz,
)
from capture4d.files.records import load_body, save_body, save_poses
from capture4d.motions.motion_files import read_motion, told
from capture4d.runs.progress import progress
from capture4d.runs.stage import Stage, StageResult, open_stage
from capture4d.runs.workers import run_jobs
from capture4d.tracking.config import SequenceConfig, TrackingConfig
from capture4d.tracking.limbs import guessed_limbs, unseen_limbs
from capture4d.tracking.scan_points import ScanPoints, scan_points
from capture4d.tracking.sequence import NOTHING, Followed, Quality, Refined, Tracker, between, outlying
from capture4d.types import PoseSequence

__all__ = ["run"]

SCHEMA = 4


STARTS = ("search", "rest")


def run(
    capture: Capture, output: Path, config: TrackingConfig, *, workers: int = 1, overwrite: bool = False
) -> StageResult:
    """Track the body through every frame.

    Raises:
        InputError: the capture is damaged, none of its scans can be read, or the start is no pose of its body.
    """
    upstream = {"capture": capture.digest}
    if capture.body_digest:
        upstream["body"] = capture.body_digest
    if config.start not in STARTS:
        start_file = Path(config.start)
        if not start_file.is_file():
            raise InputError(f"start: expected {', '.join(STARTS)} or a motion file, found '{config.start}'")
        upstream["start"] = file_digest([start_file], root=start_file.parent)
    stage = open_stage(
        output,
        name="track",
        schema=SCHEMA,
        config=config,
        upstream=upstream,
        sources={"capture": capture.path},
        overwrite=overwrite,
    )
    if not (output / "body.npz").is_file():
        save_body(output / "body.npz", capture.body or load_anny())
    pending = stage.pending(capture.frame_ids)
    to_refine = stage.pending(capture.frame_ids, folder="refined")
    if pending or to_refine:
        take = _Take(capture, stage, config, take_colours(capture))
        if pending:
            _follow_frames(take, pending)
        _require_found(take)
        shape = _take_shape(stage, capture.frame_ids)
        jobs = [_RefineJob(frame_id, shape) for frame_id in to_refine]
        prepare = partial(_prepare, take)
        for _ in run_jobs(_refine_frame, jobs, prepare=prepare, workers=workers, label="refine poses"):
            pass
    gathered = all((output / name).is_file() for name in ("poses.npz", "metrics.jsonl"))
    changed = bool(pending or to_refine) or not gathered or not stage.was_complete
    if changed:
        _gather(capture, stage, config)
    refined = [stage.frame_path(frame_id, folder="refined") for frame_id in capture.frame_ids]
    return stage.finish(
        [output / "body.npz", output / "poses.npz", *refined],
        changed=changed,
        frames=len(capture.frame_ids),
        failed={
            record["frame_id"]: "; ".join(record["reasons"])
            for record in read_json_lines(output / "metrics.jsonl")
            if record["verdict"] == "lost"
        },
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Take:
    """What both passes work on."""

    capture: Capture
    stage: Stage
    config: TrackingConfig
    colours: KnownColours

    def tracker(self) -> Tracker:
        return Tracker.create(load_body(self.stage.path / "body.npz"), self.config)

    def points(self, frame_id: int) -> tuple[ScanPoints, str]:
        """Points of a scan, and what is wrong with it: none where it cannot be read, which loses the frame."""
        colours = self.colours
        try:
            scan = colours.flat(read_scan(self.capture, frame_id))
            paints = tuple(dict.fromkeys(colours.boundary.values()))
            source = str(scan_path(self.capture, frame_id))
            return scan_points(scan, colours.garment, paints, self.config.sampling, source=source), ""
        except InputError as error:
            return ScanPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool)), str(error)


# --- first pass --------------------------------------------------------------------------------------------------


def _follow_frames(take: _Take, frame_ids: Sequence[int]) -> None:
    """One frame after the other, from where an earlier run stopped."""
    capture, stage, config = take.capture, take.stage, take.config
    tracker, pending = take.tracker(), set(frame_ids)
    last = before = None
    with progress("track body", len(capture.frame_ids), completed=len(capture.frame_ids) - len(pending)) as advance:
        for frame_id in capture.frame_ids:
            path = stage.frame_path(frame_id)
            if frame_id in pending:
                begin = time.process_time()
                points, fault = take.points(frame_id)
                if last is not None:
                    followed = tracker.follow(points, last, before)
                elif fault:
                    followed = tracker.nothing(points)
                else:
                    followed = tracker.begin(points, _start(tracker, config, frame_id))
                _save_followed(path, followed, time.process_time() - begin)
                advance(1)
            followed = _load_followed(path)
            if followed.started_from == NOTHING:
                continue
            before = last if followed.lost_frames == 0 and last is not None and last.lost_frames == 0 else None
            last = followed


def _require_found(take: _Take) -> None:
    """See that the first pass had a scan to start from, in this run or an earlier one.

    Raises:
        InputError: no scan can be read; about the first.
    """
    frame_ids, stage = take.capture.frame_ids, take.stage
    if all(_load_followed(stage.frame_path(frame_id)).started_from == NOTHING for frame_id in frame_ids):
        raise InputError(take.points(frame_ids[0])[1])


def _start(tracker: Tracker, config: TrackingConfig, frame_id: int) -> BodyState | None:
    if config.start == "search":
        return None
    rest = tracker.model.rest_state()
    if config.start == "rest":
        return rest
    start = Path(config.start)
    poses = read_motion(start, tracker.model.body, say=told(start))
    row = poses.row(frame_id) if frame_id in poses.frame_ids else 0
    shape = np.zeros_like(rest.shape)
    shape[: len(poses.shape)] = poses.shape[: len(shape)]
    return BodyState(poses.rotations[row].astype(np.float64), poses.translations[row].astype(np.float64), shape)


def _save_followed(path: Path, followed: Followed, cpu_s: float) -> None:
    """The time first: the frame counts as done once its npz is there."""
    write_json(path.parents[1] / "times" / f"{path.stem}.json", {"cpu_s": round(cpu_s, 4)})
    write_npz(
        path,
        rotations=followed.state.rotations,
        translation=followed.state.translation,
        shape=followed.state.shape,
        shape_information=followed.shape_information,
        reasons=np.array(followed.quality.reasons, np.str_),
        numbers=np.array([followed.quality.lost, *_numbers(followed.quality).values()], np.float64),
        started_from=np.array(followed.started_from),
        lost_frames=followed.lost_frames,
        doubtful_frames=followed.doubtful_frames,
    )


def _load_followed(path: Path) -> Followed:
    with ArrayFile(path) as arrays:
        lost, explained, median_m, inside = arrays["numbers"]
        return Followed(
            BodyState(arrays["rotations"], arrays["translation"], arrays["shape"]),
            arrays["shape_information"],
            Quality(arrays.names("reasons"), bool(lost), float(explained), float(median_m), float(inside)),
            str(arrays["started_from"]),
            int(arrays["lost_frames"]),
            int(arrays["doubtful_frames"]),
        )


def _numbers(quality: Quality) -> Mapping[str, float]:
    return {"explained": quality.explained, "median_m": quality.median_m, "inside": quality.inside}


def _take_shape(stage: Stage, frame_ids: tuple[int, ...]) -> tuple[float, ...]:
    """The shape after the last frame, which all frames have contributed to."""
    return tuple(float(value) for value in _load_followed(stage.frame_path(frame_ids[-1])).state.shape)


# --- second pass -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _RefineJob:
    frame_id: int
    shape: tuple[float, ...]


def _prepare(take: _Take) -> tuple[_Take, Tracker]:
    return take, take.tracker()


def _refine_frame(prepared: tuple[_Take, Tracker], job: _RefineJob) -> None:
    take, tracker = prepared
    capture, stage = take.capture, take.stage
    begin = time.process_time()
    first, start, around = _surroundings(capture, stage, job.frame_id)
    start = replace(start, shape=np.array(job.shape))
    points, fault = take.points(job.frame_id)
    refined = tracker.refine(points, start, around, interval_s=1 / capture.fps, lost=first.quality.lost)
    if fault:
        refined = replace(refined, quality=replace(refined.quality, reasons=(fault,)))
    unseen = unseen_limbs(tracker.model.body.joint_names, refined.seen)
    _save_refined(stage, job.frame_id, first, refined, unseen, time.process_time() - begin)


def _surroundings(capture: Capture, stage: Stage, frame_id: int) -> tuple[Followed, BodyState, list[BodyState]]:
    """A frame after the first pass, where its second starts, and its neighbours if they are next to it and good."""
    ids = capture.frame_ids
    position = ids.index(frame_id)
    own = _load_followed(stage.frame_path(frame_id))

    def good(step: int) -> tuple[int, Followed] | None:
        """The nearest frame on one side that is not lost."""
        at = position + step
        while 0 <= at < len(ids):
            found = _load_followed(stage.frame_path(ids[at]))
            if not found.quality.lost:
                return ids[at], found
            at += step
        return None

    back, ahead = good(-1), good(1)
    if own.quality.lost:
        if back and ahead:
            share = (frame_id - back[0]) / (ahead[0] - back[0])
            return own, between(back[1].state, ahead[1].state, share), []
        near = back or ahead
        return own, near[1].state if near else own.state, []
    if back and ahead and back[0] == frame_id - 1 and ahead[0] == frame_id + 1:
        return own, own.state, [back[1].state, ahead[1].state]
    return own, own.state, []


def _save_refined(
    stage: Stage, frame_id: int, first: Followed, refined: Refined, unseen: tuple[str, ...], cpu_s: float
) -> None:
    """Metrics first: the frame counts as done once its npz is there."""
    quality = refined.quality
    numbers = nan_to_none(_numbers(quality))
    before = read_json(stage.path / "times" / f"{frame_id:06d}.json")["cpu_s"]
    write_json(
        stage.frame_path(frame_id, ".json", folder="metrics"),
        {
            "frame_id": frame_id,
            "verdict": "lost" if quality.lost else "check" if quality.reasons else "good",
            "reasons": list(quality.reasons),
            "unseen": list(unseen),
            **numbers,
            "started_from": first.started_from,
            "cpu_s": round(before + cpu_s, 4),
        },
    )
    write_npz(
        stage.frame_path(frame_id, folder="refined"),
        rotations=refined.state.rotations.astype(np.float32),
        translation=refined.state.translation.astype(np.float32),
        seen=refined.seen,
    )


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


def _gather(capture: Capture, stage: Stage, config: TrackingConfig) -> None:
    """Poses and metrics of all frames."""
    shape = _take_shape(stage, capture.frame_ids)
    paths = [stage.frame_path(frame_id, folder="refined") for frame_id in capture.frame_ids]
    rotations, translations = [], []
    for path in paths:
        with ArrayFile(path) as arrays:
            rotations.append(arrays["rotations"])
            translations.append(arrays["translation"])
    names = load_body(stage.path / "body.npz").joint_names
    save_poses(
        stage.path / "poses.npz",
        PoseSequence(
            np.stack(rotations),
            np.stack(translations),
            np.array(shape, np.float32),
            np.array(capture.frame_ids, np.int32),
            capture.fps,
            names,
        ),
    )
    records = [read_json(stage.frame_path(frame_id, ".json", folder="metrics")) for frame_id in capture.frame_ids]
    write_json_lines(stage.path / "metrics.jsonl", _with_take(records, config.sequence))
