"""The stage that cuts the garment out of every scan: CAPTURE in, WORK/garment out.

Colours that capture.json does not give are learned from a few scans first, and written to colours.json. One of the
first four frames that can be read must have all of them, or else capture.json is wrong. Any other frame that lacks
them, because the subject has left the volume or hides a border, and any frame whose scan is damaged, gets the reason
instead of a garment, and registration flags it. Damaged scans are read again in every run, in case they were repaired.

A frame is made from its scan, the colours, and the unit of the scans.

While a scan is open, what `track` reads of it is kept as well, where there are no poses (`captures.points`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.captures.capture import Capture, read_frame, scan_path
from capture4d.captures.garment_scans import ESTIMATED, save_garment_scan
from capture4d.captures.points.sampling import SamplingConfig
from capture4d.captures.points.scan_points import KeptPoints, ScanPoints, label_scan, scan_points
from capture4d.captures.scan_states import (
    DAMAGED,
    replaced_scan,
    require_same_take,
    scan_digest,
    scan_looked_at,
    stands_with_scan,
)
from capture4d.captures.take_colours import (
    COLOURS,
    KnownColours,
    colours_of_take,
    described_colours,
    kept_colours,
    take_colours,
    template_loops,
)
from capture4d.errors import InputError
from capture4d.extraction.garment import ColourNotFoundError, cut_out
from capture4d.files.atomic import write_json, write_npz
from capture4d.runs.changes import StageChanges, say
from capture4d.runs.cluster.attempts import begin_frame, end_frame
from capture4d.runs.frame_lists import counted, frame_file, listed
from capture4d.runs.growing import GrowingStage, Pending, Reads, open_growing_stage, stage_changes
from capture4d.runs.made import Ledger, digest_of, make
from capture4d.runs.stage import StageResult
from capture4d.runs.workers import run_jobs, shared
from capture4d.settings import Count, settings
from capture4d.types import GarmentScan

__all__ = ["CLOUDS", "ExtractionSettings", "changes", "run"]

SCHEMA = 6
NAME = "extract"
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
    capture: Capture,
    output: Path,
    config: ExtractionSettings,
    *,
    workers: int = 1,
    overwrite: bool = False,
    for_tracking: bool | None = None,
) -> StageResult:
    """Extract the garment of every frame that has none yet, or has that of another scan, or of other colours.

    Args:
        for_tracking: keep the points that `track` reads of a scan as well; None: if the capture brings no poses.
    Raises:
        InputError: a scan is missing, none can be read, or the first that can lack the garment's colours; or these are
            to be learned and are not separable.
    """
    if not overwrite:
        require_same_take(output, capture)
    stage = open_growing_stage(
        output,
        name=NAME,
        schema=SCHEMA,
        config=config,
        reads=_reads(capture, config),
        sources={"capture": capture.path},
        overwrite=overwrite,
    )
    taken = colours_of_take(capture, output, learn=config.learn_colours)
    if taken.newly and taken.colours.printed:
        say(f"{output.name}: the cloth is printed: all between its painted borders is the garment")
    inputs = _inputs(capture, taken.colours)
    pending = _pending(capture, stage.ledger, inputs)
    if pending.replaced:
        say(f"{output.name}: {counted(pending.replaced, 'replaced')}")
    if pending.frames:
        if taken.frames and not taken.newly and taken.frames != listed(capture.frame_ids, most=0):
            say(f"{output.name}: the colours are kept as frames {taken.frames} gave them; "
                "--renew colours learns them anew")  # fmt: skip
        try:
            keeps = for_tracking if for_tracking is not None else not (capture.path / "poses.npz").is_file()
            points = KeptPoints.of(output.parent, capture, taken.colours, SamplingConfig()) if keeps else None
            _extract(_Extraction(capture, taken.colours, output, inputs, points), stage, pending.frames, workers)
        except InputError:
            if taken.newly:  # nothing was made with them
                (output / COLOURS).unlink(missing_ok=True)
            raise
        stage = stage.with_notes()
    if not taken.frames:
        described = described_colours(taken.colours)
        stage.make_unless_standing(
            output / COLOURS, lambda: write_json(output / COLOURS, described), inputs={"colours": digest_of(described)}
        )
    _say_estimated(stage, capture.frame_ids)
    paths = {frame_id: stage.frame_path(frame_id) for frame_id in capture.frame_ids}
    said = {frame_id: _said(stage.ledger, path).get("reason", "") for frame_id, path in paths.items()}
    return stage.finish_growing(
        [*paths.values()],
        frames=len(paths),
        failed={frame_id: reason for frame_id, reason in said.items() if reason},
    )


def changes(capture: Capture, output: Path, config: ExtractionSettings) -> StageChanges:
    """What `run` would do, and why; nothing is done."""

    def pending(ledger: Ledger) -> Pending:
        if capture.garment_colour is not None and not config.learn_colours:
            return _pending(capture, ledger, _inputs(capture, take_colours(capture)))
        kept = kept_colours(capture, output, learn=config.learn_colours)
        if kept is None:
            return Pending(capture.frame_ids)
        said = f"colours, learned from frames {kept.frames}"
        return _pending(capture, ledger, _inputs(capture, kept.colours)).keeping(said)

    return stage_changes(
        output, name=NAME, schema=SCHEMA, config=config, reads=_reads(capture, config), pending=pending
    )


def _reads(capture: Capture, config: ExtractionSettings) -> Reads:
    named = {}
    if not capture.boundary_colours and (config.learn_colours or capture.garment_colour is None):
        named["names of the template's borders"] = " ".join(template_loops(capture))
    said = capture.entries("units", "garment_colour", "boundary_colours")
    return Reads(said, named, capture.frame_ids, capture.left_out)


def _inputs(capture: Capture, colours: KnownColours) -> dict[str, str]:
    """What a frame is made from beside its scan."""
    return {"colours": digest_of(described_colours(colours)), "settings": digest_of([SCHEMA, capture.units])}


def _pending(capture: Capture, ledger: Ledger, inputs: Mapping[str, str]) -> Pending:
    """Frames that are to be extracted."""
    paths = {frame_id: frame_file(ledger.folder, frame_id) for frame_id in capture.frame_ids}
    frames = [each for each, path in paths.items() if not stands_with_scan(ledger, path, capture, each, inputs)]
    replaced = [each for each in frames if replaced_scan(ledger, paths[each], capture, each)]
    return Pending(tuple(frames), replaced=tuple(replaced))


def _said(ledger: Ledger, path: Path) -> Mapping[str, Any]:
    made = ledger.of(path)
    return {} if made is None else made.said


def _say_estimated(stage: GrowingStage, frame_ids: Sequence[int]) -> None:
    """Write down which frames' scans are points alone."""
    path = stage.path / CLOUDS
    found = [each for each in frame_ids if _said(stage.ledger, stage.frame_path(each)).get(ESTIMATED)]
    if not found:
        path.unlink(missing_ok=True)
    else:
        stage.make_unless_standing(path, lambda: write_json(path, {"frames": found}), inputs={"frames": listed(found)})


# --- frames ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Extraction:
    """What all frames share."""

    capture: Capture
    colours: KnownColours
    folder: Path
    inputs: Mapping[str, str]
    points: KeptPoints | None
    """Where what tracking reads is kept; None keeps none."""


def _extract(take: _Extraction, stage: GrowingStage, pending: Sequence[int], workers: int) -> None:
    done = _extract_first(take, stage, pending)
    jobs = [frame_id for frame_id in pending if frame_id != done]
    for _ in run_jobs(write_frame, jobs, prepare=shared(take), workers=workers, label="extract garment"):
        pass


def _extract_first(take: _Extraction, stage: GrowingStage, pending: Sequence[int]) -> int | None:
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
    for frame_id in take.capture.frame_ids:
        if frame_id not in waiting:
            if _said(stage.ledger, stage.frame_path(frame_id)).get("reason"):
                continue
            return None
        fault = write_frame(take, frame_id, keep_faults=False)
        if fault is None:
            return frame_id
        if isinstance(fault, ColourNotFoundError):
            absent.append(fault)
            if len(absent) == LOOKED_AT:
                break
        else:
            damaged.append(fault)
    raise (absent or damaged)[0]


def extract_frame(take: _Extraction, frame_id: int) -> tuple[GarmentScan, bool, ScanPoints | None]:
    """Read one scan and cut its garment out; whether the scan's faces are estimated; and the points to be kept."""
    source = str(scan_path(take.capture, frame_id))
    scan, estimated = read_frame(take.capture, frame_id)
    flat = take.colours.flat(scan)
    labels = label_scan(flat, take.colours)
    garment = cut_out(scan, take.colours, flat=flat, settled=labels, source=source)
    points = None
    if take.points is not None:
        with contextlib.suppress(InputError):  # that there are none is for `track` to say
            points = scan_points(flat, labels, SamplingConfig(), source=source)
    return garment, estimated, points


def write_frame(take: _Extraction, frame_id: int, *, keep_faults: bool = True) -> InputError | None:
    """Extract one frame and write it, or the reason why there is nothing to write.

    Args:
        keep_faults: False leaves a frame without a garment undone.
    Returns:
        Why there is no garment.
    """
    path = take.folder / "frames" / f"{frame_id:06d}.npz"
    fault, found, estimated, points = None, None, False, None
    with scan_looked_at(take.capture, frame_id) as looked:
        try:
            begin_frame(path)
            found, estimated, points = extract_frame(take, frame_id)
        except InputError as error:
            fault = error
    said: dict[str, Any] = {ESTIMATED: True} if estimated else {}
    if fault is not None:
        if not keep_faults:
            return fault
        said = {"reason": str(fault)} | ({} if isinstance(fault, ColourNotFoundError) else {DAMAGED: True})

    def write() -> None:
        if found is None:
            write_npz(path, reason=np.array(str(fault)))
        else:
            save_garment_scan(path, found, estimated=estimated)

    inputs = {**take.inputs, "scan": scan_digest(looked)}
    if take.points is not None and points is not None:
        take.points.write(frame_id, points, looked)
    make(take.folder, path, write, inputs=inputs, files=looked, said=said)
    end_frame(path)
    return fault
