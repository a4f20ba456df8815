"""How many directions a garment needs, and how fast it comes back.

DeepWrinkles (ECCV 2018) keeps 500 directions for less than 5 mm on every training frame, with 5,048 vertices and 9,213
frames.
"""

from __future__ import annotations

import math
import time

import numpy as np

from benchmarks.learning_takes import Lesson, lesson, training_set
from benchmarks.metric import Metric
from retarget.config import ShapeConfig
from retarget.shapes.blendshapes import fewest_directions, learn_shape_space, reconstruct, skin_frames, worst_errors

COUNTS = (25, 50, 100, 200, 500)
VERTICES, DIRECTIONS, JOINTS = 5000, 500, 36


def run(*, quick: bool = False, workers: int = 2, tracked: bool = True) -> list[Metric]:
    """Learn from registered takes and from the truth; measure on held-out clips.

    Args:
        quick: a tiny set, registered with the capture's poses; the same keys. What so few frames cannot give is NaN.
        workers: processes that make the takes and register them.
        tracked: register with tracked poses.
    """
    config, folder = training_set(quick=quick, workers=workers)
    metrics = []
    for prefix, truth in (("", False), ("truth_", True)):
        taken = lesson(config, folder, truth=truth, tracked=tracked and not quick, workers=workers)
        metrics += [
            Metric(f"{prefix}{metric.key}", metric.value, metric.unit, metric.better) for metric in _errors(taken)
        ]
    return [*metrics, Metric("frames_per_cpu_s", _speed(), "1/s", "higher")]


def _errors(taken: Lesson) -> list[Metric]:
    takes, config = taken.takes, ShapeConfig(components=max(COUNTS))
    training, held_out = (takes.rows(taken.pieces, role) for role in ("training", "held out"))
    space = learn_shape_space(takes.vertices, takes.weights, training, config, np.random.default_rng(0))
    known = (takes.vertices, takes.weights)
    moved = (takes.transforms, takes.skin_weights)
    fewest = fewest_directions(space, *known, training, *moved, limit_m=5e-3)
    counts = [count for count in COUNTS if count <= len(space.std)]
    found = worst_errors(space, *known, held_out, *moved, [*counts, len(space.std)])
    rows = []
    for count in COUNTS:
        mean, worst = found.get(count, (math.nan, math.nan))
        rows += [
            Metric(f"error_mean_mm_k{count}", 1e3 * mean, "mm"),
            Metric(f"error_max_mm_k{count}", 1e3 * worst, "mm"),
        ]
    mean, worst = found[len(space.std)]
    return [
        *rows,
        Metric("error_mean_mm_all", 1e3 * mean, "mm"),
        Metric("error_max_mm_all", 1e3 * worst, "mm"),
        Metric("directions", float(len(space.std)), "", "higher"),
        Metric("k_for_5mm_max", math.nan if fewest is None else float(fewest)),
    ]


def _speed() -> float:
    """Frames that come back from coefficients and are skinned, per CPU second; median of five."""
    rng = np.random.default_rng(0)
    mean = rng.standard_normal((VERTICES, 3)).astype(np.float32)
    basis = rng.standard_normal((DIRECTIONS, VERTICES, 3)).astype(np.float32)
    weights = rng.dirichlet(np.ones(JOINTS), VERTICES).astype(np.float32)
    coefficients = rng.standard_normal((64, DIRECTIONS)).astype(np.float32)
    transforms = np.tile(np.eye(4), (64, JOINTS, 1, 1))
    rates = []
    for _ in range(5):
        begin = time.process_time()
        skin_frames(reconstruct(mean, basis, coefficients), weights, transforms)
        rates.append(len(coefficients) / (time.process_time() - begin))
    return float(np.median(rates))
