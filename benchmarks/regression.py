"""From pose to folds: mean and nearest pose, linear regression, LSTM and kernels, on clips that were not learned from.

DeepWrinkles (ECCV 2018) prints a mean squared error of 2.902 for its linear regression and 1.892 for its LSTM, a ratio
of 0.65, on shapes of its own; ours are in square millimetres. Beside the defaults stands `paper_`: its network of four
layers, learned from the takes as they are, without noise on the controls, beside our ridge regression with an intercept
of the same; one seed, from registered takes.

`linear` learns from the takes as they are and in the mirror, as everything does by default; `linear_unmirrored` only as
they are, and so does `linear_printed`, the paper's F = L T^+ without intercept and ridge. The kernels see more than the
paper's control vector (`KernelConfig.control`). `ensemble`, the default of `animate`, is the mean of kernels and LSTM.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.learning_takes import Lesson, lesson, training_set
from benchmarks.metric import Metric
from capture4d.captures.animations.known_poses import nearest_poses, pose_quaternions
from retarget.config import FitConfig, LstmConfig
from retarget.regression.controls import ControlLayout
from retarget.regression.ensemble import ensemble
from retarget.regression.kernel import fit_kernel
from retarget.regression.learning import (
    Projected,
    fitting_clips,
    learn_shapes,
    learned_rows,
    predictions,
    regression_clips,
    vertex_error_m,
)
from retarget.regression.linear import LinearRegressor, fit_linear
from retarget.regression.regressors import Clip, FittingClips, Regressor
from retarget.regression.splits import Piece
from retarget.regression.training import fit_lstm
from retarget.shapes.mirroring import find_mirror

FREE_FRAMES = 1000
DEFAULT = FitConfig()


def run(
    *,
    quick: bool = False,
    seeds: int = 3,
    workers: int = 2,
    tracked: bool = True,
    config: FitConfig = DEFAULT,
) -> list[Metric]:
    """Learn from registered takes and from the truth; measure on held-out clips and on clips that run backwards.

    Args:
        quick: a tiny set and a small network; the same keys.
        seeds: networks, of which the mean is printed.
        workers: processes that make the takes and register them.
        tracked: register with tracked poses.
        config: of the model.
    """
    if quick:
        small = LstmConfig(layers=2, size=64, window=config.lstm.window, over_linear=config.lstm.over_linear)
        training = replace(config.training, epochs=30, patience=10)
        config = replace(config, lstm=small, training=training)
    chosen, folder = training_set(quick=quick, workers=workers)
    metrics = []
    for prefix, truth in (("", False), ("truth_", True)):
        taken = lesson(chosen, folder, truth=truth, tracked=tracked and not quick, workers=workers)
        metrics += [replace(metric, key=f"{prefix}{metric.key}") for metric in _methods(taken, config, seeds)]
        if not truth:
            paper = replace(
                config,
                mirror="off",
                lstm=replace(config.lstm, layers=2 if quick else 4, over_linear=False, weighed=False),
                training=replace(config.training, weight_decay=0.0, control_noise=0.0),
            )
            wanted = ("lstm_to_linear_mse", "lstm_to_linear_printed_mse", "linear_vertex_mm", "lstm_vertex_mm")
            metrics += [
                replace(metric, key=f"paper_{metric.key}")
                for metric in _methods(taken, paper, 1)
                if metric.key.removeprefix("reversed_") in wanted
            ]
    return metrics


def _methods(taken: Lesson, config: FitConfig, seeds: int) -> list[Metric]:
    takes, pieces = taken.takes, taken.pieces
    space, _ = learn_shapes(takes, learned_rows(takes, pieces), config.shape)
    fps = takes.takes[0].poses.fps
    projected: Projected = {}
    layout, own = (
        ControlLayout.create(taken.person.body, takes.skin_weights, fps, each)
        for each in (config.control, config.kernel.control)
    )
    plain = regression_clips(takes, pieces, "training", layout, space, None, projected)
    plain += regression_clips(takes, pieces, "validation", layout, space, None, projected)
    rest = taken.garment.template.with_vertices(space.mean.astype(np.float32))
    mirror = find_mirror(rest, taken.person.body.joint_names, config.mirror)
    clips = fitting_clips(takes, pieces, layout, space, mirror, projected)
    linear = fit_linear(clips, layout, space.std, config.linear)
    as_they_are = fitting_clips(takes, pieces, layout, space, None, projected)
    unmirrored = fit_linear(as_they_are, layout, space.std, config.linear)
    printed = fit_linear(as_they_are, layout, space.std, replace(config.linear, fit="moore-penrose"))
    kernel = fit_kernel(fitting_clips(takes, pieces, own, space, mirror, projected), own, space.std, config.kernel)
    networks = [_network(clips, layout, space.std, linear, config, seed) for seed in range(seeds)]
    together = [each for each in (ensemble(kernel, network) for network in networks) if each is not None]
    metrics = [Metric("directions", float(len(space.std))), Metric("control_numbers", float(layout.size))]
    for name, examined in (("", pieces), ("reversed_", taken.reversed)):
        held_out, seen_more = (
            regression_clips(takes, examined, "held out", each, space, None, projected) for each in (layout, own)
        )
        said = {
            "mean": [[np.zeros_like(clip.coefficients) for clip in held_out]],
            "nearest": [_nearest(taken, examined, layout, plain)],
            "linear_printed": [predictions(printed, held_out)],
            "linear_unmirrored": [predictions(unmirrored, held_out)],
            "linear": [predictions(linear, held_out)],
            "lstm": [predictions(network, held_out) for network in networks],
            "kernel": [predictions(kernel, seen_more)],
            "ensemble": [predictions(each, seen_more) for each in together],
        }
        errors: dict[str, tuple[float, float]] = {}
        for method, tries in said.items():
            mse = float(np.mean([_squared(answers, held_out) for answers in tries]))
            off = float(np.mean([vertex_error_m(takes, examined, "held out", space, answers) for answers in tries]))
            errors[method] = mse, off
            metrics.append(Metric(f"{name}{method}_coefficient_mse_mm2", 1e6 * mse, "mm2"))
            metrics.append(Metric(f"{name}{method}_vertex_mm", 1e3 * off, "mm"))
        for method in ("lstm", "kernel", "ensemble"):
            for other in ("linear", "linear_unmirrored", "linear_printed"):
                for kind, which in (("mse", 0), ("vertex", 1)):
                    ratio = errors[method][which] / errors[other][which]
                    metrics.append(Metric(f"{name}{method}_to_{other}_{kind}", ratio))
        if not name:
            drifts = [
                *(_drift(network, held_out[0]) for network in networks),
                *(_drift(each, seen_more[0]) for each in together),
            ]
            metrics.append(Metric(f"drift_{FREE_FRAMES}_frames", max(drifts)))
    return metrics


def _network(
    clips: FittingClips,
    layout: ControlLayout,
    std: np.ndarray,
    linear: LinearRegressor,
    config: FitConfig,
    seed: int,
) -> Regressor:
    settings = replace(config, training=replace(config.training, seed=seed))
    with tempfile.TemporaryDirectory(prefix="capture4d-regression-") as scratch:
        found = fit_lstm(clips, layout, std, Path(scratch), settings, linear=linear).regressor
        runs = [Path(scratch) / name / "metrics.jsonl" for name in ("training", "final")]  # first: with validation
        lines = next(path for path in runs if path.is_file()).read_text().splitlines()
    Console(stderr=True).print(f"seed {seed}: {len(lines)} epochs, {lines[-1]}", soft_wrap=True)
    return found


def _nearest(
    taken: Lesson, examined: Sequence[Piece], layout: ControlLayout, training: Sequence[Clip]
) -> list[np.ndarray]:
    """The coefficients of the training frame with the nearest pose."""
    takes = taken.takes.takes

    def quaternions(piece: Piece) -> np.ndarray:
        return pose_quaternions(takes[piece.take].poses.rotations, layout.joints)

    learned = [piece for role in ("training", "validation") for piece in taken.pieces if piece.role == role]
    good = np.concatenate([clip.good for clip in training])
    known = np.concatenate([quaternions(piece) for piece in learned])[good]
    coefficients = np.concatenate([clip.coefficients for clip in training])[good]
    return [coefficients[nearest_poses(quaternions(piece), known)[1]] for piece in examined if piece.role == "held out"]


def _squared(answers: Sequence[np.ndarray], clips: Sequence[Clip]) -> float:
    """Mean square of the coefficients' errors over the good frames, square metres."""
    errors = [
        (said - clip.coefficients)[clip.good].astype(np.float64) for said, clip in zip(answers, clips, strict=True)
    ]
    return float(np.mean(np.concatenate(errors) ** 2))


def _drift(regressor: Regressor, clip: Clip) -> float:
    """A clip forwards and backwards, over and over for a thousand frames, answered frame by frame: how far the last
    round is from the second, relative to the coefficients' own size."""
    loop = np.concatenate([clip.controls, clip.controls[::-1]])
    rounds = max(3, -(-FREE_FRAMES // len(loop)))
    stream = regressor.stream()
    said = np.stack([stream.push(row) for _ in range(rounds) for row in loop]).reshape(rounds, len(loop), -1)
    return float(np.linalg.norm(said[-1] - said[1]) / max(float(np.linalg.norm(said[1])), 1e-12))
