"""The registration stage: CAPTURE and WORK/garment in, WORK/registration out.

stage.json                what was run
garment.npz               the template
print.npz                 what is printed on it, where anything is (`print_stage`); not made where colours are off
frames/000123.npz         vertices (V, 3) float32, verdict (0 good, 1 check, 2 failed), and per vertex (V,) residual_m,
                          border_error_m, stretch float32 and flipped bool, as in `FrameQuality`
metrics/000123.json       the frame's numbers, reasons and CPU time
tails/, leads/, seams/    where segments overlap: what both made of a frame, and how they go together (`chain`)
vertices.npy              (T, V, 3) float32, all frames
metrics.jsonl             the frames' metrics, one per line

A frame is made from the garment of its scan, the template, the body and its pose, and from the frame that it starts
from, with that frame's pose. What is changed in a frame goes on to the frames after it in its segment, as far as they
come out otherwise; and into the next as far as that overlaps.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path

import numpy as np

from capture4d.body.binding import with_body_shape
from capture4d.body.sewing_pattern import with_known_pattern
from capture4d.captures.capture import Capture
from capture4d.captures.segments import cut
from capture4d.captures.work_folder import (
    REGISTER,
    load_records,
    load_tracking,
    require_from_scans,
    stack_vertices,
    tracking_digest,
)
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_json_lines
from capture4d.files.records import save_garment
from capture4d.runs.changes import StageChanges
from capture4d.runs.frame_lists import frame_file
from capture4d.runs.growing import GrowingStage, Pending, Reads, open_growing_stage, stage_changes
from capture4d.runs.made import Ledger, digest_of
from capture4d.runs.stage import StageResult
from capture4d.types import Body, Garment, PoseSequence
from registration.chain import Chain
from registration.config import RegistrationConfig
from registration.predictions import Mover, bent_away
from registration.print_stage import made_print, print_inputs, settings_with_print
from registration.prints import load_print
from registration.take import Take, register_take
from registration.template import TemplateAnalysis, analyse_template

__all__ = ["changes", "run"]

SCHEMA = 6


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
    if chain.todo().is_any:
        analysis, mover = opened()
        if printed:
            analysis = replace(analysis, cloth=load_print(printed[0], analysis))
        stage = register_take(Take(analysis, mover, config, garment_folder, stage, chain), workers)
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
        todo, ids = chain.todo(), capture.frame_ids
        missing = {at for at in range(len(ids)) if ledger.of(chain.file(at)) is None}
        certain = {*todo.certain} | ({*todo.following} & missing)
        return Pending(
            tuple(ids[at] for at in sorted(certain)), tuple(ids[at] for at in todo.following if at not in certain)
        )

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


def _chain(
    capture: Capture,
    ledger: Ledger,
    garments: Ledger,
    config: RegistrationConfig,
    template: tuple[Garment, tuple[Body, PoseSequence] | None],
    body_folder: Path | None,
) -> Chain:
    garment, moving = template
    frame_ids, body, poses = capture.frame_ids, "", [""] * len(capture.frame_ids)
    sequence, pieces = config.sequence, cut(len(frame_ids), max(len(frame_ids), 1), 0)
    if moving is not None and garment.skin_weights is not None:
        body = capture.body_digest or "built-in"
        if body_folder is not None:
            made = Ledger.read(body_folder).of(body_folder / "body.npz")
            body = "" if made is None else made.digest
        body = digest_of([body, moving[1].shape])
        poses = [_array_digest(moving[1].rotations[row], moving[1].translations[row]) for row in range(len(frame_ids))]
        pieces = cut(
            len(frame_ids),
            sequence.segment,
            0 if sequence.start == "skinned" else sequence.overlap,
            unease=bent_away(garment.skin_weights, *moving),
        )
    read = asdict(config)
    for apart in ("segment", "overlap", "seam_mm"):  # what they decide shows in where frames start from
        del read["sequence"][apart]
    found = [garments.of(frame_file(garments.folder, frame_id)) for frame_id in frame_ids]
    return Chain(
        ledger,
        frame_ids,
        digest_of([read, _garment_digest(garment), body]),
        tuple("" if each is None else each.digest for each in found),
        tuple(poses),
        pieces,
        sequence.seam_mm,
        sequence.start != "skinned",
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


# --- the take --------------------------------------------------------------------------------------------------------


def _gather(stage: GrowingStage, frame_ids: tuple[int, ...], digest: str) -> None:
    """Stack the frames and their metrics, unless these are stacked."""
    vertices, metrics = stage.path / "vertices.npy", stage.path / "metrics.jsonl"
    records = (read_json(stage.frame_path(frame_id, ".json", folder="metrics")) for frame_id in frame_ids)
    stage.make_unless_standing(vertices, lambda: stack_vertices(stage, frame_ids), inputs={"frames": digest})
    stage.make_unless_standing(metrics, lambda: write_json_lines(metrics, records), inputs={"frames": digest})
