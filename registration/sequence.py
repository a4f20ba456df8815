"""A take, frame after frame: where each frame starts from, and what happens when one fails.

Frame by frame the cloth moves little and what it slides along the body can be followed; over larger steps it cannot. So
frames are registered one from the other, in segments. A segment starts from a keyframe: a frame whose pose is so near
the template's rest pose that the skinned template is a start as good as any (with the cold schedule). Segments need
nothing from each other, run in parallel, and give the same result on any number of workers.

Inside a segment there are three predictions of a frame:

    carried    the frame before, taken to the rest pose by inverse skinning and skinned to this frame's pose
    previous   the frame before as it is
    skinned    the template skinned to this frame's pose

Sleeves follow the arms while a hem lags behind, so carried and previous are blended, node by node, by their distance to
the scan. The start is the blend or the skinned template, whichever lies nearer. Where the blended skinning matrix is
near singular its inverse means nothing, and the vertex keeps its template offset. Without poses each frame starts from
the one before, and the first from the template as it lies.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64

from capture4d.body.skinning import ShapedBody, pose_frame, skin, unskin, with_shape
from capture4d.errors import InputError
from capture4d.types import Body, GarmentScan, PoseSequence
from registration.config import RegistrationConfig, SequenceConfig
from registration.quality import FrameQuality, assess
from registration.register import FrameScan, prepare_frame, register_frame
from registration.template import TemplateAnalysis, UnknownBorderError

__all__ = ["FrameResult", "Mover", "register_run", "segments"]


BLEND_FLOOR, BLEND_REACH = 0.002, 0.1
"""Metres: below the floor two predictions fit equally well; beyond the reach one is as bad as another."""


COLD_SPACINGS = 1.3
"""Distances below so many sample spacings of a scan say nothing about how far off a start is."""


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

    def bend_deg(self) -> Float64[np.ndarray, " frames"]:
        """How far each frame's joints are from the rest pose: root mean square angle under the garment, degrees."""
        share = self.skin_weights.sum(axis=0).astype(np.float64)
        share[0] = 0.0  # the root moves everything alike
        trace = np.einsum("tjaa->tj", self.poses.rotations.astype(np.float64))
        angle = np.degrees(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))
        return np.sqrt((share * angle**2).sum(axis=1) / max(float(share.sum()), 1e-12))

    def carried(
        self, vertices: Float32[np.ndarray, "verts 3"], before: int, index: int
    ) -> Float64[np.ndarray, "verts 3"]:
        """Vertices of frame `before` in the pose of frame `index`, with their offsets from the skinned template."""
        rest, flagged = unskin(
            vertices.astype(np.float64), self.skin_weights, pose_frame(self.shaped, self.poses, before).transforms
        )
        offset = np.where(flagged[:, None], 0.0, rest - self.rest)
        transforms = pose_frame(self.shaped, self.poses, index).transforms
        return skin(self.rest + offset, self.skin_weights, transforms)


def segments(mover: Mover | None, frames: int, config: SequenceConfig) -> list[range]:
    """The take cut at its keyframes, as positions; every segment begins with one.

    A keyframe is the frame nearest to the rest pose among its neighbours, near enough for the skinned template, and at
    least `config.segment` frames after the one before. Without poses there is one segment.
    """
    starts = [0]
    if mover is not None:
        bend = mover.bend_deg()
        reach = max(config.segment // 4, 1)
        for position in range(1, frames):
            around = bend[max(position - reach, 0) : position + reach + 1]
            if (
                position - starts[-1] >= config.segment
                and frames - position >= config.segment // 2
                and bend[position] <= min(config.keyframe_bend_deg, float(around.min()))
            ):
                starts.append(position)
    return [range(start, end) for start, end in pairwise([*starts, frames])]


def register_run(
    analysis: TemplateAnalysis,
    mover: Mover | None,
    positions: Sequence[int],
    frame_ids: Sequence[int],
    *,
    load: Callable[[int], GarmentScan],
    done: Callable[[int], tuple[np.ndarray, bool] | None],
    config: RegistrationConfig,
) -> Iterator[FrameResult]:
    """Register frames one from the other; yields those that were not done before.

    Args:
        positions: of the frames in the take, ascending.
        frame_ids: of the whole take.
        load: the garment scan of a frame; may raise InputError, which flags the frame.
        done: vertices of a frame that was finished earlier and whether they may be built upon, or None.
    Raises:
        UnknownBorderError: paints are named after loops that the template lacks.
    """
    before: tuple[np.ndarray, int] | None = None
    for position in positions:
        frame_id = frame_ids[position]
        earlier = done(frame_id)
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
    begin = time.process_time()
    candidates = _predictions(analysis, mover, index, before, config)
    name, start = next(iter(candidates.items()))
    try:
        scan = prepare_frame(analysis, load(frame_id), config)
        name, start, schedule = _choose(analysis, scan, candidates, before is None, config)
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
        if mover is not None:
            found["carried"] = mover.carried(vertices, at, index)
        found["previous"] = vertices.astype(np.float64)
    if mover is not None and (start != "previous" or not found):
        found["skinned"] = mover.skinned(index)
    return found or {"template": analysis.rest}


def _choose(
    analysis: TemplateAnalysis,
    scan: FrameScan,
    candidates: Mapping[str, np.ndarray],
    distant: bool,
    config: RegistrationConfig,
) -> tuple[str, np.ndarray, Literal["cold", "warm"]]:
    """The prediction nearest to the scan, and whether it is near enough for the warm schedule."""
    subset = analysis.coarse_vertices
    misfits = {name: _distances(scan, vertices[subset]) for name, vertices in candidates.items()}
    if "carried" in candidates and "previous" in candidates:
        blended = _blend(analysis, candidates, misfits, config.sequence.relax)
        others = {name: vertices for name, vertices in candidates.items() if name not in ("carried", "previous")}
        candidates = {**others, "blended": blended}
        misfits["blended"] = _distances(scan, blended[subset])
    median = {name: float(np.median(misfits[name])) for name in candidates}
    name = min(median, key=lambda key: median[key])
    near = max(config.sequence.cold_above, COLD_SPACINGS * scan.surface.spacing)
    return name, candidates[name], "cold" if distant or median[name] > near else "warm"


def _distances(scan: FrameScan, points: np.ndarray) -> np.ndarray:
    """To the nearest scan vertex, metres, at most the reach of a blend."""
    return np.minimum(scan.surface.grid.query(points, BLEND_REACH)[0], BLEND_REACH)


def _blend(
    analysis: TemplateAnalysis, candidates: Mapping[str, np.ndarray], misfits: Mapping[str, np.ndarray], relax: float
) -> Float64[np.ndarray, "verts 3"]:
    """The frame before, carried and as it lay, and a little of the skinned pose; smooth over the template.

    Sleeves follow the arms, a hem lags behind a twist and slides: where a prediction is off, its distance to the scan
    tells. The skinned pose knows nothing of how the cloth has slid, but it does not drift either: where it fits as
    well, cloth whose sliding no fold betrays returns to it within tens of frames. Shares are trust over squared misfit,
    averaged at the nodes of the deformation graph and spread to their vertices.
    """
    nodes, weights = analysis.graph.vertex_nodes, analysis.graph.vertex_weights
    subset, count = analysis.coarse_vertices, len(analysis.graph.nodes)
    near, given = nodes[subset].reshape(-1), weights[subset]
    total = np.maximum(np.bincount(near, given.reshape(-1), minlength=count), 1e-12)

    def worth(name: str, trust: float) -> np.ndarray:
        spread = np.bincount(near, (given * misfits[name][:, None] ** 2).reshape(-1), minlength=count)
        return trust / (spread / total + BLEND_FLOOR**2)

    trusts = {"carried": 1.0, "previous": 1.0, "skinned": relax}
    names = [name for name in trusts if name in candidates]
    worths = np.stack([worth(name, trusts[name]) for name in names])
    shares = np.einsum("vk,pvk->pv", weights, (worths / worths.sum(axis=0))[:, nodes])
    return np.einsum("pv,pvc->vc", shares, np.stack([candidates[name] for name in names]))
