"""Offset images of static drapes: `python -m benchmarks offsets --data drapes`, or `drapes-middle`, or `neckties`.

Relations this is built against, of errors on drapes for tests, at 4,500 drapes: the decoder at most 0.40 of the mean
offsets', the best single network 0.29 and the best of all 0.25; principal components at most 0.95 of fully connected
alone, local offsets at most 0.97 of the root's, L1 at most 1.05 of L2, the best at most 0.95 of kernels alone, patches
at most 0.95 of whole images, of kinks at their borders at most 0.3 left by the filter, which costs at most 3 %.
Neckties: at most 0.15 of the mean offsets', with the loss of edge lengths at most 0.7 of their error without. Wrong
bodies: `benchmarks.wrong_bodies`.

`PAPER` is what Jin et al. print (Tables 1 and 2, Fig. 8), training / test in cm, of 16,000 simulated poses.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.table import Table

from benchmarks.cached_takes import one_maker
from benchmarks.clip_smoothness import clip_smoothness
from benchmarks.metric import Metric
from benchmarks.wrong_bodies import wrong_body_metrics
from capture4d.cache import user_cache_folder
from capture4d.files.atomic import read_json
from capture4d.types import PoseSequence
from data_synth.drapes.config import DrapesConfig
from data_synth.drapes.stage import SCHEMA
from data_synth.drapes.stage import run as make_drapes
from wrinkles.offset_images.config import PRESETS, DrapeOffsetsConfig, PatchConfig
from wrinkles.offset_images.drape_lessons import read_parted_drapes, still_poses
from wrinkles.offset_images.drape_model import load_drape_offsets
from wrinkles.offset_images.train_stage import ERRORS
from wrinkles.offset_images.train_stage import run as train

__all__ = ["SCALES", "Scale", "drape_metrics", "tie_metrics"]

Scale = Literal["quick", "middle", "full"]


@dataclass(frozen=True, slots=True)
class _Sizes:
    """What a scale of the benchmark learns, and from how much."""

    samples: int
    ties: int
    texels: int
    patch: PatchConfig
    vertices: int = 3000
    seed: int = 0

    def drapes(self, garment: Literal["tshirt", "necktie"]) -> DrapesConfig:
        count = self.samples if garment == "tshirt" else self.ties
        return DrapesConfig(garment=garment, samples=count, vertices=self.vertices, seed=self.seed)


SCALES: Mapping[Scale, _Sizes] = {
    "quick": _Sizes(60, 60, 64, PatchConfig(texels=24, context=2, channels=32), vertices=1000),
    "middle": _Sizes(384, 192, 64, PatchConfig(texels=24, context=2, channels=32), seed=4),
    "full": _Sizes(5000, 5000, 256, PatchConfig()),
}
"""`quick` is a coarse T-shirt, of whose drapes two fifths are pruned."""
PAPER: Mapping[str, tuple[float, float]] = {
    "decoder": (0.37, 0.51),
    "decoder_l1": (0.33, 0.44),
    "decoder_l2": (0.35, 0.47),
    "patches": (0.20, 0.46),
    "direct": (0.65, 0.67),
    "direct_root": (0.69, 0.72),
    "pca": (0.50, 0.55),
    "pca_root": (0.53, 0.58),
}
SINGLE = ("decoder", "decoder_l1", "decoder_l2", "patches", "direct", "pca")
"""Networks that answer alone, in local offsets."""
CLIPS, PATH = ("direct_with_kernels", "decoder"), 3
"""Models whose motions are measured, and on how many poses one after the other."""


def drape_metrics(
    *, scale: Scale, drapes: Path | None, folder: Path | None, epochs: int, baseline_epochs: int, workers: int
) -> list[Metric]:
    """Learn a T-shirt's drapes with decoders, patches, baselines and kernels, and over wrong bodies.

    Args:
        drapes: a set to learn; none: a T-shirt's, made from a seed and kept in the cache folder.
        folder: keeps every model, each a stage that a second run takes over or goes on with, to the epoch; none: the
            cache folder, but for the quick case, of which nothing is kept.
    """
    sizes = SCALES[scale]
    drapes = drapes or _made(sizes.drapes("tshirt"), workers)
    errors = _learned(_configs(sizes, epochs, baseline_epochs, scale), drapes, folder, scale, workers)
    _print_table(errors)
    found = _metrics(errors)
    if scale != "quick":
        found += wrong_body_metrics(drapes, epochs=baseline_epochs, texels=sizes.texels)
    return found


def tie_metrics(*, scale: Scale, drapes: Path | None, folder: Path | None, epochs: int, workers: int) -> list[Metric]:
    """Learn a necktie's drapes by its decoder, with and without the loss of edge lengths, and by kernels.

    Args:
        drapes, folder: as for `drape_metrics`.
    """
    tie = PRESETS["necktie"]
    tie = replace(tie, training=replace(tie.training, epochs=epochs, patience=epochs))
    configs = {
        "tie": tie,
        "tie_without_edges": replace(tie, training=replace(tie.training, edge_weight=0.0)),
        "tie_kernels": replace(PRESETS["kernels"], space=tie.space),
    }
    drapes = drapes or _made(SCALES[scale].drapes("necktie"), workers)
    errors = _learned(configs, drapes, folder, scale, workers)
    _print_table(errors)
    found, edges = errors["tie"]["test"], {name: each["test"]["edge_cm"] for name, each in errors.items()}
    return [
        Metric("tie_to_mean", found["vertex_cm"] / found["mean_vertex_cm"]),
        Metric("tie_to_kernels", found["vertex_cm"] / errors["tie_kernels"]["test"]["vertex_cm"]),
        Metric("edges_to_without", edges["tie"] / edges["tie_without_edges"]),
        Metric("tie_largest_offset_cm", found["largest_offset_cm"], "cm", "higher"),
        *_figures(errors),
    ]


def _made(config: DrapesConfig, workers: int) -> Path:
    key = hashlib.sha256(json.dumps([SCHEMA, asdict(config)], sort_keys=True).encode()).hexdigest()[:12]
    folder = user_cache_folder() / "takes" / f"{config.garment}-drapes-{key}"
    with one_maker(folder):
        make_drapes(folder, config, workers=workers)
    return folder


def _learned(
    configs: Mapping[str, DrapeOffsetsConfig], drapes: Path, folder: Path | None, scale: Scale, workers: int
) -> dict[str, dict[str, Any]]:
    """The errors of every model."""
    with tempfile.TemporaryDirectory() as temporary:
        usual = Path(temporary) if scale == "quick" else user_cache_folder() / "offsets" / drapes.name
        errors = {}
        for name, config in configs.items():
            model = train(drapes, (folder or usual) / name, config, workers=workers).path
            errors[name] = read_json(model / ERRORS)
            if name in CLIPS:
                errors[name]["clip"] = asdict(clip_smoothness(load_drape_offsets(model), _path(drapes)))
            Console(stderr=True).print(f"{name}: {_told(errors[name])}", soft_wrap=True)
    return errors


def _path(drapes: Path) -> PoseSequence:
    """Some poses for tests, to go along."""
    found, parts = read_parted_drapes(drapes)
    return still_poses(found, parts.test[:PATH])


def _configs(sizes: _Sizes, epochs: int, baseline_epochs: int, scale: Scale) -> dict[str, DrapeOffsetsConfig]:
    """Everything that is compared; what differs from `decoder` is in its name. The cheap ones first."""
    decoder = replace(PRESETS["default"], texels=sizes.texels)
    decoder = replace(decoder, training=replace(decoder.training, epochs=epochs, patience=epochs))

    def baseline(name: str) -> DrapeOffsetsConfig:
        known = replace(PRESETS[name], texels=sizes.texels)
        return replace(known, training=replace(known.training, epochs=baseline_epochs, patience=baseline_epochs))

    found = {
        "kernels": baseline("kernels"),
        "pca": baseline("pca"),
        "pca_root": replace(baseline("pca"), space="root_offset"),
        "pca_with_kernels": replace(baseline("pca"), partner=True),
        "pca_over_kernels": replace(baseline("pca"), residual=True),
        "direct": baseline("direct"),
        "direct_with_kernels": replace(baseline("direct"), partner=True),
        "decoder": decoder,
        "decoder_l2": replace(decoder, training=replace(decoder.training, normal_weight=0.0)),
        "decoder_l1": replace(decoder, training=replace(decoder.training, norm="l1", normal_weight=0.0)),
        "decoder_over_kernels": replace(decoder, residual=True),
    }
    if scale != "quick":
        found |= {
            "direct_root": replace(baseline("direct"), space="root_offset"),
            "pca_not_mirrored": replace(baseline("pca"), mirrored=False),
            "patches": replace(decoder, network="patches", patch=sizes.patch),
        }
    return found


def _metrics(errors: Mapping[str, Mapping[str, Any]]) -> list[Metric]:
    test = {name: each["test"]["vertex_cm"] for name, each in errors.items()}
    learned = {name: each["train"]["vertex_cm"] for name, each in errors.items()}
    usual = errors["decoder"]["test"]["mean_vertex_cm"]
    best = min(value for name, value in test.items() if name != "kernels")
    found = [
        Metric("decoder_to_mean", test["decoder"] / usual),
        Metric("best_single_to_mean", min(test[name] for name in SINGLE if name in test) / usual),
        Metric("best_to_mean", best / usual),
        Metric("pca_to_direct", test["pca"] / test["direct"]),
        Metric("local_to_root", test["pca"] / test["pca_root"]),
        Metric("l1_to_l2", test["decoder_l1"] / test["decoder_l2"]),
        Metric("best_to_kernel", best / test["kernels"]),
        Metric("normals_to_l2", errors["decoder"]["train"]["normal"] / errors["decoder_l2"]["train"]["normal"]),
    ]
    for name in CLIPS:
        clip = errors[name]["clip"]
        found += [Metric(f"clip_{name}_to_carried", clip["to_carried"]), Metric(f"clip_{name}_halved", clip["halved"])]
    if "direct_root" in errors:
        found.append(Metric("local_to_root_direct", test["direct"] / test["direct_root"]))
    if "patches" in errors:
        kinks = errors["patches"]["kinks"]
        added = {name: kinks[f"{name}_deg"] - kinks["true_deg"] for name in ("stitched", "filtered")}
        found += [
            Metric("patches_to_whole_test", test["patches"] / test["decoder"]),
            Metric("patches_to_whole_train", learned["patches"] / learned["decoder"]),
            Metric("kinks_left", added["filtered"] / added["stitched"]),
            Metric("kinks_stitched_deg", added["stitched"], "deg"),
            Metric("filtered_to_stitched", test["patches"] / kinks["stitched_vertex_cm"]),
        ]
    return [*found, *_figures(errors)]


def _figures(errors: Mapping[str, Mapping[str, Any]]) -> list[Metric]:
    """Errors in centimetres, and how many drapes they are of."""
    found = [
        Metric(f"{name}_{part}_cm", each[part]["vertex_cm"], "cm")
        for name, each in errors.items()
        for part in ("train", "test")
    ]
    some = next(iter(errors.values()))
    found.append(Metric("mean_test_cm", some["test"]["mean_vertex_cm"], "cm", "higher"))
    return found + [Metric(f"drapes_{part}", some[part]["drapes"], "drapes", "higher") for part in ("train", "test")]


def _told(errors: Mapping[str, Any]) -> str:
    parts = (
        f"{part} {errors[part]['vertex_cm']:.3f} cm, normals {errors[part]['normal']:.4f}" for part in ("train", "test")
    )
    return "; ".join(parts)


def _print_table(errors: Mapping[str, Mapping[str, Any]]) -> None:
    """Ours with the paper's beside it."""
    some = next(iter(errors.values()))
    title = f"cm, training / test; {some['train']['drapes']} drapes to learn, {some['test']['drapes']} for tests"
    table = Table("", "here", "normals, 1 - cos", "paper (16,000)", title=title)
    table.add_row("mean offsets", f"{some['train']['mean_vertex_cm']:.2f} / {some['test']['mean_vertex_cm']:.2f}")
    for name, each in errors.items():
        here, normals = (
            " / ".join(format(each[part][key], digits) for part in ("train", "test"))
            for key, digits in (("vertex_cm", ".3f"), ("normal", ".4f"))
        )
        paper = " / ".join(f"{value:.2f}" for value in PAPER[name]) if name in PAPER else ""
        table.add_row(name, here, normals, paper)
    Console(stderr=True).print(table)
