"""A take, frame after frame: where each frame starts from, and what happens when one fails.

With poses, every n-th frame is a keyframe. Keyframes are registered first, one from the other and with the cold schedule,
so that sliding cannot build up frame by frame; then the frames between, each run of them from its keyframe. Runs need
nothing from each other, go in parallel, and give the same result on any number of workers. A frame starts from the best
of three predictions, measured by their distance to its scan:

    carried    the frame before, taken to the rest pose by inverse skinning and skinned to this frame's pose
    previous   the frame before as it is
    skinned    the template skinned to this frame's pose

Where the blended skinning matrix is near singular the inverse means nothing, and the vertex keeps its template offset.
Without poses each frame starts from the one before, and the first from the template as it lies.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64

from capture4d.body import ShapedBody, pose_frame, skin, unskin, with_shape
from capture4d.errors import InputError
from capture4d.types import Body, GarmentScan, PoseSequence
from registration.config import RegistrationConfig
from registration.quality import FrameQuality, assess
from registration.register import FrameScan, prepare_frame, register_frame
from registration.template import TemplateAnalysis

__all__ = ["FrameResult", "Mover", "register_run", "runs_between_keyframes"]


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


@dataclass(frozen=True, slots=True, eq=False)
class Mover:
    """The body under the garment, as far as registration needs it: where the template goes in each pose."""

    shaped: ShapedBody
    poses: PoseSequence
    rest: Float64[np.ndarray, "verts 3"]
    skin_weights: Float32[np.ndarray, "verts joints"]

    @staticmethod
    def create(analysis: TemplateAnalysis, body: Body | None, poses: PoseSequence | None) -> Mover | None:
        """None unless there are a body, its poses, and skin weights in the template."""
        weights = analysis.garment.skin_weights
        if body is None or poses is None or weights is None:
            return None
        if poses.joint_names != body.joint_names or weights.shape[1] != len(body.joint_names):
            raise InputError(
                f"poses and template: expected the body's {len(body.joint_names)} joints, found "
                f"{len(poses.joint_names)} in the poses and {weights.shape[1]} in the template's skin weights"
            )
        return Mover(with_shape(body, poses.shape), poses, analysis.rest, weights)

    def skinned(self, index: int) -> Float64[np.ndarray, "verts 3"]:
        """The template in the pose of the index-th frame."""
        return skin(self.rest, self.skin_weights, pose_frame(self.shaped, self.poses, index).transforms)

    def carried(
        self, vertices: Float32[np.ndarray, "verts 3"], before: int, index: int, share: float
    ) -> Float64[np.ndarray, "verts 3"]:
        """Vertices of frame `before` in the pose of frame `index`, offsets from the skinned template times `share`."""
        rest, flagged = unskin(
            vertices.astype(np.float64), self.skin_weights, pose_frame(self.shaped, self.poses, before).transforms
        )
        offset = np.where(flagged[:, None], 0.0, rest - self.rest)
        transforms = pose_frame(self.shaped, self.poses, index).transforms
        return skin(self.rest + share * offset, self.skin_weights, transforms)


def runs_between_keyframes(frames: int, *, spacing: int, posed: bool) -> tuple[range, list[range]]:
    """The keyframes, and runs that each begin with one, as positions in the take.

    Without poses nothing but the frame before can start a frame: one keyframe, one run.
    """
    step = spacing if posed else max(frames, 1)
    return range(0, frames, step), [range(first, min(first + step, frames)) for first in range(0, frames, step)]


def register_run(
    analysis: TemplateAnalysis,
    mover: Mover | None,
    positions: Sequence[int],
    frame_ids: Sequence[int],
    *,
    keyframes: bool,
    load: Callable[[int], GarmentScan],
    done: Callable[[int], tuple[np.ndarray, bool] | None],
    config: RegistrationConfig,
) -> Iterator[FrameResult]:
    """Register frames one from the other; yields those that were not done before.

    Args:
        positions: of the frames in the take, ascending.
        frame_ids: of the whole take.
        keyframes: take the cold schedule for every frame.
        load: the garment scan of a frame; may raise InputError, which flags the frame.
        done: vertices of a frame that was finished earlier and whether they may be built upon, or None.
    """
    before: tuple[np.ndarray, int] | None = None
    for position in positions:
        frame_id = frame_ids[position]
        earlier = done(frame_id)
        if earlier is not None:
            vertices, sound = earlier
        else:
            result = _register_one(analysis, mover, frame_id, position, before, keyframes, load, config)
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
    keyframe: bool,
    load: Callable[[int], GarmentScan],
    config: RegistrationConfig,
) -> FrameResult:
    begin = time.process_time()
    candidates = _predictions(analysis, mover, index, before, config)
    name, start = next(iter(candidates.items()))
    try:
        scan = prepare_frame(analysis, load(frame_id), config)
        name, start, schedule = _choose(analysis, scan, candidates, keyframe or before is None, config)
        fitted = register_frame(analysis, scan, start, config=config, schedule=schedule)
    except InputError as error:
        return FrameResult(
            frame_id, start.astype(np.float32), _failure(len(start), str(error)), name, 0, time.process_time() - begin
        )
    vertices = fitted.vertices.astype(np.float32)
    quality = assess(analysis, scan, vertices.astype(np.float64), config.quality)
    cpu_s = time.process_time() - begin
    return FrameResult(frame_id, vertices, quality, f"{name}, {schedule}", fitted.linear_iterations, cpu_s)


def _predictions(
    analysis: TemplateAnalysis,
    mover: Mover | None,
    index: int,
    before: tuple[np.ndarray, int] | None,
    config: RegistrationConfig,
) -> dict[str, np.ndarray]:
    """Where the frame may start from, by name; at least one."""
    found: dict[str, np.ndarray] = {}
    start = config.sequence.start
    if before is not None and start != "skinned":
        vertices, at = before
        if mover is not None and config.sequence.carry > 0.0:
            found["carried"] = mover.carried(vertices, at, index, config.sequence.carry)
        found["previous"] = vertices.astype(np.float64)
    if mover is not None and (start != "previous" or not found):
        found["skinned"] = mover.skinned(index)
    return found or {"template": analysis.rest}


def _choose(
    analysis: TemplateAnalysis,
    scan: FrameScan,
    candidates: dict[str, np.ndarray],
    distant: bool,
    config: RegistrationConfig,
) -> tuple[str, np.ndarray, Literal["cold", "warm"]]:
    """The prediction nearest to the scan, and whether it is near enough for the warm schedule."""
    subset = analysis.coarse_vertices
    misfit = {
        name: float(np.median(scan.surface.tree.query(vertices[subset])[0])) for name, vertices in candidates.items()
    }
    name = min(misfit, key=lambda key: misfit[key])
    return name, candidates[name], "cold" if distant or misfit[name] > config.sequence.cold_above else "warm"


def _failure(count: int, reason: str) -> FrameQuality:
    return FrameQuality("failed", (reason,), np.full(count, np.nan), {})
