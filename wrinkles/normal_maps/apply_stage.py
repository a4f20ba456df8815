"""The stage that makes high-resolution maps for a registered or animated WORK: WORK/wrinkles/generated out.

stage.json           what was made
template.npz         the garment, its UVs as the maps have them
tangents.npy         (F, 3, 4) float32: the template's tangent frames in the rest pose, as glTF's TANGENT
frames/000123.png    tangent-space normals relative to the frame's registered mesh, OpenGL's +Y (or -Y), 16 or 8 bit
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from capture4d.captures.work_folder import WorkFolder
from capture4d.errors import InputError
from capture4d.files.atomic import file_digest, write_bytes, write_npy
from capture4d.files.records import save_garment
from capture4d.geometry.tangents import corner_tangents
from capture4d.runs.stage import Stage, StageResult, open_stage
from capture4d.runs.workers import run_jobs
from wrinkles.normal_maps.config import ApplyConfig
from wrinkles.normal_maps.inference import generator_path, load_model
from wrinkles.normal_maps.pair_files import layout_digest
from wrinkles.normal_maps.spaces import encode_png, encode_png8, flip_green
from wrinkles.normal_maps.template import MapTemplate
from wrinkles.normal_maps.wrinkle_maps import MapMaker, require_size

__all__ = ["run"]

SCHEMA = 2
CHUNK = 32


@dataclass(frozen=True, slots=True, eq=False)
class _Take:
    """What the maps of a take are made from."""

    work: WorkFolder
    stage: Stage
    config: ApplyConfig
    maker: MapMaker


def run(
    model: Path, work: WorkFolder, config: ApplyConfig, *, workers: int = 1, overwrite: bool = False
) -> StageResult:
    """Make the map of every registered frame that has none yet.

    Args:
        model: folder of `wrinkles train`, or its generator.safetensors.
    Raises:
        InputError: there is no registration, no usable model, the model was trained on another template's UVs, or its
            layout does not permit maps of that size.
    """
    weights = generator_path(model)
    generator, digest = load_model(weights), work.registered_digest
    sequence = work.registered
    template = MapTemplate.create(sequence.garment, generator.maps)
    if layout_digest(template.mesh, generator.maps.size) != generator.layout_digest:
        raise InputError(f"expected the template that {weights} was trained on, found another mesh or UV layout",
                         where=work.path)  # fmt: skip
    require_size(generator, config.texels)
    upstream = {"registration": digest, "model": file_digest([weights], root=weights.parent)}
    stage = open_stage(
        work.path / "wrinkles" / "generated", name="wrinkles apply", schema=SCHEMA,
        config=config, upstream=upstream, overwrite=overwrite,
    )  # fmt: skip
    garment, tangents = stage.path / "template.npz", stage.path / "tangents.npy"
    save_garment(garment, replace(sequence.garment, template=template.mesh))
    assert template.mesh.uv is not None
    write_npy(tangents, corner_tangents(template.mesh.vertices, template.mesh.faces, template.mesh.uv))
    frame_ids = sequence.frame_ids.tolist()
    pending = set(stage.pending(frame_ids, ".png"))
    chunks = [range(start, min(start + CHUNK, len(frame_ids))) for start in range(0, len(frame_ids), CHUNK)]
    jobs = [positions for positions in chunks if pending.intersection(frame_ids[p] for p in positions)]

    def finished() -> int:
        return len(frame_ids) - len(stage.pending(frame_ids, ".png"))

    prepare = partial(_prepare, weights, work, stage, config, template)
    for _ in run_jobs(_make, jobs, prepare=prepare, workers=workers, label="wrinkles", units=len, finished=finished):
        pass
    return stage.finish([garment, tangents, *(stage.frame_path(frame_id, ".png") for frame_id in frame_ids)])


def _prepare(weights: Path, work: WorkFolder, stage: Stage, config: ApplyConfig, template: MapTemplate) -> _Take:
    torch.set_num_threads(1)
    return _Take(work, stage, config, MapMaker.create(load_model(weights), template, texels=config.texels))


def _make(take: _Take, positions: range) -> int:
    """Make and write the missing maps of a chunk; how many there were."""
    stage, config, sequence = take.stage, take.config, take.work.registered
    frame_ids = sequence.frame_ids.tolist()
    pending = set(stage.pending([frame_ids[position] for position in positions], ".png"))
    for position in positions:
        if frame_ids[position] in pending:
            image = take.maker.map(np.array(sequence.vertices[position]))
            image = flip_green(image) if config.flip_green else image
            data = encode_png(image) if config.bits == 16 else encode_png8(image)
            write_bytes(stage.frame_path(frame_ids[position], ".png"), data)
    return len(pending)
