"""A take that is tracked: what both passes read, what they know of its frames, and the shape that it has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capture4d.body.posed_surface import BodyState
from capture4d.captures.capture import Capture, read_scan, scan_path
from capture4d.captures.points.scan_points import KeptPoints, ScanPoints, label_scan, scan_points
from capture4d.captures.scan_states import scan_looked_at
from capture4d.captures.segments import Segment, cut
from capture4d.captures.take_colours import KnownColours, described_colours
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import file_digest, read_json, write_json
from capture4d.files.reading import reading
from capture4d.files.records import load_body
from capture4d.runs.cluster.attempts import begin_frame
from capture4d.runs.decisions import GIVEN
from capture4d.runs.frame_lists import listed
from capture4d.runs.growing import GrowingStage, Reads
from capture4d.runs.made import FileState, Made, digest_of
from capture4d.tracking.config import TrackingConfig
from capture4d.tracking.sequence import Followed, Quality, Tracker, joint_shape

__all__ = [
    "STARTS",
    "TakeShape",
    "TrackedTake",
    "followed_frame",
    "kept_shape",
    "load_followed",
    "numbers_of",
    "prepared_take",
    "reads_of",
    "refined_paths",
    "take_shape",
]

SHAPE = "shape.json"
STARTS = ("search", "rest")


@dataclass(frozen=True, slots=True, eq=False)
class TrackedTake:
    """What both passes work on."""

    capture: Capture
    stage: GrowingStage
    config: TrackingConfig
    colours: KnownColours

    @property
    def segments(self) -> tuple[Segment, ...]:
        sequence = self.config.sequence
        return cut(len(self.capture.frame_ids), sequence.segment, sequence.overlap)

    def made(self, path: Path) -> Made:
        """What is known of a file that was made."""
        made = self.stage.ledger.of(path)
        assert made is not None, path
        return made

    def tracker(self) -> Tracker:
        return Tracker.create(load_body(self.stage.path / "body.npz"), self.config)

    @property
    def paints(self) -> tuple[tuple[int, int, int], ...]:
        return tuple(dict.fromkeys(self.colours.boundary.values()))

    def settings_digest(self) -> str:
        """Of what both passes read beside scans."""
        body = self.stage.ledger.of(self.stage.path / "body.npz")
        assert body is not None
        colours = described_colours(self.colours)
        seen = [colours["garment_colour"], self.paints, colours["light"], colours["other_colours"]]
        seen += ["printed"] if self.colours.printed else []
        shared = reads_of(self.capture, self.config).shared
        return digest_of([self.config, self.capture.units, seen, body.digest, shared.get("start")])

    def points(self, frame_id: int, path: Path) -> tuple[ScanPoints, str, list[FileState]]:
        """Points of a scan, what is wrong with it, and what was read of it: no points where it cannot be read, which
        loses the frame.

        Args:
            path: of the file that is made from it.
        """
        fault, known = "", KeptPoints.of(self.stage.path.parent, self.capture, self.colours, self.config.sampling)
        points = ScanPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))
        kept = known.read(frame_id)
        with scan_looked_at(self.capture, frame_id, known=() if kept is None else kept[1]) as looked:
            try:
                begin_frame(path)
                if kept is not None:
                    points = kept[0]
                else:
                    scan = self.colours.flat(read_scan(self.capture, frame_id))
                    source = str(scan_path(self.capture, frame_id))
                    points = scan_points(scan, label_scan(scan, self.colours), self.config.sampling, source=source)
            except InputError as error:
                fault = str(error)
        if kept is None and not fault:
            known.write(frame_id, points, looked)
        return points, fault, looked


def reads_of(capture: Capture, config: TrackingConfig) -> Reads:
    shared = {}
    if capture.body_digest:
        shared["body"] = capture.body_digest
    if config.start not in STARTS:
        start_file = Path(config.start)
        if not start_file.is_file():
            raise InputError(f"start: expected {', '.join(STARTS)} or a motion file, found '{config.start}'")
        shared["start"] = file_digest([start_file], root=start_file.parent)
    said = capture.entries("fps", "units", "garment_colour", "paints")
    return Reads(said, shared, capture.frame_ids, capture.left_out)


def followed_frame(take: TrackedTake, frame_id: int) -> Made:
    """What is known of a frame after the first pass."""
    return take.made(take.stage.frame_path(frame_id))


def prepared_take(take: TrackedTake) -> tuple[TrackedTake, Tracker]:
    """What the workers of both passes need."""
    return take, take.tracker()


def refined_paths(take: TrackedTake) -> list[Path]:
    """Of all frames after the second pass."""
    return [take.stage.frame_path(frame_id, folder="refined") for frame_id in take.capture.frame_ids]


def load_followed(path: Path) -> Followed:
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


def numbers_of(quality: Quality) -> Mapping[str, float]:
    return {"explained": quality.explained, "median_m": quality.median_m, "inside": quality.inside}


# --- the shape of the take ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class TakeShape:
    coefficients: tuple[float, ...]
    frames: str
    """That the take had when it was found."""


def kept_shape(take: TrackedTake) -> TakeShape | None:
    """The shape that an earlier run has found, if all but the scans is as it was then."""
    path = take.stage.path / SHAPE
    if not path.is_file():
        return None
    found = read_json(path)
    if found.get("found_from") not in (GIVEN, take.settings_digest()):
        return None
    with reading(path, "record of a shape"):
        return TakeShape(tuple(float(value) for value in found["shape"]), str(found["frames"]))


def take_shape(take: TrackedTake) -> TakeShape:
    """The shape that an earlier run has found, or that which all frames have contributed to."""
    kept = kept_shape(take)
    if kept is not None:
        return kept
    shape = TakeShape(_joint_shape(take), listed(take.capture.frame_ids, most=0))
    found = {"shape": shape.coefficients, "frames": shape.frames, "found_from": take.settings_digest()}
    write_json(take.stage.path / SHAPE, found)
    return shape


def _joint_shape(take: TrackedTake) -> tuple[float, ...]:
    """The shape at the end of a take, or the one that all its segments' ends together say: the mean of theirs, weighted
    by what each knows."""
    ids, ends = take.capture.frame_ids, []
    for segment in take.segments:
        good = (ids[each] for each in reversed(range(segment.start, segment.stop)))
        end = next((each for each in good if followed_frame(take, each).said["good"]), None)
        ends += [] if end is None else [load_followed(take.stage.frame_path(end))]
    if len(take.segments) == 1 or not ends:
        state = load_followed(take.stage.frame_path(ids[-1])).state
        return tuple(float(value) for value in state.shape)
    memory, prior = take.config.sequence.shape_memory, 1 / take.config.fit.shape_spread**2
    known = [each.shape_information / memory for each in ends] if memory else [each.shape_information for each in ends]
    return tuple(float(value) for value in joint_shape([each.state.shape for each in ends], known, prior))
