"""The stage that makes pairs of normal maps: a registered WORK in, WORK/wrinkles/pairs out.

A garment that was animated has no scans. If it moves as a take did, its low maps pair with that take's high ones: what
a network sees that is to work on the model's answers.

stage.json            what was made
template.npz          the garment, its UVs as the maps have them, its vertices as garment coordinates refer to them
low/000123.png        normals of the template, garment coordinates, 16 bit; alpha: the texel shows something
high/000123.png       normals of the scan; alpha: they are known
metrics/000123.json   share of the texels that are known, and the angle between the two
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.work_folder import WorkFolder, open_work
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_bytes, write_json
from capture4d.files.records import save_garment
from capture4d.runs.stage import Stage, StageResult, open_stage, require_complete
from capture4d.runs.workers import run_jobs, shared
from capture4d.types import Mesh, RegisteredSequence
from wrinkles.normal_maps.config import PairConfig
from wrinkles.normal_maps.pair_files import MAPS, PAIRS, PairFolder, layout_digest, open_pairs
from wrinkles.normal_maps.spaces import decode_png, encode_png
from wrinkles.normal_maps.template import FramePair, MapTemplate, frame_pairs

__all__ = ["ensure_pairs", "run"]

SCHEMA = 1
RUN_FRAMES = 24
"""Frames a worker makes in a row; at both ends of a run a scan is read twice."""


@dataclass(frozen=True, slots=True, eq=False)
class _Take:
    """What the frames of a take are made from."""

    work: WorkFolder
    stage: Stage
    config: PairConfig
    template: MapTemplate
    fps: float

    def scan(self, frame_id: int) -> Mesh | None:
        """The garment's scan, None if it says nothing."""
        if frame_id in self.work.failed_frames:
            return None
        return load_garment_scan(self.work.path / "garment" / "frames" / f"{frame_id:06d}.npz", frame_id).mesh


def run(
    work: WorkFolder,
    config: PairConfig,
    *,
    high_from: WorkFolder | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Make the pair of every frame that has none yet.

    Args:
        high_from: a work folder with finished pairs of the same frames, whose high maps are taken.
    Raises:
        InputError: the work folder lacks its registration or its scans' garments, the template has no usable UVs, or
            the pairs to borrow from are of another template or other frames.
    """
    if high_from is not None:
        return _borrow(work, high_from, config, overwrite=overwrite)
    upstream, sequence = _inputs(work), work.registered
    fps, template = work.capture.fps, MapTemplate.create(sequence.garment, config.map)
    stage = open_stage(
        work.path / PAIRS, name=MAPS, schema=SCHEMA, config=config, upstream=upstream,
        overwrite=overwrite,
    )  # fmt: skip
    if not (stage.path / "template.npz").is_file():
        save_garment(stage.path / "template.npz", replace(sequence.garment, template=template.mesh))
    frame_ids = sequence.frame_ids.tolist()
    pending = set(_pending(stage, frame_ids))
    runs = [range(start, min(start + RUN_FRAMES, len(frame_ids))) for start in range(0, len(frame_ids), RUN_FRAMES)]
    jobs = [positions for positions in runs if pending.intersection(frame_ids[p] for p in positions)]

    def finished() -> int:
        return len(frame_ids) - len(_pending(stage, frame_ids))

    take = shared(_Take(work, stage, config, template, fps))
    for _ in run_jobs(_make, jobs, prepare=take, workers=workers, label="normal maps", units=len, finished=finished):
        pass
    maps = [stage.frame_path(frame_id, ".png", folder=folder) for folder in ("low", "high") for frame_id in frame_ids]
    return stage.finish([stage.path / "template.npz", *maps])


def _borrow(work: WorkFolder, lender: WorkFolder, config: PairConfig, *, overwrite: bool) -> StageResult:
    """Pairs of this sequence's low maps with another's high maps; the frames that both have."""
    digest, lent = work.registered_digest, open_pairs(lender.path)
    sequence, theirs = work.registered, lender.registered
    template = MapTemplate.create(sequence.garment, config.map)
    if layout_digest(lent.template, config.map.size) != layout_digest(template.mesh, config.map.size):
        raise InputError(f"expected maps of the template and layout of {work.path}, found others", where=lender.path)
    template = template.referred_to(lent.template.vertices)
    rows = {int(frame_id): row for row, frame_id in enumerate(theirs.frame_ids)}
    common = [(row, int(frame_id)) for row, frame_id in enumerate(sequence.frame_ids) if int(frame_id) in rows]
    if not common:
        raise InputError(
            f"expected frames of {work.path}, found none of its {len(sequence.frame_ids)}", where=lender.path
        )
    stage = open_stage(
        work.path / PAIRS, name=MAPS, schema=SCHEMA, config=config,
        upstream={"registration": digest, "pairs": lent.digest}, sources={"pairs": lent.path}, overwrite=overwrite,
    )  # fmt: skip
    if not (stage.path / "template.npz").is_file():
        referred = template.mesh.with_vertices(template.reference)
        save_garment(stage.path / "template.npz", replace(sequence.garment, template=referred))
    pending = set(_pending(stage, [frame_id for _, frame_id in common]))
    shown = template.raster.image(np.ones(len(template.raster.inside), bool))
    for row, frame_id in common:
        if frame_id not in pending:
            continue
        vertices = np.array(sequence.vertices[row])
        ours = template.rotation(vertices)
        turn = (template.rotation(np.array(theirs.vertices[rows[frame_id]])).T @ ours).astype(np.float32)
        path = lent.path / "high" / f"{frame_id:06d}.png"
        high, known = decode_png(path.read_bytes(), source=str(path))
        if high.shape[0] != template.raster.size:
            raise InputError(f"expected a map of {template.raster.size} texels, found {high.shape[0]}", where=path)
        low = template.raster.image(template.low_normals(vertices) @ ours.astype(np.float32))
        write_bytes(stage.frame_path(frame_id, ".png", folder="low"), encode_png(low, shown))
        write_bytes(stage.frame_path(frame_id, ".png", folder="high"), encode_png(high @ turn, known))
    maps = [stage.frame_path(frame_id, ".png", folder=folder) for folder in ("low", "high") for _, frame_id in common]
    return stage.finish([stage.path / "template.npz", *maps])


def ensure_pairs(work: WorkFolder, config: PairConfig, *, workers: int = 1) -> PairFolder:
    """A work folder's pairs; made, unless it has finished ones of its present inputs, whatever their settings.

    Raises:
        InputError: an input is missing, or it is not what the pairs were made from.
    """
    record_path = work.path / PAIRS / "stage.json"
    record = read_json(record_path) if record_path.is_file() else {}
    made_from, complete = record.get("upstream", {}), record.get("status") == "complete"
    if "pairs" in made_from:
        lender = open_work(Path(record["sources"]["pairs"]).parents[1])
        lent = {"registration": work.registered_digest, "pairs": open_pairs(lender.path).digest}
        if not complete or made_from != lent:
            run(work, config, high_from=lender, workers=workers)
    elif not complete or made_from != _inputs(work):
        run(work, config, workers=workers)
    return open_pairs(work.path)


def _inputs(work: WorkFolder) -> dict[str, str]:
    """Digests of what pairs of a take's own scans are made from."""
    return {
        "registration": work.registered_digest,
        "garment": require_complete(
            work.path / "garment", "extract", f"capture4d extract CAPTURE --output {work.path}"
        ),
    }


def _pending(stage: Stage, frame_ids: Sequence[int]) -> list[int]:
    """Frames that lack one map or the other."""
    missing = {frame_id for folder in ("low", "high") for frame_id in stage.pending(frame_ids, ".png", folder=folder)}
    return [frame_id for frame_id in frame_ids if frame_id in missing]


def _make(take: _Take, positions: range) -> int:
    """Make and write the missing frames of a run; how many there were."""
    sequence = take.work.registered
    frame_ids = sequence.frame_ids.tolist()
    pending = set(_pending(take.stage, [frame_ids[p] for p in positions]))
    missing = [position for position in positions if frame_ids[position] in pending]
    pairs = frame_pairs(
        take.template, frame_ids, range(missing[0], missing[-1] + 1),
        vertices=lambda position: np.array(sequence.vertices[position]),
        scan=lambda position: take.scan(frame_ids[position]), fps=take.fps, config=take.config.projection,
    )  # fmt: skip
    for pair in pairs:
        _write(take.stage, take.template, sequence, pair)
    return len(missing)


def _write(stage: Stage, template: MapTemplate, sequence: RegisteredSequence, pair: FramePair) -> None:
    """The high map last: with it the frame counts as done."""
    raster, valid = template.raster, pair.high.valid
    vertices = np.array(sequence.vertices[sequence.frame_ids.tolist().index(pair.frame_id)])
    rotation = template.rotation(vertices).astype(np.float32)
    shown = raster.image(np.ones(len(valid), bool))
    angle = np.degrees(np.arccos(np.clip((pair.low * pair.high.normals).sum(axis=1), -1, 1)))
    measured = valid & raster.inside
    write_json(
        stage.frame_path(pair.frame_id, ".json", folder="metrics"),
        {
            "frame_id": pair.frame_id,
            "valid_percent": 100 * float(measured.sum() / max(raster.inside.sum(), 1)),
            "difference_deg": float(angle[measured].mean()) if measured.any() else None,
        },
    )
    low = encode_png(raster.image(pair.low @ rotation), shown)
    high = encode_png(raster.image(pair.high.normals @ rotation), raster.image(valid))
    write_bytes(stage.frame_path(pair.frame_id, ".png", folder="low"), low)
    write_bytes(stage.frame_path(pair.frame_id, ".png", folder="high"), high)
