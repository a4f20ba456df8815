"""Frames one after the other: where each starts from, and what happens when one fails.

Frame by frame the cloth moves little and what it slides along the body can be followed; over larger steps it cannot. So
frames are registered one from the other. The first starts from the skinned template (with the cold schedule), or from
the last frame of another run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from capture4d.errors import InputError
from capture4d.types import GarmentScan
from registration.config import RegistrationConfig
from registration.predictions import Mover, choose, predict
from registration.quality import FrameQuality, assess
from registration.register import prepare_frame, register_frame
from registration.template import TemplateAnalysis, UnknownBorderError

__all__ = ["FrameResult", "register_run"]


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """One frame of the take, registered or flagged."""

    frame_id: int
    vertices: Float32[np.ndarray, "verts 3"]
    """Metres; the best prediction where the frame failed before it was fitted."""
    quality: FrameQuality
    started_from: str
    linear_iterations: int
    cpu_s: float
    """Process time of preparing, fitting and assessing."""
    position: int
    """In the take."""
    before: int | None
    """Position of the frame that it could start from; None of the first of a run."""


def register_run(
    analysis: TemplateAnalysis,
    mover: Mover | None,
    positions: Sequence[int],
    frame_ids: Sequence[int],
    *,
    load: Callable[[int], GarmentScan],
    done: Callable[[int, int | None], tuple[np.ndarray, bool] | None],
    config: RegistrationConfig,
    before: tuple[np.ndarray, int] | None = None,
) -> Iterator[FrameResult]:
    """Register frames one from the other; yields those that were not done before.

    Args:
        positions: of the frames in the take, ascending.
        frame_ids: of the whole take.
        load: the garment scan of a frame; may raise InputError, which flags the frame.
        done: of the frame at a position, if it was finished earlier, starting from the frame at another (None for the
            first of a run): its vertices, and whether they may be built upon; else None.
        before: vertices to start from, and the position of their frame; None starts from the template.
    Raises:
        UnknownBorderError: paints are named after loops that the template lacks.
    """
    for position in positions:
        frame_id = frame_ids[position]
        earlier = done(position, None if before is None else before[1])
        if earlier is not None:
            vertices, sound = earlier
        else:
            result = _register_one(analysis, mover, frame_id, position, before, load, config)
            yield result
            vertices, sound = result.vertices, result.quality.verdict != "failed"
        if sound:
            before = (vertices, position)


def _register_one(
    analysis: TemplateAnalysis,
    mover: Mover | None,
    frame_id: int,
    index: int,
    before: tuple[np.ndarray, int] | None,
    load: Callable[[int], GarmentScan],
    config: RegistrationConfig,
) -> FrameResult:
    begin, at = time.process_time(), None if before is None else before[1]
    candidates = predict(analysis, mover, index, before, config)
    name, start = next(iter(candidates.items()))
    try:
        scan = prepare_frame(analysis, load(frame_id), config)
        name, start, schedule = choose(analysis, scan, candidates, distant=before is None, config=config)
        fitted = register_frame(analysis, scan, start, config=config, schedule=schedule)
    except UnknownBorderError:  # every frame would fail alike
        raise
    except InputError as error:
        return FrameResult(
            frame_id,
            start.astype(np.float32),
            FrameQuality.unmeasured(len(start), str(error)),
            name,
            0,
            time.process_time() - begin,
            index,
            at,
        )
    vertices = fitted.vertices.astype(np.float32)
    regions = None if mover is None else mover.regions
    quality = assess(analysis, scan, vertices.astype(np.float64), config.quality, regions=regions)
    cpu_s = time.process_time() - begin
    return FrameResult(frame_id, vertices, quality, f"{name}, {schedule}", fitted.linear_iterations, cpu_s, index, at)
