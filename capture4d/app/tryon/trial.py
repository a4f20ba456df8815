"""Try-on without a browser: sliders that move at random, how fast and how well the garment follows.

Every slider goes from one value to another within its range, smoothly, in half a second to two, then waits up to as
long; a third of them move at a time. So do those of shape and style if asked, for which the garment is put on anew.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture4d.app.tryon.garments import Fitting, TriedGarment
from capture4d.app.tryon.session import still
from capture4d.app.tryon.sliders import PoseSliders

__all__ = ["Trial", "random_motion", "try_out"]


@dataclass(frozen=True, slots=True)
class Trial:
    """How a garment has followed random sliders."""

    frames: int
    fps: float
    """Frames a second of CPU time, of one thread: pose, garment, push and the body's surface; measuring apart."""
    slowest_ms: float
    """99th percentile over the frames."""
    moving_inside_percent: float
    """Vertices inside, in the mean over the frames."""
    moving_depth_mm: float
    """Deepest vertex of all frames while sliders move."""
    resting: int
    """Poses in which the sliders rested."""
    resting_ms: float
    """CPU time of an exact removal, mean."""
    resting_inside_percent: float
    resting_depth_mm: float
    """Of all poses at rest."""
    overlapping_percent: float
    """Vertices over skin that lies inside another limb, in the mean: the body overlaps itself there, and there is no
    outside."""


def random_motion(
    sliders: PoseSliders, frames: int, fps: float, rng: np.random.Generator
) -> Iterator[dict[str, float]]:
    """Degrees of every slider, frame by frame."""
    count = len(sliders.sliders)
    low = np.array([slider.low for slider in sliders.sliders])
    high = np.array([slider.high for slider in sliders.sliders])
    values, start, goal = np.zeros(count), np.zeros(count), np.zeros(count)
    begun, lasts, waits = np.zeros(count), np.full(count, 1e-9), rng.uniform(0.0, 2.0, count)
    for frame in range(frames):
        now = frame / fps
        for each in np.flatnonzero(now >= begun + lasts + waits):
            start[each], begun[each] = values[each], now
            lasts[each], waits[each] = rng.uniform(0.5, 2.0), rng.uniform(0.0, 4.0)
            goal[each] = rng.uniform(low[each], high[each])
        share = np.clip((now - begun) / lasts, 0.0, 1.0)
        values = start + (3 * share**2 - 2 * share**3) * (goal - start)
        yield {slider.name: float(value) for slider, value in zip(sliders.sliders, values, strict=True)}


def try_out(
    tried: TriedGarment,
    seconds: float,
    rng: np.random.Generator,
    *,
    rest_every_s: float = 2.0,
    beta: Sequence[float] | None = None,
    style: Mapping[str, float] | None = None,
) -> Trial:
    """Move the sliders for so long, at the garment's rate or at least 30 frames a second; rest now and then.

    Args:
        rest_every_s: after so long the exact removal is made, and the sliders go on from there.
        beta, style: who wears it, and in which style; by default who does so at first.
    """
    sliders = PoseSliders.of(tried.body)
    fitting = Fitting(tried, tried.first_shape if beta is None else beta, style or {})
    fps, nowhere = max(tried.fps, 30.0), np.zeros(3, np.float32)
    frames = max(int(seconds * fps), 1)
    took, inside, overlapping, depths = [], [], [], []
    at_rest, rest_took = [], []
    rest_every = max(int(rest_every_s * fps), 1)
    fitting.moving(sliders.rotations({}), nowhere)  # compiles
    for frame, degrees in enumerate(random_motion(sliders, frames, fps, rng)):
        begun = time.thread_time()
        rotations = sliders.rotations(degrees)
        vertices, skinned = fitting.moving(rotations, nowhere)
        took.append(time.thread_time() - begun)
        found = fitting.inside(vertices, skinned)
        inside.append(found.inside_percent)
        overlapping.append(found.overlap_percent)
        depths.append(found.depth_max_mm)
        if (frame + 1) % rest_every == 0:
            begun = time.thread_time()
            vertices, skinned = fitting.resting(still(tried, rotations, nowhere, fitting.worn.remembers + 1))
            rest_took.append(time.thread_time() - begun)
            at_rest.append(fitting.inside(vertices, skinned))
    return Trial(
        frames, frames / sum(took), 1e3 * float(np.percentile(took, 99)), float(np.mean(inside)), max(depths),
        len(at_rest), 1e3 * float(np.mean(rest_took)) if rest_took else float("nan"),
        max((each.inside_percent for each in at_rest), default=0.0),
        max((each.depth_max_mm for each in at_rest), default=0.0), float(np.mean(overlapping)),
    )  # fmt: skip
