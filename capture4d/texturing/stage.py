"""The stage that makes a texture: a registered WORK in, WORK/texture out.

stage.json     what was made, and from what
light.npz      how bright the cloth was by the direction in which it faces
albedo.png     sRGB over the template's UVs, as `--print` takes it
seen.png       white where any frame has seen the cloth
template.npz   the garment over whose UVs they lie
texture.json   how much of it was seen, and by how much frames differ

The light is found first, on a small picture of all frames; then the colours of each frame are baked, without the light,
into frames/; then they are put together texel by texel, and frames/ goes.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from capture4d.body.sewing_pattern import picture_uv
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.work_folder import WorkFolder, load_registration
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile, map_array
from capture4d.files.atomic import read_json, write_bytes, write_json, write_npy, write_npz
from capture4d.files.records import save_garment
from capture4d.geometry.islands.map_seams import find_gutter
from capture4d.geometry.mesh import face_areas
from capture4d.geometry.uv_raster import UvRaster, rasterise_uv
from capture4d.runs.frame_lists import frame_file
from capture4d.runs.stage import Stage, StageResult, open_stage, require_complete
from capture4d.runs.workers import run_jobs, shared
from capture4d.texturing.baking import BESIDE_BORDER, ColouredScan, as_bytes, surface_blocks
from capture4d.texturing.blending import blend, fill_holes, spread_out
from capture4d.texturing.config import ALBEDO, TEMPLATE, TEXTURE, TextureConfig
from capture4d.texturing.light import BRIGHTEST, Light, fit_light
from capture4d.types import GarmentScan, Mesh

__all__ = ["run"]

SCHEMA = 1
SEEN = "seen.png"
LIGHT_TEXELS, LIGHT_PLACES = 192, 6000
"""Of the picture on which the light is found, and how many of its texels are looked at."""


@dataclass(frozen=True, slots=True, eq=False)
class _Take:
    """What is baked."""

    work: Path
    mesh: Mesh
    """The template, its UVs those of the picture."""
    config: TextureConfig

    def scan(self, frame_id: int) -> GarmentScan:
        scan = load_garment_scan(frame_file(self.work / "garment", frame_id), frame_id)
        if scan.colours is None:
            raise InputError("expected a garment with colours, found one without", where=self.work / "garment")
        return scan

    def vertices(self, frame_id: int) -> np.ndarray:
        with ArrayFile(frame_file(self.work / "registration", frame_id)) as arrays:
            return arrays["vertices"]


@dataclass(frozen=True, slots=True, eq=False)
class _Baking:
    """What a frame's job needs: all of it is the same for every frame."""

    take: _Take
    raster: UvRaster
    light: Light
    gains: dict[int, np.ndarray]
    """Of each frame, as a logarithm."""
    stage: Stage

    @staticmethod
    def open(take: _Take, light: Light, gains: dict[int, np.ndarray], stage: Stage) -> _Baking:
        return _Baking(take, _raster(take.mesh, take.config.texels), light, gains, stage)


def run(work: WorkFolder, config: TextureConfig, *, workers: int = 1, overwrite: bool = False) -> StageResult:
    """Bake the colours of the scans, and put them together.

    Raises:
        InputError: nothing is registered to scans, the scans have no colours, or the template has no UVs, or such as
            lie on top of each other.
    """
    upstream, garment = _inputs(work), load_registration(work.path / "registration").garment
    take = _Take(work.path, replace(garment.template, uv=picture_uv(garment)), config)
    chosen = _chosen(work, config.frames)
    stage = open_stage(
        work.path / TEXTURE, name="texture", schema=SCHEMA, config=config, upstream=upstream,
        sources={"work": work.path}, overwrite=overwrite,
    )  # fmt: skip
    paths = [stage.path / name for name in (ALBEDO, "light.npz", TEMPLATE)]
    if not (stage.was_complete and all(path.is_file() for path in paths)):
        light, gains = _light(take, chosen, stage.path / "light.npz", workers)
        missing = stage.pending(chosen, ".npy")
        prepare = partial(_Baking.open, take, light, gains, stage)
        for _ in run_jobs(_bake, missing, prepare=prepare, workers=workers, label="texture"):
            pass
        _put_together(take, stage, chosen, light)
        save_garment(stage.path / TEMPLATE, garment)
        shutil.rmtree(stage.path / "frames", ignore_errors=True)
    return stage.finish(paths, frames=len(chosen))


def _inputs(work: WorkFolder) -> dict[str, str]:
    """Digests of what a texture is made from."""
    digest = work.registered_digest
    if work.is_animated:
        raise InputError("expected a take that was registered to scans, found an animation", where=work.path)
    command = f"capture4d extract CAPTURE --output {work.path}"
    return {"registration": digest, "garment": require_complete(work.path / "garment", "extract", command)}


def _chosen(work: WorkFolder, most: int) -> list[int]:
    """Frames that are looked at, evenly over those that have not failed."""
    ids = work.registered.frame_ids.tolist()
    good = [frame_id for frame_id in ids if frame_id not in work.failed_frames]
    if not good:
        raise InputError(f"expected frames with a registration, found {len(ids)}, all failed", where=work.path)
    at = np.unique(np.linspace(0, len(good) - 1, min(most, len(good))).round().astype(int))
    return [good[each] for each in at]


def _raster(mesh: Mesh, texels: int) -> UvRaster:
    """Texels and what they show; beyond a seam that is the cloth across it."""
    bare = rasterise_uv(mesh, texels, padding=max(2, texels // 256))
    return find_gutter(mesh, bare).shown_by(bare)


# --- the light ---------------------------------------------------------------------------------------------------


def _light(take: _Take, chosen: Sequence[int], path: Path, workers: int) -> tuple[Light, dict[int, np.ndarray]]:
    """Found, or as an earlier run found it; and the gain of each frame."""
    if not take.config.light:
        light, gains = Light.even(), np.zeros((len(chosen), 3))
        write_npz(path, terms=light.terms, mean=light.mean, gains=gains)
    elif not path.is_file():
        raster = _raster(take.mesh, LIGHT_TEXELS)
        at = np.flatnonzero(raster.inside)
        at = at[np.unique(np.linspace(0, len(at) - 1, min(LIGHT_PLACES, len(at))).round().astype(int))]
        small = replace(raster, **{name: getattr(raster, name)[at] for name in _BY_TEXEL})
        looks = shared(_Looking(take, small))
        found = dict(run_jobs(_look, list(chosen), prepare=looks, workers=workers, label="light"))
        seen = [found[frame_id] for frame_id in chosen]
        area = float(face_areas(take.mesh.vertices.astype(np.float64), take.mesh.faces).sum())
        light, gains = fit_light(*(np.stack(each) for each in zip(*seen, strict=True)), area_m2=area)
        write_npz(path, terms=light.terms, mean=light.mean, gains=gains)
    with ArrayFile(path, kind="light") as arrays:
        light, gains = Light(arrays["terms"], arrays["mean"]), arrays["gains"]
    return light, dict(zip(chosen, gains, strict=True))


_BY_TEXEL = ("texels", "faces", "corners", "barycentric", "inside", "covered")


@dataclass(frozen=True, slots=True, eq=False)
class _Looking:
    """What the light is found from."""

    take: _Take
    raster: UvRaster


def _look(looking: _Looking, frame_id: int) -> tuple[int, tuple[np.ndarray, ...]]:
    """Colours, normals of scan and template, and weights of a few places in a frame."""
    take, scan = looking.take, ColouredScan(looking.take.scan(frame_id), looking.take.config.distance_m)
    ((_, places, normals),) = surface_blocks(looking.raster, take.vertices(frame_id), take.mesh.faces)
    seen = scan.seen_from(places, normals)
    return frame_id, (seen.colours, seen.normals, normals.astype(np.float32), seen.weights)


# --- the frames, and the picture ---------------------------------------------------------------------------------


def _bake(baking: _Baking, frame_id: int) -> None:
    """Write what a frame says of every texel: three levels and a weight, bytes."""
    take, raster = baking.take, baking.raster
    scan, gain = ColouredScan(take.scan(frame_id), take.config.distance_m), np.exp(baking.gains[frame_id])
    found = np.zeros((len(raster.texels), 4), np.uint8)
    for block, places, normals in surface_blocks(raster, take.vertices(frame_id), take.mesh.faces):
        seen = scan.seen_from(places, normals)
        found[block, :3] = as_bytes(seen.colours / (baking.light.at(seen.normals) * gain))
        clipped = (seen.colours >= BRIGHTEST).any(axis=1)
        weights = as_bytes(255 * np.where(clipped, BESIDE_BORDER, 1) * seen.weights)
        # What was seen at all counts for something: there may be nothing else.
        found[block, 3] = np.where(seen.weights > 0, np.maximum(weights, 1), 0)
    write_npy(baking.stage.frame_path(frame_id, ".npy"), found)


def _put_together(take: _Take, stage: Stage, chosen: Sequence[int], light: Light) -> None:
    raster = _raster(take.mesh, take.config.texels)
    frames = [map_array(stage.frame_path(frame_id, ".npy")) for frame_id in chosen]
    colours, seen, spread = blend(frames)
    inside = raster.inside
    if not seen[inside].any():
        raise InputError("expected scans near the registered cloth, found none in any frame", where=take.work)
    fill_holes(colours, seen, raster.at_vertices(take.mesh.vertices.astype(np.float64)))
    picture = spread_out(raster.image(as_bytes(colours)), raster.image(np.ones(len(colours), bool)))
    write_bytes(stage.path / ALBEDO, cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
    mask = raster.image(255 * (seen & inside).astype(np.uint8))
    write_bytes(stage.path / SEEN, cv2.imencode(".png", mask)[1].tobytes())
    told: dict[str, Any] = {
        "texels": take.config.texels,
        "frames": list(chosen),
        "seen_share": float(seen[inside].mean()),
        "spread_levels": float(np.median(spread[inside & seen])),
        "light": _told_light(take, light),
    }
    write_json(stage.path / "texture.json", told)
    assert read_json(stage.path / "texture.json")["texels"] == take.config.texels


def _told_light(take: _Take, light: Light) -> list[float]:
    """Least and largest of what light multiplies green by, over directions evenly over the sphere."""
    rows = np.arange(400) + 0.5
    height, angle = 1 - 2 * rows / 400, np.pi * (1 + 5**0.5) * rows
    flat = np.sqrt(1 - height**2)
    factors = light.at(np.stack([flat * np.cos(angle), height, flat * np.sin(angle)], axis=1))[:, 1]
    return [float(factors.min()), float(factors.max())]
