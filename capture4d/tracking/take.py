"""A take that is tracked: what both passes read, what they know of its frames, and the shape that it has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capture4d.body.posed_surface import BodyState
from capture4d.captures.capture import Capture, read_scan, scan_path
from capture4d.captures.scan_states import scan_looked_at
from capture4d.captures.take_colours import KnownColours, described_colours
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import file_digest, read_json, write_json
from capture4d.files.reading import reading
from capture4d.files.records import load_body
from capture4d.runs.decisions import GIVEN
from capture4d.runs.frame_lists import listed
from capture4d.runs.growing import GrowingStage, Reads
from capture4d.runs.made import FileState, Made, digest_of
from capture4d.tracking.config import TrackingConfig
from capture4d.tracking.scan_points import ScanPoints, scan_points
from capture4d.tracking.sequence import Followed, Quality, Tracker

__all__ = [
    "STARTS",
    "TakeShape",
    "TrackedTake",
    "followed_frame",
    "kept_shape",
    "load_followed",
    "numbers_of",
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
        seen = [colours["garment_colour"], self.paints, colours["light"]]
        seen += ["printed"] if self.colours.printed else []
        shared = reads_of(self.capture, self.config).shared
        return digest_of([self.config, self.capture.units, seen, body.digest, shared.get("start")])

    def points(self, frame_id: int) -> tuple[ScanPoints, str, list[FileState]]:
        """Points of a scan, what is wrong with it, and what was read of it: no points where it cannot be read, which
        loses the frame."""
        fault = ""
        points = ScanPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))
        with scan_looked_at(self.capture, frame_id) as looked:
            try:
                scan = self.colours.flat(read_scan(self.capture, frame_id))
                source = str(scan_path(self.capture, frame_id))
                points = scan_points(
                    scan, self.colours.garment, self.paints, self.config.sampling,
                    printed=self.colours.printed, source=source,
                )  # fmt: skip
            except InputError as error:
                fault = str(error)
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
    made = take.stage.ledger.of(take.stage.frame_path(frame_id))
    assert made is not None
    return made


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
    """The shape that an earlier run has found, or that after the last frame, which all have contributed to."""
    kept = kept_shape(take)
    if kept is not None:
        return kept
    frame_ids = take.capture.frame_ids
    state = load_followed(take.stage.frame_path(frame_ids[-1])).state
    shape = TakeShape(tuple(float(value) for value in state.shape), listed(frame_ids, most=0))
    found = {"shape": shape.coefficients, "frames": shape.frames, "found_from": take.settings_digest()}
    write_json(take.stage.path / SHAPE, found)
    return shape
