"""A take, segment by segment: registered side by side, then joined, and its files written."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.segments import Segment
from capture4d.captures.work_folder import VERDICTS
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import nan_to_none, read_json, write_bytes, write_json, write_npz
from capture4d.runs.cluster.attempts import begin_frame, end_frame
from capture4d.runs.frame_lists import frame_file
from capture4d.runs.growing import GrowingStage
from capture4d.runs.made import noted
from capture4d.runs.workers import run_jobs, shared
from capture4d.types import GarmentScan
from registration.chain import Chain, Link
from registration.config import RegistrationConfig
from registration.predictions import Mover
from registration.quality import FrameQuality, assess
from registration.register import prepare_frame
from registration.seams import Seam, blended, seam_of, step_mm
from registration.sequence import register_run
from registration.template import TemplateAnalysis

__all__ = ["Take", "register_take"]


@dataclass(frozen=True, slots=True, eq=False)
class Take:
    """What all segments of a take share: the template on the person who moves it, ready to be registered."""

    analysis: TemplateAnalysis
    mover: Mover | None
    config: RegistrationConfig
    garment_folder: Path
    stage: GrowingStage
    chain: Chain

    def with_notes(self) -> Take:
        """The same, knowing what other processes have made since."""
        stage = self.stage.with_notes()
        return replace(self, stage=stage, chain=replace(self.chain, ledger=stage.ledger))

    def load(self, path: Path, frame_id: int) -> GarmentScan:
        """The garment of a frame's scan, to make a file of it."""
        begin_frame(path)
        return load_garment_scan(frame_file(self.garment_folder, frame_id), frame_id)


def register_take(take: Take, workers: int) -> GrowingStage:
    """Register segments side by side, join them, and register again those that cannot be joined, until all are."""
    while (todo := take.chain.todo()).is_any:
        if todo.join:
            runs = run_jobs(
                _join_segment, todo.join, prepare=shared(take), workers=workers, label="join segments",
            )  # fmt: skip
        else:
            runs = run_jobs(
                _register_segment, todo.register, prepare=shared(take), workers=workers, label="register",
                units=lambda segment: segment.stop - segment.lead, finished=partial(noted, take.stage.path),
            )  # fmt: skip
        for _ in runs:
            pass
        take = take.with_notes()
    return take.stage


def _register_segment(take: Take, segment: Segment) -> None:
    """Register and write the frames of a segment that do not stand, those before its first one at the beginning."""
    chain = take.chain
    if segment.index:
        _register_frames(take, chain.leads(segment), None)
    _register_frames(take, chain.frames(segment), chain.begin(segment))


def _register_frames(take: Take, places: Mapping[int, Path], begin: Link) -> None:
    chain = take.chain
    if chain.walk(places, begin)[0] is None:
        return

    def link(before: int | None) -> Link:
        return begin if before is None or before not in places else (before, places[before])

    def done(position: int, before: int | None) -> tuple[np.ndarray, bool] | None:
        standing = chain.ledger.stands(places[position], chain.inputs(position, link(before)))
        return _vertices(places[position]) if standing else None

    files = {chain.frame_ids[position]: path for position, path in places.items()}
    results = register_run(
        take.analysis, take.mover, list(places), chain.frame_ids, done=done, config=take.config,
        load=lambda frame_id: take.load(files[frame_id], frame_id),
        before=None if begin is None else (_vertices(begin[1])[0], begin[0]),
    )  # fmt: skip
    for result in results:
        record = _record(result.frame_id, result.quality) | {
            "cpu_s": round(result.cpu_s, 4),
            "started_from": result.started_from,
            "iterations": result.linear_iterations,
        }
        inputs = chain.inputs(result.position, link(result.before))
        _make_frame(take, places[result.position], result.vertices, result.quality, record, inputs)


def _vertices(path: Path) -> tuple[np.ndarray, bool]:
    """Of a frame's file, and whether they may be built upon."""
    with ArrayFile(path) as arrays:
        return arrays["vertices"], VERDICTS[int(arrays["verdict"])] != "failed"


def _join_segment(take: Take, segment: Segment) -> None:
    """Judge the seam before a segment, and make the frames in which the one before fades into it."""
    chain, fading = take.chain, take.chain.fading(segment)
    tails, leads = ([_vertices(chain.file(each, folder)) for each in fading] for folder in ("tails", "leads"))
    seam, path = seam_of(tails, leads, take.config.sequence.seam_mm), chain.seam(segment)
    if not chain.ledger.stands(path, chain.seam_inputs(segment)):
        take.stage.make(
            path,
            lambda: write_json(path, asdict(seam)),
            inputs=chain.seam_inputs(segment),
            said={"continues": seam.continues},
        )
    for at, position in enumerate(fading):
        inputs = chain.blend_inputs(segment, position)
        if chain.ledger.stands(chain.file(position), inputs):
            continue
        if seam.continues:
            _take_tail(take, position, inputs)
        else:
            _blend_frame(take, segment, position, (tails[at][0], leads[at][0]), seam, inputs)


def _take_tail(take: Take, position: int, inputs: Mapping[str, str]) -> None:
    """The frame as the segment before has it."""
    chain = take.chain
    tail, path = chain.file(position, "tails"), chain.file(position)
    record = read_json(chain.file(position, "tails", ".json"))

    def write() -> None:
        write_json(chain.file(position, "metrics", ".json"), record)
        write_bytes(path, tail.read_bytes())

    take.stage.make(path, write, inputs=inputs, said=chain.made(tail).said)


def _blend_frame(
    take: Take,
    segment: Segment,
    position: int,
    versions: tuple[np.ndarray, np.ndarray],
    seam: Seam,
    inputs: Mapping[str, str],
) -> None:
    """The frame between the two segments that have it."""
    begin, chain, frame_id = time.process_time(), take.chain, take.chain.frame_ids[position]
    vertices = blended(*versions, float(inputs["share"]))
    try:
        scan = prepare_frame(take.analysis, take.load(chain.file(position), frame_id), take.config)
        regions = None if take.mover is None else take.mover.regions
        quality = assess(take.analysis, scan, vertices.astype(np.float64), take.config.quality, regions=regions)
    except InputError as error:
        quality = FrameQuality.unmeasured(len(vertices), str(error))
    if seam.step_mm is None:
        quality = replace(
            quality,
            verdict="check" if quality.verdict == "good" else quality.verdict,
            reasons=(*quality.reasons, "joins two segments that have no sound frame in common"),
        )
    former = [read_json(chain.file(position, folder, ".json")) for folder in ("tails", "leads")]
    record = _record(frame_id, quality) | {
        "seam_mm": round(step_mm(*versions, len(chain.fading(segment))), 4),
        "cpu_s": round(time.process_time() - begin + sum(each["cpu_s"] for each in former), 4),
        "started_from": "two segments",
        "iterations": sum(each["iterations"] for each in former),
    }
    _make_frame(take, chain.file(position), vertices, quality, record, inputs)


def _record(frame_id: int, quality: FrameQuality) -> dict[str, Any]:
    """What is told of a frame, but for how it was made."""
    return {
        "frame_id": frame_id,
        "verdict": quality.verdict,
        "reasons": list(quality.reasons),
        **nan_to_none(quality.numbers),
        "regions": {name: nan_to_none(measures) for name, measures in quality.regions.items()},
    }


def _make_frame(
    take: Take,
    path: Path,
    vertices: np.ndarray,
    quality: FrameQuality,
    record: Mapping[str, Any],
    inputs: Mapping[str, str],
) -> None:
    def write() -> None:
        """The record first: the frame counts as done once its npz is there."""
        folder = "metrics" if path.parent.name == "frames" else path.parent.name
        write_json(frame_file(take.stage.path, record["frame_id"], ".json", folder), record)
        write_npz(path, vertices=vertices, **quality.vertex_arrays(), verdict=np.uint8(VERDICTS.index(quality.verdict)))

    take.stage.make(path, write, inputs=inputs, said={"sound": quality.verdict != "failed"})
    end_frame(path)
