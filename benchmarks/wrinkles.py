"""Wrinkles learned from scans: generated maps on clips that training has not seen, and DeepWrinkles' Table 1.

The full case learns from the clips of `tshirt-train`, registered from their scans with tracked bodies, but for the hop.
It is examined on the held-out clips and on the hop, a motion unlike the others. Other registered clips of one garment
are given by folder: `--train WORK... --like WORK... --unlike WORK...`.

Limits it was built against: `normal_error_ratio` 0.65 on clips of motions like the training ones,
`normal_error_ratio_unlike` 0.85 on others, `wrinkle_energy_kept` 0.7 to 1.3, `flicker` below `flicker_no_temporal`,
`ms_per_map` 80 for the paper's network and 12 for the small preset.

The paper prints, as Data / Temporal, with the registration as input and the temporal term L1, L2, Eq. 4, none:
4.63 / 5.11, 5.16 / 4.2, 3.72 / 4.2, 5.06 / 5.52; with Eq. 4 and, as input, 500 blendshapes, 200, the regression from
poses: 6.86 / 7.05, 6.40 / 6.52, 7.6 / 7.65. Ours are measured in both readings of Temporal.

`flicker` is that of the small preset's temporal term, `flicker_no_temporal` that of none, over as many seeds.

Three networks of 4,000 steps and twelve of 2,000 take 80 minutes: `--keep FOLDER` keeps what has been trained, and goes
on.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from benchmarks.learning_takes import learned_takes, registered_takes, training_set
from benchmarks.metric import Metric
from benchmarks.renewal import renew
from capture4d.body.skinning import with_shape
from capture4d.captures.animations.config import RemovalConfig
from capture4d.captures.work_folder import open_work
from capture4d.errors import InputError
from capture4d.files.records import save_body, save_poses
from capture4d.types import Mesh
from retarget.animation.garment_model import load_garment_model
from retarget.animation.stage import Wearer, run_on_coefficients
from retarget.animation.stage import run as animate
from retarget.config import AnimateConfig, FitConfig, ShapeConfig, SplitConfig
from retarget.fit_stage import run as fit
from retarget.shapes.blendshapes import project, shape_space
from retarget.shapes.pose_normalisation import PoseRows, unpose_sequence
from wrinkles.normal_maps.config import (
    PRESETS,
    LossConfig,
    MapConfig,
    NetworkConfig,
    PairConfig,
    ScheduleConfig,
    TemporalLoss,
    WrinkleConfig,
)
from wrinkles.normal_maps.inference import WrinkleModel, load_model
from wrinkles.normal_maps.maps_stage import ensure_pairs
from wrinkles.normal_maps.maps_stage import run as make_pairs
from wrinkles.normal_maps.metrics import MapScores
from wrinkles.normal_maps.networks import UNet
from wrinkles.normal_maps.pair_files import open_pairs
from wrinkles.normal_maps.pairs import fitted
from wrinkles.normal_maps.train_stage import run as train_network
from wrinkles.normal_maps.train_stage import score_take

PRINTED: dict[str, tuple[float, float]] = {
    "l1": (4.63, 5.11),
    "l2": (5.16, 4.2),
    "printed": (3.72, 4.2),
    "none": (5.06, 5.52),
}
"""Table 1, left: Data and Temporal."""
PRINTED_INPUTS = {"bs500": (6.86, 7.05), "bs200": (6.40, 6.52), "regression": (7.6, 7.65)}
"""Table 1, right, beside the registration, with Eq. 4 as printed."""
BASES = {"bs500": 500, "bs200": 200}
UNLIKE = ("hop",)
"""Clips of `tshirt-train` that are kept from training because nothing else in it moves like them."""
QUICK = WrinkleConfig(
    texels=64,
    network=NetworkConfig(filters=8, layers=6, output="residual", dropout=0.0),
    loss=PRESETS["small"].loss,
    schedule=ScheduleConfig(
        steps=150, batch=2, learning_rate=2e-3, checkpoint_every=150, sample_every=150, log_every=50
    ),
)
QUICK_PAIRS = PairConfig(map=MapConfig(size=128))


@dataclass(frozen=True, slots=True)
class _Clips:
    train: tuple[Path, ...]
    like: tuple[Path, ...]
    unlike: tuple[Path, ...]
    pairs: PairConfig

    @property
    def all(self) -> tuple[Path, ...]:
        return (*self.train, *self.like, *self.unlike)


@dataclass(frozen=True, slots=True)
class _Result:
    """Means over clips: of the maps made, and of the low maps."""

    made: MapScores
    low: MapScores

    @property
    def ratio(self) -> float:
        return self.made.normal_error_deg / self.low.normal_error_deg


def run(
    *,
    quick: bool = False,
    train: tuple[Path, ...] = (),
    like: tuple[Path, ...] = (),
    unlike: tuple[Path, ...] = (),
    seeds: int = 3,
    cell_steps: int = 2000,
    keep: Path | None = None,
    workers: int = 2,
) -> list[Metric]:
    """Train the small preset and its variants, and measure them on held-out clips.

    Args:
        quick: a tiny network on the takes of a tiny set, one seed: that all of it runs, no more.
        train, like, unlike: work folders to learn from, and held-out ones of like and unlike motions; none: those of
            `tshirt-train`.
        seeds: of the default.
        cell_steps: steps of the cells of the table and of the variants, all alike.
        keep: folder for the trained networks; those that are there are not trained again.
    """
    plan = _quick_plan(workers) if quick else _plan(train, like, unlike, seeds, cell_steps, workers)
    for work in plan.clips.all:
        if train:
            ensure_pairs(open_work(work), plan.clips.pairs, workers=workers)
        else:
            renew(partial(make_pairs, open_work(work), plan.clips.pairs, workers=workers))
    with tempfile.TemporaryDirectory() as scratch:
        measured = _measure(plan, keep or Path(scratch), workers)
    for kind, found in measured.flickers.items():
        Console().print(f"flicker, {kind}: {' '.join(f'{value:.4f}' for value in found)} deg")
    cells, inputs = measured.cells, measured.inputs
    _print_cells(cells, PRINTED)
    _print_cells({"registration": cells["printed"], **inputs}, {"registration": PRINTED["printed"], **PRINTED_INPUTS})
    return [
        *_metrics(plan, measured),
        Metric("ms_per_map_paper", _milliseconds(PRESETS["paper"], 3 if quick else 15, workers), "ms"),
        Metric("ms_per_map", _milliseconds(PRESETS["small"], 5 if quick else 50, workers), "ms"),
    ]


@dataclass(frozen=True, slots=True)
class _Plan:
    """What is trained on what."""

    clips: _Clips
    base: WrinkleConfig
    seeds: int
    cell_steps: int
    bases: Mapping[str, int]
    """Blendshapes of each kind of input."""
    validation_share: float


def _quick_plan(workers: int) -> _Plan:
    """Without a validation share: most of its few frames are flagged."""
    return _Plan(_quick_clips(workers), replace(QUICK, held_out=0.0), 1, 60, {"bs500": 6, "bs200": 3}, 0.0)


def _plan(
    train: tuple[Path, ...],
    like: tuple[Path, ...],
    unlike: tuple[Path, ...],
    seeds: int,
    cell_steps: int,
    workers: int,
) -> _Plan:
    if not (train or like or unlike):
        clips = _training_clips(workers)
    elif not (train and like and unlike):
        raise InputError("benchmarks wrinkles: expected --train, --like and --unlike together, or none of them")
    else:
        clips = _Clips(train, like, unlike, PairConfig())
        if len({work.name for work in clips.all}) < len(clips.all):
            raise InputError("benchmarks wrinkles: expected work folders of different names, found two alike")
    base = replace(PRESETS["small"], held_out=0.0)
    return _Plan(clips, base, seeds, cell_steps, BASES, SplitConfig().validation_share)


@dataclass(frozen=True, slots=True)
class _Measured:
    """What the trained networks make."""

    results: list[_Result]
    """Of each seed, on the held-out clips of like motions."""
    unlike_ratios: list[float]
    """Of each seed, on those of unlike motions."""
    evidence: list[dict[str, float]]
    only_l1: _Result
    cells: dict[str, _Result]
    flickers: dict[str, list[float]]
    """Of each seed, degrees, with and without a temporal term."""
    inputs: dict[str, _Result]


def _measure(plan: _Plan, folder: Path, workers: int) -> _Measured:
    """Train every network that is not in the folder yet, and score them all."""
    clips, base = plan.clips, plan.base
    results, unlike_ratios, evidence = [], [], []
    for seed in range(plan.seeds):
        model = _trained(clips, replace(base, seed=seed), folder / f"seed{seed}", workers)
        results.append(_scored(model, clips.like))
        unlike_ratios.append(_scored(model, clips.unlike).ratio)
        evidence.append(_norm_evidence(model, clips.like))
    shorter = replace(base, schedule=replace(base.schedule, steps=plan.cell_steps))

    def cell(name: str, shown: _Clips, loss: LossConfig, seed: int = 0) -> _Result:
        config = replace(shorter, loss=loss, seed=seed)
        return _scored(_trained(shown, config, folder / name, workers), shown.like)

    only_l1 = cell("l1-only", clips, LossConfig(gan=0.0, temporal=0.0))
    kinds: tuple[TemporalLoss, ...] = get_args(TemporalLoss)
    cells: dict[str, _Result] = {kind: cell(kind, clips, LossConfig(temporal_kind=kind)) for kind in kinds}
    compared: tuple[TemporalLoss, ...] = (base.loss.temporal_kind, "none")
    flickers = {
        kind: [cells[kind].made.flicker_deg]
        + [
            cell(f"{kind}-seed{seed}", clips, LossConfig(temporal_kind=kind), seed).made.flicker_deg
            for seed in range(1, plan.seeds)
        ]
        for kind in compared
    }
    answers = _answers(clips, folder, plan.bases, plan.validation_share, workers)
    inputs = {name: cell(name, shown, LossConfig(temporal_kind="printed")) for name, shown in answers.items()}
    return _Measured(results, unlike_ratios, evidence, only_l1, cells, flickers, inputs)


def _metrics(plan: _Plan, measured: _Measured) -> list[Metric]:
    ratios = [result.ratio for result in measured.results]
    made = [result.made for result in measured.results]
    flickers = measured.flickers
    return [
        Metric("normal_error_ratio", float(np.mean(ratios))),
        Metric("normal_error_ratio_worst_seed", max(ratios)),
        Metric("normal_error_ratio_unlike", float(np.mean(measured.unlike_ratios))),
        Metric("normal_error_deg", float(np.mean([each.normal_error_deg for each in made])), "deg"),
        Metric("wrinkle_energy_kept", float(np.mean([each.wrinkle_energy_kept for each in made])), "", "higher"),
        Metric("wrinkle_energy_kept_l1_only", measured.only_l1.made.wrinkle_energy_kept, "", "higher"),
        Metric("flicker", float(np.mean(flickers[plan.base.loss.temporal_kind])), "deg"),
        Metric("flicker_no_temporal", float(np.mean(flickers["none"])), "deg", "higher"),
        Metric("ssim", float(np.mean([each.ssim for each in made])), "", "higher"),
        *_cell_metrics({**measured.cells, **measured.inputs}),
        *(
            Metric(f"normal_error_{kind}_norm_deg", float(np.mean([each[kind] for each in measured.evidence])), "deg")
            for kind in ("running", "instance")
        ),
    ]


def _training_clips(workers: int) -> _Clips:
    config, folder = training_set(quick=False, workers=workers)
    parts = ([name for name in learned_takes(config) if name not in UNLIKE], config.held_out, UNLIKE)
    works = [tuple(registered_takes(config, folder, names, tracked=True, workers=workers)) for names in parts]
    return _Clips(works[0], works[1], works[2], PairConfig())


def _quick_clips(workers: int) -> _Clips:
    config, folder = training_set(quick=True, workers=workers)
    parts = learned_takes(config), config.held_out, config.reversed
    works = [tuple(registered_takes(config, folder, names, tracked=False, workers=workers)) for names in parts]
    return _Clips(works[0], works[1], works[2], QUICK_PAIRS)


def _answers(
    clips: _Clips, folder: Path, bases: Mapping[str, int], validation_share: float, workers: int
) -> dict[str, _Clips]:
    """The same clips as a garment model has them: their registrations on some blendshapes, and its answers to their
    poses; paired with the high maps of their scans."""
    model_folder = folder / "model" / "retarget"
    shape = ShapeConfig(components=max(bases.values()))
    split = SplitConfig(validation_share=validation_share)
    works = [open_work(work) for work in clips.train]
    fit(works, model_folder, FitConfig(regressor="kernel", shape=shape, split=split), workers=workers)
    known = load_garment_model(model_folder)
    captured, config = known.person(), AnimateConfig(removal=RemovalConfig(enabled=False))
    placed: dict[Path, dict[str, Path]] = {}
    for work in clips.all:
        taken = open_work(work)
        sequence, (body, poses) = taken.registered, taken.require_posed_body()
        rows = PoseRows.match(sequence, with_shape(body, poses.shape), poses)
        unposed = unpose_sequence(sequence, rows, captured.shape, unseen_weight=shape.unseen_weight)
        frames, weights = (np.stack(each) for each in zip(*unposed, strict=True))
        projected = project(shape_space(known.model), frames, weights).astype(np.float32)
        own = {name: np.where(np.arange(projected.shape[1]) < count, projected, 0) for name, count in bases.items()}
        save_poses(folder / "poses" / f"{work.name}.npz", rows.poses)
        save_body(folder / "poses" / f"{work.name}.body.npz", body)
        motion = folder / "poses" / f"{work.name}.npz"
        wearer = Wearer(folder / "poses" / f"{work.name}.body.npz", poses.shape.tolist())
        for name in ("regression", *bases):
            output = folder / "answers" / name / work.name
            if name == "regression":
                animate(model_folder, motion, output, config, wearer=wearer, workers=workers)
            else:
                run_on_coefficients(model_folder, motion, own[name], output, config, wearer=wearer, workers=workers)
            make_pairs(open_work(output), clips.pairs, high_from=taken)
            placed.setdefault(work, {})[name] = output

    def shown(name: str) -> _Clips:
        parts = (clips.train, clips.like, clips.unlike)
        train, like, unlike = (tuple(placed[work][name] for work in part) for part in parts)
        return _Clips(train, like, unlike, clips.pairs)

    return {name: shown(name) for name in (*bases, "regression")}


def _trained(clips: _Clips, config: WrinkleConfig, output: Path, workers: int) -> WrinkleModel:
    Console(stderr=True).print(f"{output.name}: {config.schedule.steps} steps", highlight=False)
    train_network([open_work(work) for work in clips.train], output, config, workers=workers)
    return load_model(output / "generator.safetensors")


def _scored(model: WrinkleModel, works: Sequence[Path]) -> _Result:
    made, low = [], []
    for work in works:
        pairs = open_pairs(work)
        scores = score_take(model, fitted(pairs.read(), model.texels), pairs.template)
        made.append(scores[0])
        low.append(scores[1])
    return _Result(_mean(made), _mean(low))


def _norm_evidence(model: WrinkleModel, works: Sequence[Path]) -> dict[str, float]:
    """The same generator with either statistics of batch norm: degrees of error."""
    errors = {}
    for kind in ("running", "instance"):
        config = replace(model.config, norm_at_test=kind)
        twin = WrinkleModel(UNet(config), config, texels=model.texels, maps=model.maps,
                            layout_digest=model.layout_digest, template=model.template)  # fmt: skip
        twin.generator.load_state_dict(model.generator.state_dict())
        errors[kind] = _scored(twin, works).made.normal_error_deg
    return errors


def _mean(scores: Sequence[MapScores]) -> MapScores:
    fields = MapScores.__dataclass_fields__
    return MapScores(**{name: float(np.mean([getattr(each, name) for each in scores])) for name in fields})


def _cell_metrics(cells: Mapping[str, _Result]) -> list[Metric]:
    rows = []
    for name, result in cells.items():
        rows += [
            Metric(f"table1_{name}_data", result.made.data),
            Metric(f"table1_{name}_temporal_printed", result.made.temporal_printed),
            Metric(f"table1_{name}_temporal_texels", result.made.temporal_texels),
        ]
    return rows


def _print_cells(cells: Mapping[str, _Result], printed: Mapping[str, tuple[float, float]]) -> None:
    """Ours beside the printed ones."""
    table = Table("", "Data", "paper", "Temporal, net change", "Temporal, texel by texel", "paper")
    for name, result in cells.items():
        data, temporal = printed[name]
        made = result.made
        ours = (made.data, data, made.temporal_printed, made.temporal_texels, temporal)
        table.add_row(name, *(f"{value:.2f}" for value in ours))
    Console().print(table)


def _milliseconds(config: WrinkleConfig, repeats: int, threads: int) -> float:
    """Median wall time of one map of the size on disk, batch 1, not amortised; fresh weights cost what others do."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    network = UNet(config.network).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    maps = MapConfig()
    nobody = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    model = WrinkleModel(network, config.network, texels=config.texels, maps=maps, layout_digest="", template=nobody)
    low = torch.nn.functional.normalize(torch.randn(3, maps.size, maps.size), dim=0)
    times = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        model.generate(low)
        times.append(1e3 * (time.perf_counter() - begin))
    torch.set_num_threads(before)
    return float(np.median(times[1:]))
