"""Textures of printed takes against the prints that were on them.

    error_median_levels, error_p90_levels    sRGB levels of 255, largest channel, after one factor for it all:
                                             how bright the light was cannot be known; seen, 3 cm and more from paint
    unlit_error_median_levels                the same where the light was left in
    brightness                               that factor
    seam_ratio                               median error within 10 mm of a seam of the UVs over that elsewhere
    seen_percent                             texels that any frame has seen
    cpu_s                                    of baking, a frame

Limits this was built against: 8 levels in the median, a seam ratio of 1.25. Takes, garments and registrations are
those of `registration --data printed`: everything is kept in the user's cache folder.
"""

from __future__ import annotations

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
from capture4d.captures.capture import read_capture
from capture4d.captures.work_folder import load_registration, open_work
from capture4d.extraction.stage import ExtractionSettings
from capture4d.extraction.stage import run as extract
from capture4d.files.atomic import read_json
from capture4d.files.pictures import read_picture
from capture4d.geometry.mesh import boundary_edges, half_edges
from capture4d.geometry.tangents import uv_corners
from capture4d.geometry.uv_raster import UvRaster, rasterise_uv
from capture4d.texturing.config import TextureConfig
from capture4d.texturing.stage import run as texture
from capture4d.types import Garment, Mesh
from registration.config import RegistrationConfig
from registration.stage import run as register

PAINTED_M, SEAM_M = 0.03, 0.01
"""Nearer to an open border the cloth is painted; and what is near a seam."""


@dataclass(frozen=True, slots=True)
class _Found:
    """Of one picture."""

    errors: np.ndarray
    """Of the texels that are looked at, levels."""
    near_seam: np.ndarray
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
    lit, unlit, seen, spent = [], [], [], []
    for config in subjects(8 if quick else frames, quick=quick):
        take = printed_take(config, "random", size, workers=workers)
        capture, work = read_capture(take.capture), take.capture / "textured"
        garments = work / "garment"
        renew(partial(extract, capture, garments, ExtractionSettings(), workers=workers))
        renew(partial(register, capture, garments, work / "registration", RegistrationConfig(), workers=workers))
        for divided, found in ((False, unlit), (True, lit)):
            begin = time.process_time()
            done = texture(
                open_work(work), TextureConfig(texels=texels, light=divided), workers=workers, overwrite=True
            )
            found.append(compared(work, done.path / "albedo.png", take.picture))
        spent.append((time.process_time() - begin) / done.frames)
        seen.append(read_json(work / "texture" / "texture.json")["seen_share"])
    errors = [each.errors for each in lit]
    return [
        Metric("error_median_levels", max(float(np.median(each)) for each in errors)),
        Metric("error_p90_levels", max(float(np.percentile(each, 90)) for each in errors)),
        Metric("unlit_error_median_levels", max(float(np.median(each.errors)) for each in unlit)),
        Metric("brightness", float(np.mean([each.brightness for each in lit]))),
        Metric("seam_ratio", max(_seam_ratio(each) for each in lit)),
        Metric("seen_percent", 100 * min(seen), "%", "higher"),
        Metric("cpu_s", max(spent), "s"),
    ]


def _seam_ratio(found: _Found) -> float:
    return float(np.median(found.errors[found.near_seam]) / np.median(found.errors[~found.near_seam]))


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
    near = KDTree(_seam_places(garment, mesh)).query(places[looked])[0] < SEAM_M
    return _Found(np.abs(brightness * made - wanted).max(axis=1), near, brightness)


def _sampled(picture: np.ndarray, raster: UvRaster, mesh: Mesh) -> np.ndarray:
    assert mesh.uv is not None
    uv = raster.at_corners(mesh.uv.astype(np.float64))
    places = [(1 - uv[:, 1]) * picture.shape[0] - 0.5, uv[:, 0] * picture.shape[1] - 0.5]
    return np.stack(
        [map_coordinates(picture[..., c].astype(np.float64), places, order=1, mode="nearest") for c in range(3)], axis=1
    )


def _seam_places(garment: Garment, mesh: Mesh) -> np.ndarray:
    """Middles of edges that the UVs cut and the mesh does not, metres."""
    assert mesh.uv is not None
    corner = uv_corners(mesh.faces, mesh.uv)
    vertex = np.empty(int(corner.max()) + 1, np.int64)
    vertex[corner.reshape(-1)] = mesh.faces.reshape(-1)
    sides = half_edges(corner)
    count = len(vertex)
    forth, back = sides[:, 0].astype(np.int64) * count + sides[:, 1], sides[:, 1].astype(np.int64) * count + sides[:, 0]
    cut = vertex[sides[~np.isin(forth, back)]]
    joined = half_edges(mesh.faces)
    every = len(mesh.vertices)
    known = joined[:, 1].astype(np.int64) * every + joined[:, 0]
    cut = cut[np.isin(cut[:, 0].astype(np.int64) * every + cut[:, 1], known)]
    return garment.template.vertices[cut].mean(axis=1)
