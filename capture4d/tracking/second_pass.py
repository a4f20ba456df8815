"""The second pass of tracking, in any order: a frame is made from its scan, the shape of the take, and itself and its
neighbours after the first."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from capture4d.captures.scan_states import DAMAGED, scan_digest, stands_with_scan
from capture4d.files.atomic import nan_to_none, read_json, write_json, write_npz
from capture4d.runs.cluster.attempts import end_frame
from capture4d.runs.growing import GrowingStage
from capture4d.runs.made import digest_of, make
from capture4d.tracking.limbs import unseen_limbs
from capture4d.tracking.sequence import Followed, Refined, Tracker, between
from capture4d.tracking.take import TakeShape, TrackedTake, followed_frame, load_followed, numbers_of

__all__ = ["RefineJob", "refine_frame", "refine_jobs"]


@dataclass(frozen=True, slots=True)
class RefineJob:
    frame_id: int
    shape: tuple[float, ...]
    around: tuple[int, ...]
    """Frames that it starts between, where it is lost (one, at an end of the take), or is drawn to the mean of."""
    lost: bool
    inputs: Mapping[str, str]
    """What it is made from beside its scan."""


def refine_jobs(take: TrackedTake, shape: TakeShape) -> list[RefineJob]:
    """The frames that are to be refined: those made from anything else than they would be."""
    capture, stage = take.capture, take.stage
    settings = digest_of([take.settings_digest(), capture.fps, shape.coefficients])
    jobs = []
    for frame_id, around in zip(capture.frame_ids, _surroundings(take), strict=True):
        own = followed_frame(take, frame_id)
        near = " ".join(f"{each - frame_id}: {followed_frame(take, each).digest}" for each in around)
        inputs = {"settings": settings, "first": own.digest, "around": near}
        path = stage.frame_path(frame_id, folder="refined")
        if not stands_with_scan(stage.ledger, path, capture, frame_id, inputs):
            jobs.append(RefineJob(frame_id, shape.coefficients, around, own.said["lost"], inputs))
    return jobs


def _surroundings(take: TrackedTake) -> list[tuple[int, ...]]:
    """Of each frame those that its second pass reads: of a lost one the nearest good ones on both sides, of another its
    neighbours if they are next to it and good."""
    ids = take.capture.frame_ids
    good = [not followed_frame(take, frame_id).said["lost"] for frame_id in ids]
    back: list[int | None] = []
    ahead: list[int | None] = []
    for nearest, order in ((back, range(len(ids))), (ahead, range(len(ids) - 1, -1, -1))):
        found = None
        for at in order:
            nearest.append(found)
            found = ids[at] if good[at] else found
    ahead.reverse()
    around = []
    for at, frame_id in enumerate(ids):
        sides = tuple(each for each in (back[at], ahead[at]) if each is not None)
        around.append(sides if not good[at] or sides == (frame_id - 1, frame_id + 1) else ())
    return around


def refine_frame(prepared: tuple[TrackedTake, Tracker], job: RefineJob) -> None:
    take, tracker = prepared
    capture, stage = take.capture, take.stage
    begin = time.process_time()
    first = load_followed(stage.frame_path(job.frame_id))
    near = [load_followed(stage.frame_path(each)).state for each in job.around]
    start = first.state
    if job.lost and near:
        share = (job.frame_id - job.around[0]) / (job.around[-1] - job.around[0]) if len(near) == 2 else 0.0
        start = between(near[0], near[1], share) if len(near) == 2 else near[0]
    start = replace(start, shape=np.array(job.shape))
    path = stage.frame_path(job.frame_id, folder="refined")
    points, fault, looked = take.points(job.frame_id, path)
    around = [] if job.lost else near
    refined = tracker.refine(points, start, around, interval_s=1 / capture.fps, lost=first.quality.lost)
    if fault:
        refined = replace(refined, quality=replace(refined.quality, reasons=(fault,)))
    unseen = unseen_limbs(tracker.model.body.joint_names, refined.seen)
    cpu_s = time.process_time() - begin
    make(
        stage.path,
        path,
        lambda: _save_refined(stage, job.frame_id, first, refined, unseen, cpu_s),
        inputs={**job.inputs, "scan": scan_digest(looked)},
        files=looked,
        said={DAMAGED: True} if fault else {},
    )
    end_frame(path)


def _save_refined(
    stage: GrowingStage, frame_id: int, first: Followed, refined: Refined, unseen: tuple[str, ...], cpu_s: float
) -> None:
    """Metrics first: the frame counts as done once its npz is there."""
    quality = refined.quality
    numbers = nan_to_none(numbers_of(quality))
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
