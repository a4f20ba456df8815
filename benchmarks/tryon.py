"""`capture4d tryon` without a browser: sliders that move at random, how fast and how well a garment follows them.

The garment is learned from a few frames of a small synthetic take; the second person is one it was not learned on.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.cached_takes import cached_take
from benchmarks.metric import Metric
from benchmarks.registered_work import QUICK_TAKE
from benchmarks.renewal import renew
from benchmarks.true_works import write_true_work
from capture4d import pipeline
from capture4d.app.tryon.garments import open_garment
from capture4d.app.tryon.trial import try_out
from capture4d.cache import user_cache_folder
from capture4d.captures.capture import read_capture
from retarget.config import FitConfig

OTHER = (0.5, 1.5)
"""Taller and heavier."""


def run(*, quick: bool = False, seconds: float = 60.0, seed: int = 0, workers: int = 2) -> list[Metric]:
    """Try a T-shirt on.

    Args:
        quick: a shirt of 1,500 vertices for a sixth of the time; else one of 5,000.
        seconds: of random sliders, on each of two people.
        seed: of the sliders.
    """
    config = QUICK_TAKE if quick else replace(QUICK_TAKE, name="tryon", template_vertices=5000)
    capture = cached_take(config, workers=workers)
    work = user_cache_folder() / "works" / f"tryon-{capture.name}"
    write_true_work(read_capture(capture), work)
    renew(partial(pipeline.fit, [work], work / "retarget", FitConfig(), workers=workers))
    tried, rng = open_garment(work), np.random.default_rng(seed)
    found: list[Metric] = [Metric("vertices", len(tried.garment.template.vertices), "", "higher")]
    for name, beta in (("captured", None), ("other", [*OTHER, *tried.first_shape[2:]])):
        trial = try_out(tried, seconds / 6 if quick else seconds, rng, beta=beta)
        found += [
            Metric(f"{name}_fps", trial.fps, "Hz", "higher"),
            Metric(f"{name}_slowest_ms", trial.slowest_ms, "ms"),
            Metric(f"{name}_moving_depth_mm", trial.moving_depth_mm, "mm"),
            Metric(f"{name}_moving_inside_percent", trial.moving_inside_percent, "%"),
            Metric(f"{name}_overlapping_percent", trial.overlapping_percent, "%"),
            Metric(f"{name}_resting_inside_percent", trial.resting_inside_percent, "%"),
            Metric(f"{name}_resting_depth_mm", trial.resting_depth_mm, "mm"),
            Metric(f"{name}_resting_ms", trial.resting_ms, "ms"),
        ]
    return found
