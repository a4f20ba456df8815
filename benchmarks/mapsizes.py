"""Normal maps larger than those a network was trained on, against maps of the scans as large, on held-out frames.

Three maps of each frame: the low one; the network's own, enlarged bicubically, as an image program would; and what
`wrinkles apply --texels` makes, the network's residual on the low map at the wanted size. `deg` is the angle to the
scan's map, `kept` the energy of a band of wavelengths over that of the scan's, `missed` the energy of the difference
over it: 0 is perfect, 1 as bad as a map that shows nothing of the band.

One demo take, 500 steps, held-out frames 32 to 36, maps of 512; the presets cost the same a step:

                        deg     12-24 mm kept  missed   24-48 mm kept  missed
    low                 9.98    0.20           0.58     0.27           0.36
    small, enlarged     5.91    0.54           0.32     0.66           0.15
    small               5.61    0.61           0.31     0.71           0.13
    small-512           5.73    0.59           0.36     0.72           0.15
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from torch.nn.functional import interpolate

from benchmarks.metric import Metric
from benchmarks.normalmaps import QUICK_TAKE
from benchmarks.registered_work import registered_work
from capture4d import pipeline
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.work_folder import WorkFolder, open_work
from capture4d.geometry.uv_layout import millimetres_per_texel
from data_synth.config import PRESETS as TAKES
from wrinkles.frame_split import split_rows
from wrinkles.normal_maps.config import PRESETS, ProjectionConfig, WrinkleConfig
from wrinkles.normal_maps.inference import WrinkleModel, load_model
from wrinkles.normal_maps.template import MapTemplate, frame_pairs
from wrinkles.normal_maps.wrinkle_maps import MapMaker

BANDS_MM = (12, 24, 48)
"""Ends of the bands of wavelengths; a blur of a fifth of a wavelength leaves the longer ones."""


def run(
    *,
    quick: bool = False,
    work: Path | None = None,
    preset: Literal["small", "small-512"] = "small",
    texels: int = 512,
    steps: int = 500,
    workers: int = 1,
) -> list[Metric]:
    """Train a network on one take, make maps, measure.

    Args:
        quick: a small take, twenty steps of a small network, the same keys.
        work: registered take to learn from; the `demo` take's registration, made once, if None.
        preset: of the network.
        texels: side of the maps.
    """
    config = replace(PRESETS[preset], held_out=0.15)
    config = replace(config, schedule=replace(config.schedule, steps=20 if quick else steps))
    if quick:
        config = replace(config, network=replace(config.network, filters=4))
    folder = work or registered_work(QUICK_TAKE if quick else TAKES["demo"], workers=workers)[1]
    with tempfile.TemporaryDirectory(prefix="capture4d-mapsizes-") as scratch:
        own = Path(scratch) / "work"  # whose maps are as large as this network needs, whatever the take's are
        own.mkdir()
        for part in ("body", "garment", "registration"):
            if (folder / part).is_dir():
                (own / part).symlink_to((folder / part).resolve())
        model = pipeline.wrinkles_train([own], Path(scratch) / "model", config, workers=workers).path
        return _measure(open_work(own), load_model(model), config, texels)


def _measure(work: WorkFolder, model: WrinkleModel, config: WrinkleConfig, texels: int) -> list[Metric]:
    kept = MapTemplate.laid_out(model.template, model.maps)
    began = time.process_time()
    maker = MapMaker.create(model, kept, texels=texels)
    once_s, raster = time.process_time() - began, maker.template.raster
    millimetres = millimetres_per_texel(maker.template.mesh, texels)
    sums: dict[str, list[np.ndarray]] = {}
    map_s = []
    for vertices, low, high, known in _truth(work, maker.template, config):
        rotation = maker.template.rotation(vertices).astype(np.float32)
        began = time.process_time()
        made = maker.normals(vertices)
        map_s.append(time.process_time() - began)
        seen = torch.from_numpy(kept.raster.image(kept.low_normals(vertices) @ rotation)).permute(2, 0, 1)
        maps = {
            "low": raster.image(low @ rotation),
            "enlarged": _enlarged(model, seen, texels),
            "made": raster.image((made @ rotation).astype(np.float32)),
        }
        truth, mask = raster.image(high @ rotation), raster.image(known & raster.inside)
        true_bands = _bands(truth, mask, millimetres)
        for name, image in maps.items():
            off = np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(image - truth, axis=-1)[mask] / 2, 0, 1))).mean()
            bands = _bands(image, mask, millimetres)
            energies = [(np.square(b).sum(), np.square(b - t).sum(), np.square(t).sum())
                        for b, t in zip(bands, true_bands, strict=True)]  # fmt: skip
            sums.setdefault(name, []).append(np.array([off, *np.ravel(energies)]))
    metrics = [Metric("once_cpu_s", once_s, "s"), Metric("map_cpu_s", float(np.median(map_s)), "s")]
    for name, rows in sums.items():
        off, *energies = np.mean(rows, axis=0).tolist()
        metrics.append(Metric(f"{name}_deg", off, "deg"))
        for number, (short, long) in enumerate(pairwise(BANDS_MM)):
            energy, difference, truth = energies[3 * number : 3 * number + 3]
            metrics.append(Metric(f"{name}_kept_{short}_{long}mm", energy / truth, "", "higher"))
            metrics.append(Metric(f"{name}_missed_{short}_{long}mm", difference / truth))
    return metrics


def _truth(
    work: WorkFolder, template: MapTemplate, config: WrinkleConfig
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Of every held-out frame: vertices, low and high normals of the texels, where the latter are known."""
    sequence, ids = work.registered, work.registered.frame_ids.tolist()
    held = split_rows(len(ids), held_out=config.held_out, gap=config.held_out_gap, name=work.path.name)[1]
    pairs = frame_pairs(
        template, ids, held, vertices=lambda at: np.array(sequence.vertices[at]),
        scan=lambda at: load_garment_scan(work.path / "garment" / "frames" / f"{ids[at]:06d}.npz", ids[at]).mesh,
        fps=work.capture.fps, config=ProjectionConfig(),
    )  # fmt: skip
    for at, pair in zip(held, pairs, strict=True):
        yield np.array(sequence.vertices[at]), pair.low, pair.high.normals, pair.high.valid


def _enlarged(model: WrinkleModel, low: torch.Tensor, texels: int) -> np.ndarray:
    """The network's own map, as large as those it learned from, as an image program enlarges it."""
    small = interpolate(low[None], size=(model.texels, model.texels), mode="area")
    made = small / small.norm(dim=1, keepdim=True).clamp(min=1e-6) + model.added(low)[None]
    large = interpolate(made, size=(texels, texels), mode="bicubic", align_corners=False)[0].permute(1, 2, 0).numpy()
    return large / np.maximum(np.linalg.norm(large, axis=-1, keepdims=True), 1e-6)


def _bands(image: np.ndarray, mask: np.ndarray, millimetres: float) -> list[np.ndarray]:
    """Known texels of the map's bands."""
    weight = mask.astype(np.float32)
    blurred = []
    for wavelength in BANDS_MM:
        sigma = wavelength / 5 / millimetres
        values = cv2.GaussianBlur(image.astype(np.float32) * weight[..., None], (0, 0), sigma)
        shares = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-6)
        blurred.append((values / shares[..., None])[mask])
    return [fine - coarse for fine, coarse in pairwise(blurred)]
