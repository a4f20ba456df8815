"""The stage that makes high-resolution maps for a registered or animated WORK: WORK/wrinkles/generated out.

stage.json           what was made
template.npz         the garment, its UVs as the maps have them
tangents.npy         (F, 3, 4) float32: the template's tangent frames in the rest pose, as glTF's TANGENT
frames/000123.png    tangent-space normals relative to the frame's registered mesh, OpenGL's +Y (or -Y), 16 or 8 bit
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float32

from capture4d.captures.work_folder import load_registration, registered_digest
from capture4d.errors import InputError
from capture4d.files.atomic import file_digest, write_bytes, write_npy
from capture4d.files.records import save_garment
from capture4d.geometry.tangents import corner_tangents
from capture4d.runs.stage import Stage, StageResult, open_stage
from capture4d.runs.workers import run_jobs
from capture4d.settings import settings
from wrinkles.normal_maps.inference import WrinkleModel, load_model
from wrinkles.normal_maps.pair_files import layout_digest
from wrinkles.normal_maps.seams import SeamTable, seam_table
from wrinkles.normal_maps.spaces import encode_png, encode_png8, flip_green, to_tangent
from wrinkles.normal_maps.template import MapTemplate

__all__ = ["ApplyConfig", "generated_normals", "run"]

SCHEMA = 2
CHUNK = 32


@settings
class ApplyConfig:
    """The form of the maps."""

    flip_green: bool = False
    bits: Literal[8, 16] = 16


@dataclass(frozen=True, slots=True)
class _Chunk:
    work: Path
    weights: Path
    stage: Stage
    positions: range


def run(model: Path, work: Path, config: ApplyConfig, *, workers: int = 1, overwrite: bool = False) -> StageResult:
    """Make the map of every registered frame that has none yet.

    Raises:
        InputError: there is no registration, no usable model, or the model was trained on another template's UVs.
    """
    weights = model / "generator.safetensors" if model.is_dir() else model
    generator, digest = load_model(weights), registered_digest(work)
    sequence = load_registration(work / "registration")
    template = MapTemplate.create(sequence.garment, generator.maps)
    if layout_digest(template.mesh, generator.maps.size) != generator.layout_digest:
        raise InputError(
            f"expected the template that {weights} was trained on, found another mesh or UV layout", where=work
        )
    output = work / "wrinkles" / "generated"
    upstream = {"registration": digest, "model": file_digest([weights], root=weights.parent)}
    stage = open_stage(output, name="wrinkles", schema=SCHEMA, config=config, upstream=upstream, overwrite=overwrite)
    save_garment(output / "template.npz", replace(sequence.garment, template=template.mesh))
    assert template.mesh.uv is not None
    write_npy(output / "tangents.npy", corner_tangents(template.mesh.vertices, template.mesh.faces, template.mesh.uv))
    frame_ids = sequence.frame_ids.tolist()
    pending = set(stage.pending(frame_ids, ".png"))
    chunks = [range(start, min(start + CHUNK, len(frame_ids))) for start in range(0, len(frame_ids), CHUNK)]
    jobs = [
        _Chunk(work, weights, stage, positions)
        for positions in chunks
        if pending.intersection(frame_ids[position] for position in positions)
    ]
    for _ in run_jobs(partial(_make, config), jobs, workers=workers, label="wrinkles", units=_length,
                      finished=lambda: len(frame_ids) - len(stage.pending(frame_ids, ".png"))):  # fmt: skip
        pass
    _prepared.cache_clear()
    maps = [stage.frame_path(frame_id, ".png") for frame_id in frame_ids]
    return stage.finish([output / "template.npz", output / "tangents.npy", *maps])


def generated_normals(
    model: WrinkleModel, template: MapTemplate, seams: SeamTable, vertices: Float[np.ndarray, "V 3"]
) -> Float32[np.ndarray, "N 3"]:
    """The generator's world normals at the template's texels in a frame, alike on both sides of every seam.

    Args:
        template: referred to the generator's own.
    """
    rotation = template.rotation(vertices).astype(np.float32)
    low = template.raster.image(template.low_normals(vertices) @ rotation)
    made = model.generate(torch.from_numpy(low).permute(2, 0, 1)).permute(1, 2, 0).numpy()
    values = template.raster.read(seams.blended(np.ascontiguousarray(made), template.raster))
    length = np.linalg.norm(values, axis=1, keepdims=True)
    return (values / np.maximum(length, 1e-6)) @ rotation.T


def _length(job: _Chunk) -> int:
    return len(job.positions)


@lru_cache(maxsize=1)
def _prepared(work: Path, weights: Path) -> tuple[WrinkleModel, MapTemplate, SeamTable]:
    """One network and template per process."""
    torch.set_num_threads(1)
    model = load_model(weights)
    template = MapTemplate.create(load_registration(work / "registration").garment, model.maps)
    return model, template.referred_to(model.reference), seam_table(template.mesh, template.raster)


def _make(config: ApplyConfig, job: _Chunk) -> int:
    """Make and write the missing maps of a chunk; how many there were."""
    model, template, seams = _prepared(job.work, job.weights)
    sequence = load_registration(job.work / "registration")
    frame_ids = sequence.frame_ids.tolist()
    pending = set(job.stage.pending([frame_ids[position] for position in job.positions], ".png"))
    for position in job.positions:
        if frame_ids[position] in pending:
            vertices = np.array(sequence.vertices[position])
            normals = generated_normals(model, template, seams, vertices)
            image = template.raster.image(to_tangent(normals, template.frames(vertices)))
            image[~template.raster.image(np.ones(len(normals), bool))] = (0, 0, 1)
            image = flip_green(image) if config.flip_green else image
            data = encode_png(image) if config.bits == 16 else encode_png8(image)
            write_bytes(job.stage.frame_path(frame_ids[position], ".png"), data)
    return len(pending)
