"""Where a frame's registration may start from, and which start is taken.

There are up to three predictions of a frame:

    carried    the frame before, taken to the rest pose by inverse skinning and skinned to this frame's pose
    previous   the frame before as it is
    skinned    the template skinned to this frame's pose

Sleeves follow the arms while a hem lags behind, so carried and previous are blended, node by node, by their distance to
the scan. The start is the blend or the skinned template, whichever lies nearer. Where the blended skinning matrix is
near singular its inverse means nothing, and the vertex keeps its template offset. Without poses each frame starts from
the one before, and the first from the template as it lies.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64, Int32

from capture4d.body.skinning import ShapedBody, pose_frame, skin, unskin, with_shape
from capture4d.errors import InputError
from capture4d.types import Body, PoseSequence
from registration.config import RegistrationConfig
from registration.regions import find_regions
from registration.register import FrameScan
from registration.template import TemplateAnalysis

__all__ = ["Mover", "bent_away", "blend", "choose", "misfit", "predict"]


BLEND_FLOOR, BLEND_REACH = 0.002, 0.1
"""Metres: below the floor two predictions fit equally well; beyond the reach one is as bad as another."""


COLD_SPACINGS = 1.3
"""Distances below so many sample spacings of a scan say nothing about how far off a start is."""


@dataclass(frozen=True, slots=True, eq=False)
class Mover:
    """The body under the garment, as far as registration needs it: where the template goes in each pose."""

    shaped: ShapedBody
    poses: PoseSequence
    rest: Float64[np.ndarray, "verts 3"]
    skin_weights: Float32[np.ndarray, "verts joints"]
    regions: Mapping[str, Int32[np.ndarray, " region"]]
    """Of the template, by which limbs carry it."""

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
        regions = find_regions(analysis.garment, body.joint_names)
        return Mover(with_shape(body, poses.shape), poses, analysis.rest, weights, regions)

    def skinned(self, index: int) -> Float64[np.ndarray, "verts 3"]:
        """The template in the pose of the index-th frame."""
        return skin(self.rest, self.skin_weights, pose_frame(self.shaped, self.poses, index).transforms)

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


def bent_away(
    skin_weights: Float32[np.ndarray, "verts joints"], body: Body, poses: PoseSequence
) -> Float64[np.ndarray, " frames"]:
    """How far each pose is from that of the template, radians: all joints but the root, by the cloth that they carry.

    A joint carries the cloth of the joints behind it, too. The farther, the more the skinned template is off: on a take
    of a T-shirt, registration from it errs by 2 to 3 mm near the pose of the template, and by 6 with arms overhead.
    """
    carried = skin_weights.astype(np.float64).mean(axis=0)
    for joint in range(len(carried) - 1, 0, -1):
        carried[body.parents[joint]] += carried[joint]
    cosines = (np.trace(poses.rotations, axis1=2, axis2=3) - 1.0) / 2.0
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    return np.sqrt(angles[:, 1:] ** 2 @ carried[1:])


def predict(
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


def choose(
    analysis: TemplateAnalysis,
    scan: FrameScan,
    candidates: Mapping[str, np.ndarray],
    *,
    distant: bool,
    config: RegistrationConfig,
) -> tuple[str, np.ndarray, Literal["cold", "warm"]]:
    """The prediction nearest to the scan, and whether it is near enough for the warm schedule.

    Args:
        distant: the scan is far from what was registered before it, or nothing was.
    """
    subset = analysis.coarse_vertices
    misfits = {name: misfit(scan, vertices[subset]) for name, vertices in candidates.items()}
    if "carried" in candidates and "previous" in candidates:
        blended = blend(analysis, candidates, misfits, config.sequence.relax)
        others = {name: vertices for name, vertices in candidates.items() if name not in ("carried", "previous")}
        candidates = {**others, "blended": blended}
        misfits["blended"] = misfit(scan, blended[subset])
    median = {name: float(np.median(misfits[name])) for name in candidates}
    name = min(median, key=lambda key: median[key])
    near = max(config.sequence.cold_above, COLD_SPACINGS * scan.surface.spacing)
    return name, candidates[name], "cold" if distant or median[name] > near else "warm"


def misfit(scan: FrameScan, points: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, " points"]:
    """Distance to the nearest scan vertex, metres, at most the reach of a blend."""
    return np.minimum(scan.surface.grid.query(points, BLEND_REACH)[0], BLEND_REACH)


def blend(
    analysis: TemplateAnalysis, candidates: Mapping[str, np.ndarray], misfits: Mapping[str, np.ndarray], relax: float
) -> Float64[np.ndarray, "verts 3"]:
    """The frame before, carried and as it lay, and a little of the skinned pose; smooth over the template.

    Sleeves follow the arms, a hem lags behind a twist and slides: where a prediction is off, its distance to the scan
    tells. The skinned pose knows nothing of how the cloth has slid, but it does not drift either: where it fits as
    well, cloth whose sliding no fold betrays returns to it within tens of frames. Shares are trust over squared misfit,
    averaged at the nodes of the deformation graph and spread to their vertices.

    Args:
        misfits: of each candidate's coarse vertices.
        relax: trust in the skinned pose, relative to the others.
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
