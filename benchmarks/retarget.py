"""The captured garment on other people, against the cloth simulated on them: the same motion, the garment graded.

naive      the captured offsets skinned with the other person's skeleton
eq5        the mean moved with the body (DeepWrinkles, Eq. 5, corrected)
default    the same, out of the body, and its edges no longer than cloth's
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.learning_takes import Lesson, lesson, training_set, true_take
from benchmarks.metric import Metric
from capture4d.body.skinning import ShapedBody
from capture4d.captures.animations.config import RemovalConfig
from capture4d.captures.animations.frame_files import AnimatedFrame
from capture4d.captures.capture import read_capture
from capture4d.captures.evaluation import correspondence_errors
from capture4d.geometry.intersection_removal import Removed
from capture4d.types import BlendshapeModel, PoseSequence, RegisteredSequence
from data_synth.config import TrainingSetConfig
from retarget.animation.animator import Animator
from retarget.animation.bodies import retargeted_mean
from retarget.config import AnimateConfig, ShapeConfig
from retarget.regression.learning import learn_shapes, learned_rows
from retarget.shapes.blendshapes import ShapeSpace, as_model_arrays, project

METHODS = ("naive", "eq5", "default")


def run(*, quick: bool = False, workers: int = 2, tracked: bool = True, every: int = 5) -> list[Metric]:
    """Learn from registered takes, put the held-out clips on other people.

    Args:
        quick: a tiny set, registered with the capture's poses; the same keys.
        workers: processes that make the takes and register them.
        tracked: register with tracked poses.
        every: measure every n-th frame of a clip, unless it was flagged.
    """
    config, folder = training_set(quick=quick, workers=workers)
    taken = lesson(config, folder, truth=False, tracked=tracked and not quick, workers=workers)
    space, _ = learn_shapes(taken.takes, learned_rows(taken.takes, taken.pieces), ShapeConfig())
    model = BlendshapeModel(
        taken.garment, *as_model_arrays(space), taken.person.body.joint_names, taken.takes.takes[0].poses.fps
    )
    metrics, ratios, inside, before, moved = [], [], [], [], []
    for who in config.bodies:
        errors, removals = _on(who, taken, model, space, config, folder, every)
        metrics += [Metric(f"{who}_{method}_mm", errors[method], "mm") for method in METHODS]
        ratios.append(errors["default"] / errors["naive"])
        inside.append(float(np.mean([each.after.inside_percent for each in removals])))
        before.append(float(np.mean([each.before.inside_percent for each in removals])))
        moved.append(float(np.mean([each.rest_moved_mm for each in removals])))
        Console(stderr=True).print(f"{who}: {errors}, inside {before[-1]:.2f} % before, {inside[-1]:.3f} % after")
    return [
        *metrics,
        Metric("worst_ratio_to_naive", max(ratios)),
        Metric("inside_before_percent", max(before), "%"),
        Metric("inside_body_percent", max(inside), "%"),
        Metric("removal_moved_mm", max(moved), "mm"),
    ]


def _on(
    who: str,
    taken: Lesson,
    model: BlendshapeModel,
    space: ShapeSpace,
    config: TrainingSetConfig,
    folder: Path,
    every: int,
) -> tuple[dict[str, float], list[Removed]]:
    """Mean vertex errors of each method on one person, millimetres, and what removal did."""
    errors: dict[str, list[float]] = {method: [] for method in METHODS}
    removals: list[Removed] = []
    names = list(config.takes)
    for clip in config.held_out:
        truth, person, poses, _ = true_take(read_capture(folder / "bodies" / who / clip, scans=False))
        take = names.index(clip)
        rows = [row for row in range(0, len(poses.frame_ids), every) if taken.takes.takes[take].good[row]]
        start = taken.takes.start(take)
        frames = [start + row for row in rows]
        captured = project(space, taken.takes.vertices[frames], taken.takes.weights[frames]).astype(np.float32)
        coefficients = np.zeros((len(poses.frame_ids), captured.shape[1]), np.float32)
        coefficients[rows] = captured
        for method in METHODS:
            animated = _animated(method, taken, model, person, poses, coefficients, rows)
            errors[method] += [_error_mm(each.vertices, truth, row) for each, row in zip(animated, rows, strict=True)]
            if method == "default":
                removals += [each.removed for each in animated]
    return {method: float(np.mean(values)) for method, values in errors.items()}, removals


def _animated(
    method: str,
    taken: Lesson,
    model: BlendshapeModel,
    person: ShapedBody,
    poses: PoseSequence,
    coefficients: np.ndarray,
    rows: Sequence[int],
) -> list[AnimatedFrame]:
    whole = method == "default"
    settings = AnimateConfig(
        mean="captured" if method == "naive" else "corrected",
        longest=AnimateConfig().longest if whole else 0.0,
        removal=RemovalConfig(enabled=whole),
    )
    mean = retargeted_mean(model, taken.person, person, formula=settings.mean)
    return Animator(model, person, mean, settings).frames(poses, coefficients, rows)


def _error_mm(vertices: np.ndarray, truth: RegisteredSequence, row: int) -> float:
    return 1e3 * float(correspondence_errors(vertices, truth.vertices[row]).mean())
