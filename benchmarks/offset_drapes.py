"""Offset images of static drapes: `python -m benchmarks offsets --data drapes`.

Relations this is built against, of errors on drapes for tests: the decoder at most 0.40 of the mean offsets', principal
components at most 0.95 of fully connected alone, local offsets at most 0.97 of the root's, L1 at most 1.05 of L2, and
something better than kernels alone. The paper prints, training / test in cm (Jin et al., Tables 1 and 2; 16,000
simulated poses to learn from): decoder with L1 0.33 / 0.44, with L2 0.35 / 0.47; fully connected local 0.65 / 0.67, of
root offsets 0.69 / 0.72, with 128 components 0.50 / 0.55 and 0.53 / 0.58.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.metric import Metric
from capture4d.cache import user_cache_folder
from capture4d.files.atomic import read_json
from data_synth.drapes.config import DrapesConfig
from data_synth.drapes.stage import SCHEMA
from data_synth.drapes.stage import run as make_drapes
from wrinkles.offset_images.config import PRESETS, DrapeOffsetsConfig
from wrinkles.offset_images.train_stage import ERRORS
from wrinkles.offset_images.train_stage import run as train

__all__ = ["drape_metrics"]

QUICK = DrapesConfig(garment="tshirt", samples=60, vertices=1000)
FULL = DrapesConfig(garment="tshirt", samples=5000)


def drape_metrics(
    *, quick: bool, drapes: Path | None, folder: Path | None, epochs: int, baseline_epochs: int, workers: int
) -> list[Metric]:
    """Learn a set of drapes with decoders, baselines and kernels.

    Args:
        quick: 60 drapes of a coarse T-shirt, of which two fifths are pruned; images of 64 texels.
        drapes: a set to learn; none: a T-shirt's, made from a seed and kept in the cache folder.
        folder: keeps every model, each a stage that a second run takes over or goes on with; none keeps nothing.
    """
    config = QUICK if quick else FULL
    if drapes is None:
        key = hashlib.sha256(json.dumps([SCHEMA, asdict(config)], sort_keys=True).encode()).hexdigest()[:12]
        drapes = user_cache_folder() / "takes" / f"{config.garment}-drapes-{key}"
        make_drapes(drapes, config, workers=workers)
    configs = _configs(64 if quick else 256, epochs, baseline_epochs, quick=quick)
    with tempfile.TemporaryDirectory() as temporary:
        kept = Path(temporary) if folder is None else folder
        errors = {}
        for name, each in configs.items():
            errors[name] = read_json(train(drapes, kept / name, each, workers=workers).path / ERRORS)
            Console(stderr=True).print(f"{name}: {_told(errors[name])}", soft_wrap=True)
    return _metrics(errors)


def _configs(texels: int, epochs: int, baseline_epochs: int, *, quick: bool) -> dict[str, DrapeOffsetsConfig]:
    """Everything that is compared; what differs from `decoder` is in its name."""
    decoder = replace(PRESETS["default"], texels=texels)
    decoder = replace(decoder, training=replace(decoder.training, epochs=epochs, patience=epochs))

    def baseline(name: str) -> DrapeOffsetsConfig:
        known = replace(PRESETS[name], texels=texels)
        return replace(known, training=replace(known.training, epochs=baseline_epochs, patience=baseline_epochs))

    found = {
        "decoder": decoder,
        "decoder_l1": replace(decoder, training=replace(decoder.training, norm="l1", normal_weight=0.0)),
        "decoder_l2": replace(decoder, training=replace(decoder.training, normal_weight=0.0)),
        "decoder_over_kernels": replace(decoder, residual=True),
        "direct": baseline("direct"),
        "pca": baseline("pca"),
        "pca_root": replace(baseline("pca"), space="root_offset"),
        "pca_with_kernels": replace(baseline("pca"), partner=True),
        "kernels": baseline("kernels"),
    }
    if not quick:
        found["patches"] = replace(decoder, network="patches")
    return found


def _metrics(errors: Mapping[str, Mapping[str, Any]]) -> list[Metric]:
    test = {name: each["test"]["vertex_cm"] for name, each in errors.items()}
    usual = errors["decoder"]["test"]["mean_vertex_cm"]
    best = min(value for name, value in test.items() if name != "kernels")
    found = [
        Metric("decoder_to_mean", test["decoder"] / usual),
        Metric("pca_to_direct", test["pca"] / test["direct"]),
        Metric("local_to_root", test["pca"] / test["pca_root"]),
        Metric("l1_to_l2", test["decoder_l1"] / test["decoder_l2"]),
        Metric("best_to_kernel", best / test["kernels"]),
        Metric("normals_to_l2", errors["decoder"]["train"]["normal"] / errors["decoder_l2"]["train"]["normal"]),
    ]
    if "patches" in errors:
        kinks = errors["patches"]["kinks"]
        added = {name: kinks[f"{name}_deg"] - kinks["true_deg"] for name in ("stitched", "filtered")}
        found += [
            Metric("patches_to_whole", test["patches"] / test["decoder"]),
            Metric("kinks_stitched_deg", added["stitched"], "deg"),
            Metric("kinks_filtered_deg", added["filtered"], "deg"),
        ]
    for name, each in errors.items():
        found += [Metric(f"{name}_{part}_cm", each[part]["vertex_cm"], "cm") for part in ("train", "test")]
    counts = [
        Metric(f"drapes_{part}", errors["decoder"][part]["drapes"], "drapes", "higher") for part in ("train", "test")
    ]
    return [*found, Metric("mean_test_cm", usual, "cm", "higher"), *counts]


def _told(errors: Mapping[str, Any]) -> str:
    parts = (
        f"{part} {errors[part]['vertex_cm']:.3f} cm, normals {errors[part]['normal']:.4f}" for part in ("train", "test")
    )
    return "; ".join(parts)
