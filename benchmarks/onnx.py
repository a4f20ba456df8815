"""ONNX files beside the models that they are of: differences, and times of a frame on one thread.

Models of real sizes whose weights are drawn at random: a shirt of the built-in body with 60 shapes, each of its
regressors by itself, 600 learned frames; the wrinkle network of the preset `small`. Limits this was built against:
1e-4 mm and 0.1 degrees.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from benchmarks.export import finer
from benchmarks.metric import Metric
from benchmarks.random_models import garment_model, save_garment_model
from capture4d import pipeline
from capture4d.app.onnx_models.config import OnnxConfig
from capture4d.app.onnx_models.stage import FILE, Compared
from capture4d.body.anny import load_anny
from capture4d.files.records import load_garment
from capture4d.geometry.ray_casting import closest_points
from capture4d.geometry.uv_layout import unit_square
from capture4d.templates.config import TemplateConfig
from capture4d.types import Body, Garment
from retarget.config import LstmConfig
from wrinkles.normal_maps.config import PRESETS, MapConfig
from wrinkles.normal_maps.inference import WrinkleModel, generator_path, save_model
from wrinkles.normal_maps.networks import UNet
from wrinkles.normal_maps.pair_files import layout_digest

REGRESSORS: tuple[Literal["linear", "kernel", "lstm", "ensemble"], ...] = ("linear", "kernel", "lstm", "ensemble")


def run(*, quick: bool = False, seed: int = 0) -> list[Metric]:
    """Write and compare.

    Args:
        quick: a coarser shirt, fewer shapes and frames, a smaller network.
        seed: of weights.
    """
    metrics = []
    with tempfile.TemporaryDirectory(prefix="capture4d-onnx-") as scratch:
        root, rng = Path(scratch), np.random.default_rng(seed)
        pipeline.template(None, root / "template.npz", TemplateConfig(region="tshirt"))
        garment, body = load_garment(root / "template.npz"), load_anny()
        bound = replace(garment, body_shape=np.zeros(len(body.shape_directions), np.float32))
        shirt = bound if quick else _bound(finer(bound), body)
        network = LstmConfig(size=32) if quick else LstmConfig()
        shapes, frames = (10, 100) if quick else (60, 600)
        model = garment_model(body, shirt, rng, shapes=shapes, frames=frames, network=network)
        save_garment_model(root / "shirt", model)
        for name in REGRESSORS:
            config, place = OnnxConfig(regressor=name), root / f"shirt-{name}"
            metrics += _told(name, pipeline.export_onnx(root / "shirt", place, config)[1], place)
        _write_network(root / "network", bound, quick, seed)
        place = root / "wrinkles"
        config = OnnxConfig(probes=8 if quick else 32)
        metrics += _told("wrinkles", pipeline.export_onnx(root / "network", place, config)[1], place)
    return metrics


def _bound(garment: Garment, body: Body) -> Garment:
    """To the nearest faces of the body."""
    _, faces, barycentric = closest_points(body.template, garment.template.vertices)
    return replace(garment, embedding_faces=faces, embedding_barycentric=barycentric.astype(np.float32))


def _write_network(folder: Path, garment: Garment, quick: bool, seed: int) -> None:
    preset = PRESETS["small"]
    network = replace(preset.network, filters=8) if quick else preset.network
    maps = MapConfig(size=preset.texels)
    mesh = unit_square(garment.template, gap=(2 * maps.padding + 2) / maps.size)
    torch.manual_seed(seed)
    model = WrinkleModel(
        UNet(network), network, texels=preset.texels, maps=maps, layout_digest=layout_digest(mesh, maps.size),
        template=mesh,
    )  # fmt: skip
    folder.mkdir()
    save_model(generator_path(folder), model)


def _told(name: str, found: Compared, place: Path) -> list[Metric]:
    return [
        Metric(f"{name}_largest_{found.unit}", found.largest, found.unit),
        Metric(f"{name}_ms", found.onnx_ms, "ms"),
        Metric(f"{name}_{found.ours_by}_ms", found.ours_ms, "ms"),
        Metric(f"{name}_mb", (place / FILE).stat().st_size / 1e6, "MB"),
    ]
