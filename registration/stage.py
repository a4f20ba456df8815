"""The registration stage: CAPTURE and WORK/garment in, WORK/registration out.

stage.json                what was run
garment.npz               the template
print.npz                 what is printed on it, where anything is (`print_stage`); not made where colours are off
frames/000123.npz         vertices (V, 3) float32, verdict (0 good, 1 check, 2 failed), and per vertex (V,) residual_m,
                          border_error_m, stretch float32 and flipped bool, as in `FrameQuality`
metrics/000123.json       the frame's numbers, reasons and CPU time
vertices.npy              (T, V, 3) float32, all frames
metrics.jsonl             the frames' metrics, one per line

A frame is made from the garment of its scan, the template, the body and its pose, and from the frame that it starts
from, with that frame's pose. What is changed in a frame goes on to the frames after it in its segment, as far as they
come out otherwise.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from capture4d.body.binding import with_body_shape
from capture4d.body.sewing_pattern import with_known_pattern
from capture4d.captures.capture import Capture
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.work_folder import (
    REGISTER,
    VERDICTS,
    load_records,
    load_tracking,
    require_from_scans,
    stack_vertices,
    tracking_digest,
)
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import nan_to_none, read_json, write_json, write_json_lines, write_npz
from capture4d.files.records import save_garment
from capture4d.runs.changes import StageChanges
from capture4d.runs.frame_lists import frame_file
from capture4d.runs.growing import GrowingStage, Pending, Reads, open_growing_stage, stage_changes
from capture4d.runs.made import Ledger, digest_of, noted
from capture4d.runs.stage import Stage, StageResult
from capture4d.runs.workers import run_jobs, shared
from capture4d.types import Body, Garment, PoseSequence
from registration.config import RegistrationConfig
from registration.predictions import Mover, bend_deg
from registration.print_stage import made_print, print_inputs, settings_with_print
from registration.prints import load_print
from registration.sequence import FrameResult, register_run, segments
from registration.template import TemplateAnalysis, analyse_template

__all__ = ["changes", "run"]

SCHEMA = 4


def run(
    capture: Capture,
    garment_folder: Path,
    output: Path,
    config: RegistrationConfig,
    *,
    body_folder: Path | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Register the template to every frame that has none yet, or was made from something else.

    Args:
        body_folder: tracked body to move the template with; None takes the poses that the capture brings.
    Raises:
        InputError: the garments are missing or unfinished, or those of another capture, or poses, body and template
            disagree.
    """
    command = f"capture4d extract {capture.path} --output {output.parent}"
    digest, garments = require_from_scans(garment_folder, "extract", command, capture)
    stages = {"garment": digest}
    if body_folder is not None:
        stages["body"] = tracking_digest(body_folder, capture)
    stage = open_growing_stage(
        output,
        name=REGISTER,
        schema=SCHEMA,
        config=config,
        reads=_reads(capture, stages, body_folder),
        sources={"capture": capture.path},
        overwrite=overwrite,
    )
    moving = _moving(capture, body_folder)
    garment = _shaped(capture, moving)
    path = output / "garment.npz"
    stage.make_unless_standing(path, lambda: save_garment(path, garment), inputs={"garment": _garment_digest(garment)})
    chain = _chain(capture, stage.ledger, garments, config, (garment, moving), body_folder)

    @cache
    def opened() -> tuple[TemplateAnalysis, Mover | None]:
        analysis = analyse_template(garment, config)
        return analysis, None if moving is None else Mover.create(analysis, *moving)

    printed: list[Path] = []
    if config.colour.use == "auto":
        made_from = print_inputs(config.colour, chain.settings, chain.garments, chain.poses, capture.fps)
        printed = made_print(stage, made_from, garment_folder, (capture.frame_ids, capture.fps), config, opened)
        chain = replace(chain, settings=settings_with_print(chain.settings, stage.ledger))
    jobs = [each for each in chain.segments if chain.first_stale(each) is not None]
    if jobs:
        analysis, mover = opened()
        if printed:
            analysis = replace(analysis, cloth=load_print(printed[0], analysis))
        take = _Take(analysis, mover, config, garment_folder, stage, chain)
        for _ in run_jobs(
            _register_segment, jobs, prepare=shared(take), workers=workers, label="register", units=len,
            finished=partial(noted, output),
        ):  # fmt: skip
            pass
        stage = stage.with_notes()
    paths = [stage.frame_path(frame_id) for frame_id in capture.frame_ids]
    _gather(stage, capture.frame_ids, stage.digest_of_all(paths))
    return stage.finish_growing(
        [path, output / "vertices.npy", *paths, *printed],
        frames=len(paths),
        failed={
            record["frame_id"]: "; ".join(record["reasons"])
            for record in load_records(output)
            if record["verdict"] == "failed"
        },
    )


def changes(
    capture: Capture,
    garment_folder: Path,
    output: Path,
    config: RegistrationConfig,
    *,
    body_folder: Path | None = None,
) -> StageChanges:
    """What `run` would do with the garments and the body that are there now, and why; nothing is done."""

    def pending(ledger: Ledger) -> Pending:
        garments = Ledger.read(garment_folder)
        if body_folder is not None and not (body_folder / "poses.npz").is_file():
            return Pending(capture.frame_ids)
        moving = _moving(capture, body_folder)
        chain = _chain(capture, ledger, garments, config, (_shaped(capture, moving), moving), body_folder)
        chain = replace(chain, settings=settings_with_print(chain.settings, ledger))
        certain, following = set[int](), set[int]()
        for positions in chain.segments:
            first = chain.first_stale(positions)
            if first is not None:
                certain.add(first)
                following.update(position for position in positions if position > first)
        missing = {at for at, each in enumerate(capture.frame_ids) if ledger.of(chain.path(each)) is None}
        certain |= following & missing
        ids = capture.frame_ids
        return Pending(tuple(ids[at] for at in sorted(certain)), tuple(ids[at] for at in sorted(following - certain)))

    return stage_changes(
        output, name=REGISTER, schema=SCHEMA, config=config, reads=_reads(capture, {}, body_folder), pending=pending
    )


def _reads(capture: Capture, stages: dict[str, str], body_folder: Path | None) -> Reads:
    named = {"template": capture.template_digest}
    if body_folder is None and capture.motion_digest:
        named["motion"] = capture.motion_digest
    if not stages:
        stages = dict.fromkeys(("garment", "body"), "")
    return Reads({}, named, capture.frame_ids, capture.left_out, stages)


def _moving(capture: Capture, body_folder: Path | None) -> tuple[Body, PoseSequence] | None:
    """The body that moves the template, and its poses, a frame of the take each."""
    if body_folder is None:
        return capture.posed_body
    body, poses = load_tracking(body_folder)
    return body, poses.of_frames(np.array(capture.frame_ids, np.int32))


def _shaped(capture: Capture, moving: tuple[Body, PoseSequence] | None) -> Garment:
    """The template on the person who moves it."""
    garment = with_known_pattern(capture.template)
    if moving is not None:
        garment = with_body_shape(garment, moving[0], moving[1].shape)
    if capture.boundary_colours and not garment.loops:
        raise InputError("expected a template with open borders, as its scans have; found none", where=capture.path)
    return garment


# --- what a frame is made from -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Chain:
    """What each frame would be made from, by position in the take."""

    ledger: Ledger
    frame_ids: tuple[int, ...]
    settings: str
    """Digest of what all frames share: settings, template, body."""
    garments: tuple[str, ...]
    """Digest of the garment of each frame's scan."""
    poses: tuple[str, ...]
    """Of each frame's pose; empty without poses."""
    segments: tuple[range, ...]
    """The take cut at its keyframes."""
    reads_before: bool
    """Whether a frame starts from the one before; else it matters only that there is one."""

    def path(self, frame_id: int) -> Path:
        return frame_file(self.ledger.folder, frame_id)

    def inputs(self, position: int, before: int | None) -> dict[str, str]:
        """What the frame at a position is made from, if it can start from the one at another."""
        found = {"settings": self.settings, "garment": self.garments[position], "pose": self.poses[position]}
        if before is None or not self.reads_before:
            return {**found, "start": "distant" if before is None else "near"}
        made = self.ledger.of(self.path(self.frame_ids[before]))
        assert made is not None
        return {**found, "start": f"{made.digest} {self.poses[before]}"}

    def stands(self, position: int, before: int | None) -> bool:
        return self.ledger.stands(self.path(self.frame_ids[position]), self.inputs(position, before))

    def first_stale(self, positions: range) -> int | None:
        """The first frame of a segment that is to be registered, None if all stand."""
        before = None
        for position in positions:
            if not self.stands(position, before):
                return position
            made = self.ledger.of(self.path(self.frame_ids[position]))
            assert made is not None
            before = position if made.said["sound"] else before
        return None


def _chain(
    capture: Capture,
    ledger: Ledger,
    garments: Ledger,
    config: RegistrationConfig,
    template: tuple[Garment, tuple[Body, PoseSequence] | None],
    body_folder: Path | None,
) -> _Chain:
    garment, moving = template
    frame_ids, body, poses = capture.frame_ids, "", [""] * len(capture.frame_ids)
    pieces = segments(None, len(frame_ids), config.sequence)
    if moving is not None and garment.skin_weights is not None:
        body = capture.body_digest or "built-in"
        if body_folder is not None:
            made = Ledger.read(body_folder).of(body_folder / "body.npz")
            body = "" if made is None else made.digest
        body = digest_of([body, moving[1].shape])
        poses = [_array_digest(moving[1].rotations[row], moving[1].translations[row]) for row in range(len(frame_ids))]
        pieces = segments(bend_deg(garment.skin_weights, moving[1]), len(frame_ids), config.sequence)
    read = asdict(config)
    for cut in ("segment", "keyframe_bend_deg"):  # what they decide shows in where frames start from
        del read["sequence"][cut]
    found = [garments.of(frame_file(garments.folder, frame_id)) for frame_id in frame_ids]
    return _Chain(
        ledger,
        frame_ids,
        digest_of([read, _garment_digest(garment), body]),
        tuple("" if each is None else each.digest for each in found),
        tuple(poses),
        tuple(pieces),
        config.sequence.start != "skinned",
    )


def _garment_digest(garment: Garment) -> str:
    template = garment.template
    arrays = [template.vertices, template.faces, *garment.loops.values()]
    arrays += [each for each in (template.uv, garment.skin_weights) if each is not None]
    return digest_of([_array_digest(*arrays), list(garment.loops), garment.pattern_metres])


def _array_digest(*arrays: np.ndarray) -> str:
    total = hashlib.sha256()
    for each in arrays:
        total.update(f"{each.dtype} {each.shape} ".encode())
        total.update(np.ascontiguousarray(each).tobytes())
    return total.hexdigest()


# --- frames ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Take:
    """What all segments of a take share: the template on the person who moves it, ready to be registered."""

    analysis: TemplateAnalysis
    mover: Mover | None
    config: RegistrationConfig
    garment_folder: Path
    stage: GrowingStage
    chain: _Chain


def _register_segment(take: _Take, positions: range) -> int:
    """Register and write the frames of a segment that do not stand; how many they were."""
    chain = take.chain

    def done(position: int, before: int | None) -> tuple[np.ndarray, bool] | None:
        if not chain.stands(position, before):
            return None
        with ArrayFile(chain.path(chain.frame_ids[position])) as arrays:
            return arrays["vertices"], VERDICTS[int(arrays["verdict"])] != "failed"

    results = register_run(
        take.analysis,
        take.mover,
        positions,
        chain.frame_ids,
        load=lambda frame_id: load_garment_scan(take.garment_folder / "frames" / f"{frame_id:06d}.npz", frame_id),
        done=done,
        config=take.config,
    )
    count = 0
    for result in results:
        _make_frame(take, result)
        count += 1
    return count


def _make_frame(take: _Take, result: FrameResult) -> None:
    stage = take.stage
    stage.make(
        stage.frame_path(result.frame_id),
        lambda: _write_frame(stage, result),
        inputs=take.chain.inputs(result.position, result.before),
        said={"sound": result.quality.verdict != "failed"},
    )


def _write_frame(stage: Stage, result: FrameResult) -> None:
    """Metrics first: the frame counts as done once its npz is there."""
    numbers = nan_to_none(result.quality.numbers)
    write_json(
        _metrics_path(stage, result.frame_id),
        {
            "frame_id": result.frame_id,
            "verdict": result.quality.verdict,
            "reasons": list(result.quality.reasons),
            **numbers,
            "regions": {name: nan_to_none(measures) for name, measures in result.quality.regions.items()},
            "cpu_s": round(result.cpu_s, 4),
            "started_from": result.started_from,
            "iterations": result.linear_iterations,
        },
    )
    write_npz(
        stage.frame_path(result.frame_id),
        vertices=result.vertices,
        **result.quality.vertex_arrays(),
        verdict=np.uint8(VERDICTS.index(result.quality.verdict)),
    )


def _metrics_path(stage: Stage, frame_id: int) -> Path:
    return stage.frame_path(frame_id, ".json", folder="metrics")


def _gather(stage: GrowingStage, frame_ids: tuple[int, ...], digest: str) -> None:
    """Stack the frames and their metrics, unless these are stacked."""
    vertices, metrics = stage.path / "vertices.npy", stage.path / "metrics.jsonl"
    records = (read_json(_metrics_path(stage, frame_id)) for frame_id in frame_ids)
    stage.make_unless_standing(vertices, lambda: stack_vertices(stage, frame_ids), inputs={"frames": digest})
    stage.make_unless_standing(metrics, lambda: write_json_lines(metrics, records), inputs={"frames": digest})
