"""The stage that cuts the garment out of every scan: CAPTURE in, WORK/garment out.

Colours that capture.json does not give are learned from a few scans first, and written to colours.json. One of the
first four frames that can be read must have all of them, or else capture.json is wrong. Any other frame that lacks
them, because the subject has left the volume or hides a border, and any frame whose scan is damaged, gets the reason
instead of a garment, and registration flags it. Damaged scans are read again in every run, in case they were repaired;
other scans must not have changed.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.captures.capture import Capture, capture_digest, read_frame, scan_digest, scan_path
from capture4d.captures.garment_scans import ESTIMATED, save_garment_scan
from capture4d.captures.take_colours import KnownColours, take_colours, template_loops
from capture4d.colours.spaces import format_colour
from capture4d.errors import InputError
from capture4d.extraction.garment import ColourNotFoundError, cut_out
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import write_json, write_npz
from capture4d.runs.stage import Stage, StageResult, open_stage
from capture4d.runs.workers import run_jobs
from capture4d.settings import Count, settings
from capture4d.types import GarmentScan

__all__ = ["CLOUDS", "ExtractionSettings", "estimated_frames", "flagged_frames", "run"]

SCHEMA = 4
CLOUDS = "clouds.json"
"""Names the frames whose scans are points alone, so that normals and faces are estimated; not there without any."""
LOOKED_AT = 4
"""Frames that can be read, of which one must have the garment and its paints: the first may be a bad one."""


@settings
class ExtractionSettings:
    """What decides the result, besides the capture."""

    schema: Count = SCHEMA
    learn_colours: bool = False
    """Learn all colours from the scans, not only those that capture.json leaves open."""


def run(
    capture: Capture, output: Path, config: ExtractionSettings, *, workers: int = 1, overwrite: bool = False
) -> StageResult:
    """Extract the garment of every frame that has none yet.

    Raises:
        InputError: a scan is missing, none can be read, or the first that can lack the garment's colours; or these are
            to be learned and are not separable.
    """
    named = {}
    if not capture.boundary_colours and (config.learn_colours or capture.garment_colour is None):
        named["loops"] = " ".join(template_loops(capture))
    before = _unreadable_scans(output, capture.frame_ids)
    stage = open_stage(
        output,
        name="extract",
        schema=SCHEMA,
        config=config,
        upstream={"capture": capture.digest, **named},
        sources={"capture": capture.path},
        formerly={"capture": capture_digest(capture, instead=before), **named} if before else None,
        overwrite=overwrite,
    )
    colours_path = stage.path / "colours.json"
    pending = sorted({*stage.pending(capture.frame_ids), *before})
    if pending or not colours_path.is_file():
        colours = take_colours(capture, learn=config.learn_colours)
        write_json(colours_path, _described(colours))
        done = _extract_first(capture, colours, stage, pending)
        jobs = [(frame_id, stage.frame_path(frame_id)) for frame_id in pending if frame_id != done]
        for _ in run_jobs(partial(write_frame, capture, colours), jobs, workers=workers, label="extract garment"):
            pass
    frames = [stage.frame_path(frame_id) for frame_id in capture.frame_ids]
    if pending:
        _say_estimated(output / CLOUDS, estimated_frames(output, capture.frame_ids))
    return stage.finish(
        [colours_path, *frames],
        changed=bool(pending),
        frames=len(capture.frame_ids),
        failed=flagged_frames(output, capture.frame_ids),
    )


def _say_estimated(path: Path, frame_ids: tuple[int, ...]) -> None:
    if frame_ids:
        write_json(path, {"frames": frame_ids})
    else:
        path.unlink(missing_ok=True)


def flagged_frames(folder: Path, frame_ids: Sequence[int]) -> dict[int, str]:
    """Frames of an extraction without a garment, and why."""
    reasons = {frame_id: _reason(folder / "frames" / f"{frame_id:06d}.npz") for frame_id in frame_ids}
    return {frame_id: reason for frame_id, reason in reasons.items() if reason}


def estimated_frames(folder: Path, frame_ids: Sequence[int]) -> tuple[int, ...]:
    """Frames of an extraction whose scans are points alone."""
    found = []
    for frame_id in frame_ids:
        with ArrayFile(folder / "frames" / f"{frame_id:06d}.npz") as arrays:
            if ESTIMATED in arrays:
                found.append(frame_id)
    return tuple(found)


def _unreadable_scans(folder: Path, frame_ids: Sequence[int]) -> dict[int, str]:
    """Frames whose scan an earlier run could not read, and what that scan's digest was."""
    found = {}
    for frame_id in frame_ids:
        path = folder / "frames" / f"{frame_id:06d}.npz"
        if zipfile.is_zipfile(path):
            with ArrayFile(path) as arrays:
                digest = arrays.get("scan")
            if digest is not None:
                found[frame_id] = str(digest)
    return found


def _reason(path: Path) -> str:
    """Why a frame has no garment, nothing if it has one."""
    with ArrayFile(path) as arrays:
        reason = arrays.get("reason")
        return "" if reason is None else str(reason)


def _extract_first(capture: Capture, colours: KnownColours, stage: Stage, pending: Sequence[int]) -> int | None:
    """Extract the first frame that has the garment, if that is not done, to see that the colours are right.

    Returns:
        The frame; None if it was done before.
    Raises:
        ColourNotFoundError: the garment or a paint is in none of the first that can be read.
        InputError: no frame can be read; about the first.
    """
    absent: list[InputError] = []
    damaged: list[InputError] = []
    waiting = set(pending)
    for frame_id in capture.frame_ids:
        if frame_id not in waiting:
            if _reason(stage.frame_path(frame_id)):
                continue
            return None
        try:
            found, estimated = extract_frame(capture, colours, frame_id)
        except ColourNotFoundError as error:
            absent.append(error)
            if len(absent) == LOOKED_AT:
                break
            continue
        except InputError as error:
            damaged.append(error)
            continue
        save_garment_scan(stage.frame_path(frame_id), found, estimated=estimated)
        return frame_id
    raise (absent or damaged)[0]


def _described(colours: KnownColours) -> dict[str, Any]:
    return {
        "learned": colours.light is not None,
        "garment_colour": format_colour(colours.garment),
        "boundary_colours": {name: format_colour(colour) for name, colour in colours.boundary.items()},
        "other_colours": [format_colour(colour) for colour in colours.others],
    }


def extract_frame(capture: Capture, colours: KnownColours, frame_id: int) -> tuple[GarmentScan, bool]:
    """Read one scan and cut its garment out; and whether the scan's faces are estimated."""
    scan, estimated = read_frame(capture, frame_id)
    return cut_out(scan, colours, source=str(scan_path(capture, frame_id))), estimated


def write_frame(capture: Capture, colours: KnownColours, job: tuple[int, Path]) -> None:
    """Extract one frame and write it, or the reason why there is nothing to write."""
    frame_id, path = job
    try:
        found, estimated = extract_frame(capture, colours, frame_id)
        save_garment_scan(path, found, estimated=estimated)
    except InputError as error:
        damaged = not isinstance(error, ColourNotFoundError)
        source = {"scan": np.array(scan_digest(scan_path(capture, frame_id)))} if damaged else {}
        write_npz(path, reason=np.array(str(error)), **source)
