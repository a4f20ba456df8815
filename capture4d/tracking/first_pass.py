"""The first pass of tracking, forwards: a frame is made from its scan and from the one or two frames before it.

    frames/000123.npz    a frame, as its segment has it
    leads/000123.npz     the same of a frame before a segment, in which that finds its way
    seams/000123.json    how far the segment that begins with this frame is from the one before

What is changed in a frame goes on to those after it in its segment, as far as they come out otherwise; what is added
behind the last begins with it. A segment that has found another pose than the one before is followed anew, from that
one's end.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.body.posed_surface import BodyState
from capture4d.captures.scan_states import DAMAGED, replaced_scan, scan_digest, stands_with_scan
from capture4d.captures.segments import Segment
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_json, write_npz
from capture4d.files.records import load_body
from capture4d.motions.motion_files import read_motion, told
from capture4d.runs.changes import say
from capture4d.runs.cluster.attempts import end_frame
from capture4d.runs.frame_lists import counted
from capture4d.runs.made import Made, noted
from capture4d.runs.workers import run_jobs
from capture4d.tracking.config import TrackingConfig
from capture4d.tracking.sequence import NOTHING, Followed, Tracker, apart_mm
from capture4d.tracking.take import TrackedTake, followed_frame, load_followed, numbers_of, prepared_take
from capture4d.types import Body

__all__ = ["Chain", "FirstPass", "FollowJob", "follow_frames", "require_found", "seams_of"]


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


@dataclass(frozen=True, slots=True)
class FollowJob:
    segment: Segment
    begin: Chain | None
    """The end of the segment before; None of a segment that begins with its own leads."""


@dataclass(frozen=True, slots=True)
class Todo:
    """What there is to do now; when it is done there may be more."""

    judge: tuple[Segment, ...]
    """Segments whose seams with the ones before are to be judged; first, for some may have to be followed anew then."""
    follow: tuple[FollowJob, ...]
    certain: tuple[int, ...]
    """Frames that are to be followed."""
    following: tuple[int, ...]
    """Frames that are to be followed if what they start from comes out otherwise than it was."""
    standing: int
    """How many frames need not be."""

    @property
    def is_any(self) -> bool:
        return bool(self.judge or self.follow)


@dataclass(frozen=True, slots=True, eq=False)
class FirstPass:
    """What each frame of a take would be followed from."""

    take: TrackedTake
    settings: str
    tried: bool = False
    """Damaged scans have been tried again in this run."""

    @staticmethod
    def of(take: TrackedTake, *, tried: bool = False) -> FirstPass:
        return FirstPass(take, take.settings_digest(), tried)

    def leads(self, segment: Segment) -> dict[int, Path]:
        """A segment's version of the frames before its first, by frame."""
        return self._files(range(segment.lead, segment.start), "leads")

    def frames(self, segment: Segment) -> dict[int, Path]:
        return self._files(range(segment.start, segment.stop), "frames")

    def _files(self, positions: range, folder: str) -> dict[int, Path]:
        ids = self.take.capture.frame_ids
        return {ids[each]: self.take.stage.frame_path(ids[each], folder=folder) for each in positions}

    def seam(self, segment: Segment) -> Path:
        first = self.take.capture.frame_ids[segment.start]
        return self.take.stage.frame_path(first, ".json", folder="seams")

    def walk(self, places: Mapping[int, Path], chain: Chain) -> tuple[int | None, Chain]:
        """The first of some frames that is to be followed, None if all stand; and where it would start from."""
        for frame_id, path in places.items():
            if not self.stands(frame_id, path, chain):
                return frame_id, chain
            chain = chain.followed_by(path, self.take.made(path))
        return None, chain

    def stands(self, frame_id: int, path: Path, chain: Chain) -> bool:
        """Whether a frame is there, made from what it would be made from."""
        ledger, inputs = self.take.stage.ledger, chain.inputs(self.settings, frame_id)
        made = ledger.of(path)
        if self.tried and made is not None and made.said.get(DAMAGED):
            return {**made.inputs, "scan": ""} == {**inputs, "scan": ""}
        return stands_with_scan(ledger, path, self.take.capture, frame_id, inputs)

    def continues(self, segment: Segment) -> bool:
        """Whether a segment is followed from the end of the one before, as far as is known by now."""
        made = self.take.stage.ledger.of(self.seam(segment)) if segment.index else None
        return made is not None and bool(made.said["continues"])

    def seam_inputs(self, segment: Segment) -> dict[str, str]:
        """What the seam before a segment is judged by."""
        both = [path for pair in self._overlap(segment) for path in pair]
        return {"settings": self.settings, "frames": self.take.stage.ledger.digest_of(both)}

    def _overlap(self, segment: Segment) -> list[tuple[Path, Path]]:
        """The frames that are compared, as both segments have them: the last third of those that both have."""
        leads = self.leads(segment)
        compared = list(leads)[-max(len(leads) // 3, 1) :]
        return [(self.take.stage.frame_path(each), leads[each]) for each in compared if leads]

    def judge(self, segment: Segment, body: Body) -> None:
        """Compare a segment with the one before, in the last frame that both have found."""
        overlap = self._overlap(segment)
        found = [both for both in overlap if all(self.take.made(each).said["good"] for each in both)]
        apart, continues = None, bool(overlap) and bool(self.take.made(overlap[-1][0]).said["good"])
        if found:
            apart = apart_mm(body, *(load_followed(each).state for each in found[-1]))
            continues = continues and apart > self.take.config.sequence.seam_mm
        path, record = self.seam(segment), {"seam_mm": apart, "continues": continues}
        self.take.stage.make(
            path, lambda: write_json(path, record), inputs=self.seam_inputs(segment), said={"continues": continues}
        )

    def todo(self) -> Todo:
        """What there is to do now."""
        judge, follow, certain, following, standing = [], [], set[int](), set[int](), 0
        end, stands_before = Chain(), True
        for segment in self.take.segments:
            frames, continues = self.frames(segment), self.continues(segment)
            stale, begin = self.walk(self.leads(segment), Chain())
            if segment.index and stands_before and stale is None and not self._is_judged(segment):
                judge.append(segment)
            if continues and not stands_before:  # where it begins is not known yet
                following |= {*frames}
                continue
            begin = end if continues else begin
            if stale is None:
                stale, end = self.walk(frames, begin)
            stands_before = stale is None
            if stale is None:
                standing += len(frames)
                continue
            follow.append(FollowJob(segment, begin if continues else None))
            ids = [*frames]
            at = ids.index(stale) if stale in frames else 0
            certain.add(ids[at])
            following |= {*ids[at:]}
            standing += at
        return Todo(tuple(judge), tuple(follow), tuple(sorted(certain)), tuple(sorted(following - certain)), standing)

    def _is_judged(self, segment: Segment) -> bool:
        return self.take.stage.ledger.stands(self.seam(segment), self.seam_inputs(segment))


def follow_frames(take: TrackedTake, workers: int) -> TrackedTake:
    """Segments side by side; a frame stands that was made from the same scan and the same frames before.

    Returns:
        The take, knowing what was made.
    """
    frame_ids, tried = take.capture.frame_ids, False
    while (todo := FirstPass.of(take, tried=tried).todo()).is_any:
        if todo.judge:
            body = load_body(take.stage.path / "body.npz")
            for segment in todo.judge:
                FirstPass.of(take).judge(segment, body)
            continue
        ledger, stage = take.stage.ledger, take.stage
        replaced = [each for each in frame_ids if replaced_scan(ledger, stage.frame_path(each), take.capture, each)]
        if replaced and not tried:
            say(f"{stage.path.name}: {counted(replaced, 'replaced')}")
        for _ in run_jobs(
            _follow_segment, todo.follow, prepare=partial(prepared_take, take), workers=workers, label="track body",
            units=lambda job: job.segment.stop - job.segment.lead, finished=partial(noted, stage.path),
        ):  # fmt: skip
            pass
        take, tried = replace(take, stage=stage.with_notes()), True
    return take


def _follow_segment(prepared: tuple[TrackedTake, Tracker], job: FollowJob) -> None:
    """Follow the frames of a segment that do not stand, those before its first one at the beginning."""
    take, tracker = prepared
    first = FirstPass.of(take)
    led = _follow(first, tracker, first.leads(job.segment), Chain())
    _follow(first, tracker, first.frames(job.segment), led if job.begin is None else job.begin)


def _follow(first: FirstPass, tracker: Tracker, places: Mapping[int, Path], chain: Chain) -> Chain:
    """Frames one after the other; where the next would start from."""
    take = first.take
    for frame_id, path in places.items():
        inputs = chain.inputs(first.settings, frame_id)
        if not stands_with_scan(take.stage.ledger, path, take.capture, frame_id, inputs):
            _follow_frame(take, tracker, frame_id, path, chain, inputs)
        chain = chain.followed_by(path, take.made(path))
    return chain


def seams_of(take: TrackedTake) -> dict[int, Mapping[str, Any]]:
    """What is known of the seams of a take that was followed, by the first frame behind each."""
    first = FirstPass.of(take)
    return {take.capture.frame_ids[each.start]: read_json(first.seam(each)) for each in take.segments[1:]}


def _follow_frame(
    take: TrackedTake, tracker: Tracker, frame_id: int, path: Path, chain: Chain, inputs: Mapping[str, str]
) -> None:
    begin = time.process_time()
    points, fault, looked = take.points(frame_id, path)
    is_first = path.parent.name == "frames" and frame_id <= take.capture.frame_ids[take.segments[0].stop - 1]
    last, before = (None if each is None else load_followed(each[0]) for each in (chain.last, chain.before))
    if last is not None:
        followed = tracker.follow(points, last, before)
    elif fault:
        followed = tracker.nothing(points)
    else:
        followed = tracker.begin(points, _start(tracker, take.config, frame_id, is_first=is_first))
    cpu_s = time.process_time() - begin
    said: dict[str, Any] = {
        "nothing": followed.started_from == NOTHING,
        "lost": followed.quality.lost,
        "good": not followed.quality.reasons,
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
    end_frame(path)


def require_found(take: TrackedTake) -> None:
    """See that the first pass had a scan to start from, in this run or an earlier one.

    Raises:
        InputError: no scan can be read; about the first.
    """
    if all(followed_frame(take, frame_id).said["nothing"] for frame_id in take.capture.frame_ids):
        first = take.capture.frame_ids[0]
        raise InputError(take.points(first, take.stage.frame_path(first))[1])


def _start(tracker: Tracker, config: TrackingConfig, frame_id: int, *, is_first: bool) -> BodyState | None:
    """Where a frame without one before it starts from, None where the pose is to be searched for.

    Args:
        is_first: the take begins with it; what is given as the start is that of the beginning; a motion file, that of
            the frames that it has, too.
    """
    if config.start == "search" or (config.start == "rest" and not is_first):
        return None
    rest = tracker.model.rest_state()
    if config.start == "rest":
        return rest
    start = Path(config.start)
    poses = read_motion(start, tracker.model.body, say=told(start))
    if frame_id not in poses.frame_ids and not is_first:
        return None
    row = poses.row(frame_id) if frame_id in poses.frame_ids else 0
    shape = np.zeros_like(rest.shape)
    shape[: len(poses.shape)] = poses.shape[: len(shape)]
    return BodyState(poses.rotations[row].astype(np.float64), poses.translations[row].astype(np.float64), shape)


def _save_followed(path: Path, followed: Followed, cpu_s: float) -> None:
    """The time first: the frame counts as done once its npz is there."""
    times = "times" if path.parent.name == "frames" else path.parent.name
    write_json(path.parents[1] / times / f"{path.stem}.json", {"cpu_s": round(cpu_s, 4)})
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
