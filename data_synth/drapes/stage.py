"""Sets of drapes as files: a garment of one style on one person, in poses that are drawn one by one from a seed.

OUTPUT/garment.npz      the garment as it was put on, unposed; bound to the body
OUTPUT/body.npz         the body it is draped on
OUTPUT/shards/NNNNNN.npz  poses, vertices and quality of so many drapes; the unit that resumes
OUTPUT/quality.jsonl    a line for each drape
OUTPUT/split.json       which drapes are to be learned from, validated and tested with, and which are pruned and why
OUTPUT/drapes.json      what all that is: garment, style, shape, joints

A drape is made of the seed and its own number alone. Sets of any number of workers are the same byte for byte.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.body.anny import load_anny
from capture4d.body.binding import bind
from capture4d.body.skinning import with_pose, with_shape
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import write_json, write_json_lines, write_npz
from capture4d.files.records import save_body, save_garment
from capture4d.runs.stage import Stage, StageResult, open_stage
from capture4d.runs.workers import run_jobs
from capture4d.types import Garment, Mesh
from data_synth.drapes.config import DrapesConfig
from data_synth.drapes.draping import Draper, symmetric_person
from data_synth.drapes.dressing import base_garment
from data_synth.drapes.garments import GARMENTS, parse_style, style_values
from data_synth.drapes.poses import draw_pose, moved_joints
from data_synth.drapes.quality import DrapeQuality, measure_drape

__all__ = ["run", "split_drapes"]

SCHEMA = 4
MEASURES = tuple(each.name for each in fields(DrapeQuality) if each.name != "reasons")


@dataclass(frozen=True, slots=True)
class _Job:
    """One shard: drapes `first` to `last` - 1, counted from 0."""

    stage: Stage
    config: DrapesConfig
    number: int
    first: int
    last: int

    @property
    def path(self) -> Path:
        return self.stage.frame_path(self.number, folder="shards")


def run(output: Path, config: DrapesConfig, *, workers: int = 1, overwrite: bool = False) -> StageResult:
    """Drape what is missing of a set; `failed` are the drapes that are pruned, and why, by number from 1.

    Raises:
        InputError: the style or the shape is none, or the folder holds something else.
    """
    parse_style(config.garment, config.style)
    body = load_anny()
    try:
        with_shape(body, np.array(config.beta))
    except InputError as error:
        raise InputError(f"--beta: {error}") from None
    stage = open_stage(output, name="synth-drapes", schema=SCHEMA, config=config, upstream={}, overwrite=overwrite)
    firsts = range(0, config.samples, config.shard)
    jobs = [
        _Job(stage, config, number + 1, first, min(first + config.shard, config.samples))
        for number, first in enumerate(firsts)
    ]
    pending = set(stage.pending([job.number for job in jobs], folder="shards"))
    lost = [job for job in jobs if job.number in pending]
    written = [output / name for name in ("garment.npz", "body.npz", "drapes.json")]
    if lost or not all(path.is_file() for path in written):
        # Before there are workers: what the machine's first shirt needs is simulated once, not by each of them.
        mean = symmetric_person(with_shape(body, np.zeros(0)))
        base_garment(config.garment, mean, config.vertices, config.garment_seed)
        _describe(output, config, Draper(config, body))
    for _ in run_jobs(
        _drape, lost, prepare=partial(_draper, config), workers=workers, label="drape",
        units=lambda job: job.last - job.first,
    ):  # fmt: skip
        pass
    quality = [row for job in jobs for row in _quality_rows(job)]
    pruned = {row["drape"]: "; ".join(row["reasons"]) for row in quality if row["reasons"]}
    written += [output / name for name in ("quality.jsonl", "split.json")]
    if lost or not all(path.is_file() for path in written):
        write_json_lines(output / "quality.jsonl", quality)
        kept = [row["drape"] for row in quality if not row["reasons"]]
        parts = split_drapes(kept, (config.validation, config.test), np.random.default_rng([config.seed, 1]))
        write_json(output / "split.json", {**parts, "pruned": {str(each): why for each, why in pruned.items()}})
    paths = [*written, *(job.path for job in jobs)]
    return stage.finish(paths, changed=bool(lost), frames=config.samples, failed=pruned)


def split_drapes(kept: Sequence[int], held_out: tuple[float, float], rng: np.random.Generator) -> dict[str, list[int]]:
    """Numbers of drapes to train, validate and test with, drawn at random.

    Args:
        held_out: shares for validation and for tests.
    """
    order = rng.permutation(np.asarray(kept, int))
    validation, test = (round(share * len(order)) for share in held_out)
    cut = np.split(order, [validation, validation + test])
    return {name: sorted(part.tolist()) for name, part in zip(("validation", "test", "train"), cut, strict=True)}


def _draper(config: DrapesConfig) -> Draper:
    return Draper(config, load_anny())


def _drape(draper: Draper, job: _Job) -> None:
    """Draw, drape and measure the poses of a shard, and write them."""
    config, limbs = job.config, GARMENTS[job.config.garment].limbs
    poses, vertices, quality, cuts, drawn = [], [], [], [], []
    for number in range(job.first, job.last):
        rng = np.random.default_rng([config.seed, 0, number])
        rotations, count = draw_pose(draper.person, limbs, config.poses, rng)
        drape = draper.drape(rotations)
        poses.append(rotations)
        drawn.append(count)
        vertices.append(drape.vertices)
        measured, cut = measure_drape(draper, rotations, drape)
        quality.append(measured)
        cuts.append(cut)
    count = len(quality)
    write_npz(
        job.path,
        drapes=np.arange(job.first, job.last, dtype=np.int32) + 1,
        rotations=np.array(poses, np.float32),
        shapes=np.tile(np.array(config.beta, np.float32), (count, 1)),
        styles=np.tile(np.array([*style_values(draper.style).values()], np.float32), (count, 1)),
        vertices=np.array(vertices, np.float32),
        kept=np.array([not each.reasons for each in quality]),
        quality=np.array([[getattr(each, name) for name in MEASURES] for each in quality], np.float64),
        cuts=np.packbits(cuts, axis=1),
        drawn=np.array(drawn, np.int32),
        reasons=np.array(["; ".join(each.reasons) for each in quality]),
    )


def _quality_rows(job: _Job) -> list[dict[str, Any]]:
    """What a shard says of its drapes, as rows of quality.jsonl."""
    with ArrayFile(job.path) as arrays:
        numbers, quality, drawn, reasons = (arrays[name] for name in ("drapes", "quality", "drawn", "reasons"))
    return [
        {
            "drape": int(number),
            **dict(zip(MEASURES, map(float, measures), strict=True)),
            "drawn": int(count),
            "reasons": [part for part in str(why).split("; ") if part],
        }
        for number, measures, count, why in zip(numbers, quality, drawn, reasons, strict=True)
    ]


def _describe(output: Path, config: DrapesConfig, draper: Draper) -> None:
    """Write what all drapes of a set share."""
    person, mesh = draper.person, draper.mesh
    at_rest = np.repeat(np.eye(3)[None], len(person.joints), axis=0)
    faces, barycentric, _ = bind(draper.rest, mesh.faces, with_pose(person, at_rest, np.zeros(3)))
    garment = Garment(
        template=Mesh(draper.rest.astype(np.float32), mesh.faces, mesh.uv.astype(np.float32)),
        loops={name: loop.astype(np.int32) for name, loop in mesh.loops.items()},
        embedding_faces=faces,
        embedding_barycentric=barycentric,
        skin_weights=draper.skin_weights.astype(np.float32),
        body_shape=person.shape.astype(np.float32),
        pattern_metres=1.0,
    )
    save_garment(output / "garment.npz", garment)
    save_body(output / "body.npz", person.body)
    assert mesh.mirror is not None
    note = {
        "garment": config.garment,
        "style": style_values(draper.style),
        "shape": [*config.beta],
        "samples": config.samples,
        "joint_names": [*person.body.joint_names],
        "moved_joints": [*moved_joints(GARMENTS[config.garment].limbs)],
        "pose": "rotations relative to the parent joint, about axes aligned with the world; the root is not turned",
        "quality": [*MEASURES],
        "mirror": mesh.mirror.tolist(),
        "settings": asdict(config),
    }
    write_json(output / "drapes.json", note)
