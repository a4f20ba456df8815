"""The first pass of tracking, forwards: a frame is made from its scan and from the one or two frames before it.

What is changed in a frame goes on to those after it, as far as they come out otherwise; what is added behind the last
begins with it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.body.posed_surface import BodyState
from capture4d.captures.scan_states import DAMAGED, replaced_scan, scan_digest, stands_with_scan
from capture4d.errors import InputError
from capture4d.files.atomic import write_json, write_npz
from capture4d.motions.motion_files import read_motion, told
from capture4d.runs.changes import say
from capture4d.runs.frame_lists import counted
from capture4d.runs.made import Made
from capture4d.runs.workers import progress
from capture4d.tracking.config import TrackingConfig
from capture4d.tracking.sequence import NOTHING, Followed, Tracker
from capture4d.tracking.take import TrackedTake, followed_frame, load_followed, numbers_of

__all__ = ["Chain", "follow_frames", "require_found", "standing_frames"]


@dataclass(frozen=True, slots=True)
class Chain:
    """Where the next frame starts from: the last frame, and the one before that if the motion can be told."""

    last: tuple[Path, Made] | None = None
    before: tuple[Path, Made] | None = None

    def inputs(self, settings: str, frame_id: int) -> dict[str, str]:
        """What a frame would be made from beside its scan."""
        last, before = ("" if each is None else each[1].digest for each in (self.last, self.before))
        return {"settings": settings, "last": last, "before": before, **({} if last else {"frame": str(frame_id)})}

    def followed_by(self, path: Path, made: Made) -> Chain:
        if made.said["nothing"]:
            return self
        steady = self.last is not None and not made.said["lost_frames"] and not self.last[1].said["lost_frames"]
        return Chain((path, made), self.last if steady else None)


def follow_frames(take: TrackedTake) -> None:
    """One frame after the other; a frame stands that was made from the same scan and the same frames before."""
    frame_ids, ledger, settings = take.capture.frame_ids, take.stage.ledger, take.settings_digest()
    chain, at = standing_frames(take, settings)
    if at == len(frame_ids):
        return
    replaced = [each for each in frame_ids if replaced_scan(ledger, take.stage.frame_path(each), take.capture, each)]
    if replaced:
        say(f"{take.stage.path.name}: {counted(replaced, 'replaced')}")
    tracker = take.tracker()
    with progress("track body", len(frame_ids), completed=at) as advance:
        for frame_id in frame_ids[at:]:
            path, inputs = take.stage.frame_path(frame_id), chain.inputs(settings, frame_id)
            if not stands_with_scan(ledger, path, take.capture, frame_id, inputs):
                _follow_frame(take, tracker, frame_id, chain, inputs)
            made = ledger.of(path)
            assert made is not None
            chain = chain.followed_by(path, made)
            advance(1)


def standing_frames(take: TrackedTake, settings: str) -> tuple[Chain, int]:
    """How many of the first frames stand, and where the next would start from."""
    chain = Chain()
    for at, frame_id in enumerate(take.capture.frame_ids):
        path, ledger = take.stage.frame_path(frame_id), take.stage.ledger
        if not stands_with_scan(ledger, path, take.capture, frame_id, chain.inputs(settings, frame_id)):
            return chain, at
        made = ledger.of(path)
        assert made is not None
        chain = chain.followed_by(path, made)
    return chain, len(take.capture.frame_ids)


def _follow_frame(take: TrackedTake, tracker: Tracker, frame_id: int, chain: Chain, inputs: Mapping[str, str]) -> None:
    begin = time.process_time()
    points, fault, looked = take.points(frame_id)
    last, before = (None if each is None else load_followed(each[0]) for each in (chain.last, chain.before))
    if last is not None:
        followed = tracker.follow(points, last, before)
    elif fault:
        followed = tracker.nothing(points)
    else:
        followed = tracker.begin(points, _start(tracker, take.config, frame_id))
    path, cpu_s = take.stage.frame_path(frame_id), time.process_time() - begin
    said: dict[str, Any] = {
        "nothing": followed.started_from == NOTHING,
        "lost": followed.quality.lost,
        "lost_frames": followed.lost_frames,
    }
    if fault:
        said[DAMAGED] = True
    take.stage.make(
        path,
        lambda: _save_followed(path, followed, cpu_s),
        inputs={**inputs, "scan": scan_digest(looked)},
        files=looked,
        said=said,
    )


def require_found(take: TrackedTake) -> None:
    """See that the first pass had a scan to start from, in this run or an earlier one.

    Raises:
        InputError: no scan can be read; about the first.
    """
    if all(followed_frame(take, frame_id).said["nothing"] for frame_id in take.capture.frame_ids):
        raise InputError(take.points(take.capture.frame_ids[0])[1])


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
        numbers=np.array([followed.quality.lost, *numbers_of(followed.quality).values()], np.float64),
        started_from=np.array(followed.started_from),
        lost_frames=followed.lost_frames,
        doubtful_frames=followed.doubtful_frames,
    )
