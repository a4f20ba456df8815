"""Textures of printed takes against the prints that were on them.

    error_median_levels, error_p90_levels    sRGB levels of 255, mean over the channels, after one factor for it all:
                                             how bright the light was cannot be known; seen, 3 cm and more from paint
    unlit_error_median_levels                the same where the light was left in
    placed_error_median_levels               the same with the cloth where it truly was: baking without registration
    brightness                               that factor
    seam_step_levels                         by how much both sides of a seam of the UVs differ, median
    seen_percent                             texels that any frame has seen
    cpu_s                                    of baking, a frame

Limits this was built against: 8 levels in the median, a step of 4. Takes, garments and registrations are
those of `registration --data printed`: everything is kept in the user's cache folder.
"""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

from benchmarks.metric import Metric
from benchmarks.printed_takes import printed_take, subjects
from benchmarks.renewal import renew
from capture4d.body.sewing_pattern import picture_uv
from capture4d.captures.capture import Capture, read_capture
from capture4d.captures.evaluation import material_points
from capture4d.captures.truth import read_truth_model, read_truth_vertices
from capture4d.captures.work_folder import load_registration, open_work
from capture4d.extraction.stage import ExtractionSettings
from capture4d.extraction.stage import run as extract
from capture4d.files.atomic import read_json, write_npz
from capture4d.files.pictures import read_picture
from capture4d.geometry.mesh import boundary_edges, half_edges
from capture4d.geometry.tangents import uv_corners
from capture4d.geometry.uv_raster import UvRaster, rasterise_uv
from capture4d.texturing.config import TextureConfig
from capture4d.texturing.stage import run as texture
from capture4d.types import Mesh
from registration.config import RegistrationConfig
from registration.stage import run as register

PAINTED_M = 0.03
"""Nearer to an open border the cloth is painted."""


@dataclass(frozen=True, slots=True)
class _Found:
    """Of one picture."""

    errors: np.ndarray
    """Of the texels that are looked at, levels."""
    seam_step: float
    brightness: float


def run(*, quick: bool = False, frames: int = 24, texels: int = 1024, workers: int = 1) -> list[Metric]:
    """Bake and compare.

    Args:
        quick: one small take of 8 frames, coarse scans and prints, 512 texels.
        frames: of each of the two takes otherwise.
        texels: along a side of the picture.
        workers: processes.
    """
    size, texels = (24.0, 512) if quick else (None, texels)
    lit, unlit, placed, seen, spent = [], [], [], [], []
    for config in subjects(8 if quick else frames, quick=quick):
        take = printed_take(config, "random", size, workers=workers)
        capture, work = read_capture(take.capture), take.capture / "textured"
        garments = work / "garment"
        renew(partial(extract, capture, garments, ExtractionSettings(), workers=workers))
        renew(partial(register, capture, garments, work / "registration", RegistrationConfig(), workers=workers))
        true = _placed_by_truth(capture, work, take.capture / "textured-truth")
        for folder, divided, found in ((true, True, placed), (work, False, unlit), (work, True, lit)):
            begin = time.process_time()
            baked = TextureConfig(texels=texels, light=divided)
            done = texture(open_work(folder), baked, workers=workers, overwrite=True)
            found.append(compared(folder, done.path / "albedo.png", take.picture))
        spent.append((time.process_time() - begin) / done.frames)
        seen.append(read_json(work / "texture" / "texture.json")["seen_share"])
    errors = [each.errors for each in lit]
    return [
        Metric("error_median_levels", max(float(np.median(each)) for each in errors)),
        Metric("error_p90_levels", max(float(np.percentile(each, 90)) for each in errors)),
        Metric("unlit_error_median_levels", max(float(np.median(each.errors)) for each in unlit)),
        Metric("placed_error_median_levels", max(float(np.median(each.errors)) for each in placed)),
        Metric("brightness", float(np.mean([each.brightness for each in lit]))),
        Metric("seam_step_levels", max(each.seam_step for each in lit)),
        Metric("seen_percent", 100 * min(seen), "%", "higher"),
        Metric("cpu_s", max(spent), "s"),
    ]


def _placed_by_truth(capture: Capture, work: Path, folder: Path) -> Path:
    """A copy of a work folder whose cloth is where it truly was."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(work / "registration", folder / "registration")
    (folder / "garment").symlink_to(work / "garment")
    model = read_truth_model(capture)
    assert model is not None
    for path in sorted((folder / "registration" / "frames").glob("*.npz")):
        fine = read_truth_vertices(capture, int(path.stem))
        places = material_points(fine, model.fine.faces, model.template_faces, model.template_barycentric)
        with np.load(path) as arrays:
            kept = dict(arrays)
        write_npz(path, **(kept | {"vertices": places.astype(np.float32)}))
    return folder


def compared(work: Path, picture: Path, true: Path) -> _Found:
    """A picture of a template's colours and the print that it ought to show.

    Args:
        true: another picture over the same UVs, of any size.
    """
    garment, pixels = load_registration(work / "registration").garment, read_picture(picture)
    mesh = replace(garment.template, uv=picture_uv(garment))
    raster = rasterise_uv(mesh, len(pixels), padding=0)
    places = raster.at_vertices(mesh.vertices.astype(np.float64))
    borders = mesh.vertices[np.unique(boundary_edges(mesh.faces))]
    looked = raster.inside & (raster.read(read_picture(picture.with_name("seen.png"))).max(axis=1) > 0)
    if len(borders):
        looked &= KDTree(borders).query(places)[0] > PAINTED_M
    made = raster.read(pixels).astype(np.float64)[looked]
    wanted = _sampled(read_picture(true), raster, mesh)[looked]
    brightness = float(np.median(wanted[made > 20] / made[made > 20]))
    error = np.abs(brightness * made - wanted).mean(axis=1)
    return _Found(error, brightness * seam_step(mesh, pixels), brightness)


def _sampled(picture: np.ndarray, raster: UvRaster, mesh: Mesh) -> np.ndarray:
    assert mesh.uv is not None
    return _at(picture, raster.at_corners(mesh.uv.astype(np.float64)))


def _at(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """A picture at UVs, between its pixels."""
    places = [(1 - uv[:, 1]) * picture.shape[0] - 0.5, uv[:, 0] * picture.shape[1] - 0.5]
    return np.stack(
        [map_coordinates(picture[..., c].astype(np.float64), places, order=1, mode="nearest") for c in range(3)], axis=1
    )


def seam_step(mesh: Mesh, picture: np.ndarray) -> float:
    """Levels by which a picture differs on both sides of seams, at the same places of the cloth; median, mean over the
    channels. Seams are edges that the UVs cut and the mesh does not."""
    assert mesh.uv is not None
    corner = uv_corners(mesh.faces, mesh.uv)
    places = np.empty((int(corner.max()) + 1, 2))
    places[corner.reshape(-1)] = mesh.uv.reshape(-1, 2)
    sides, ends = half_edges(corner), half_edges(mesh.faces).astype(np.int64)
    keys, back = (ends[:, a] * len(mesh.vertices) + ends[:, 1 - a] for a in (0, 1))
    order = np.argsort(keys)
    other = order[np.minimum(np.searchsorted(keys, back, sorter=order), len(keys) - 1)]
    is_cut = (keys[other] == back) & (sides[other, 1] != sides[:, 0])
    here, there = (places[sides[which]].mean(axis=1) for which in (is_cut, other[is_cut]))
    return float(np.median(np.abs(_at(picture, here) - _at(picture, there)).mean(axis=1)))
