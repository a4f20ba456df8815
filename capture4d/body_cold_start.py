"""The pose of a scan of which nothing is known: many starts, few survivors.

Gauss-Newton finds the next pose from the last one, not from nowhere: an arm that starts on the wrong side of the trunk
stays there. So the search tries facings all round with a few arm poses on some hundred points, keeps the best, then
tries other poses of each arm on those, and fits the winners in full. What is compared is how far scan and body are from
each other, both ways: a scan point that no body explains counts, and so does a body part where nothing was scanned.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from capture4d.body_prior import JointPrior
from capture4d.body_tracking import Fit, ScanPoints, fit_body, subsample
from capture4d.body_tracking_config import ColdStartConfig, FitConfig, Schedule
from capture4d.body_tracking_jacobian import BodyState, TrackedBody, match, pose_surface, tracked_body
from capture4d.types import Body

__all__ = ["find_pose", "misfit"]

ARM_DIRECTIONS = (
    (0.30, -0.95, 0.05),
    (0.70, -0.70, 0.10),
    (1.00, 0.00, 0.10),
    (0.60, 0.80, 0.00),
    (0.30, -0.10, 0.95),
    (0.45, -0.75, 0.50),
    (0.70, 0.00, 0.70),
    (0.40, 0.65, 0.65),
    (0.60, -0.60, -0.50),
)
"""Where an upper arm may point, for the left arm: hanging, as in an A, sideways, up, to the front, and between."""
ELBOW_BENDS_DEG = (15.0, 60.0, 105.0)
ARMS_TOGETHER = ((0, 0), (1, 0), (2, 0), (3, 0), (4, 0))
"""Arm poses (direction, bend) that the search for the facing tries on both arms at once."""
SHAPE_COST_M = 0.0015
"""Misfit that one standard deviation of one shape coefficient is worth."""
DISTINCT_RAD = 0.35
COARSE_SAMPLES = 2500
"""Surface samples of the body while the search is on."""
LIMB_SPREAD = 0.5
"""Joints of a smaller spread, radians, are no limbs' and stay nearly at rest while the search is on: a head that turns
freely before the trunk is in place ends up facing backwards."""


@dataclass(frozen=True, slots=True, eq=False)
class _Arm:
    shoulder: int
    elbow: int
    axis: Float64[np.ndarray, "3"]
    """The elbow's hinge."""
    rest_direction: Float64[np.ndarray, "3"]
    rest_bend: float
    side: float
    """+1 left, -1 right."""


def find_pose(
    model: TrackedBody, prior: JointPrior, scan: ScanPoints, *, config: ColdStartConfig, fit: FitConfig
) -> tuple[Fit, float]:
    """Fit a body to a scan without a start.

    Returns:
        The best fit, and its mean misfit in metres (see `misfit`).
    """
    coarse = tracked_body(model.body, samples=COARSE_SAMPLES)
    stiff = replace(prior, spread=np.where(prior.spread < LIMB_SPREAD, prior.spread / 4, prior.spread))
    few = subsample(scan, config.points)
    tree = KDTree(scan.points)
    arms = _arms(model.body, prior)

    def settle(starts: Iterable[BodyState], schedule: Schedule) -> list[tuple[float, BodyState]]:
        fits = [fit_body(coarse, stiff, few, start, schedule=schedule, config=fit).state for start in starts]
        return sorted(((misfit(coarse, few, tree, state), state) for state in fits), key=lambda each: each[0])

    found = _distinct(settle(_upright_starts(model, scan, arms, config.facings), config.rough), config.survivors)
    for arm in arms:
        starts = [_with_arm(state, arm, direction, bend) for _, state in found for direction, bend in _arm_poses()]
        kept = max(config.survivors - 2, config.finalists)
        found = _distinct(sorted(found + settle(starts, config.arms), key=lambda each: each[0]), kept)
    fits = [
        fit_body(model, prior, scan, state, schedule=config.full, config=fit)
        for _, state in _distinct(found, config.finalists)
    ]
    scored = [(misfit(model, scan, tree, each.state), each) for each in fits]
    best = min(range(len(scored)), key=lambda index: scored[index][0])
    return scored[best][1], scored[best][0]


def misfit(
    model: TrackedBody, scan: ScanPoints, tree: KDTree, state: BodyState, *, far_m: float = 0.12, slack_m: float = 0.05
) -> float:
    """Root mean square distance between scan and body, metres; distances beyond `far_m` count as that.

    Cloth may hang `slack_m` outside of the body at no cost, and body parts need not be scanned where they are hidden,
    so the way from body to scan counts a third. An unlikely shape counts as a misfit: the back of one person can be
    made to look like the front of a stranger one.
    """
    surface = pose_surface(model, state)
    matches = match(surface, scan.points, scan.normals, faces=1)
    away = scan.points - matches.points
    distance = np.linalg.norm(away, axis=1)
    outside = np.einsum("na,na->n", away, matches.normals) > 0
    opposed = np.einsum("na,na->n", scan.normals, matches.normals) < 0
    distance = np.where(scan.cloth & outside, np.maximum(distance - slack_m, 0), distance)
    there = np.where(opposed, far_m, np.minimum(distance, far_m))
    corners = model.body.template.faces[model.sample_faces[::3]]
    samples = (surface.vertices[corners] * model.sample_barycentric[::3, :, None]).sum(axis=1)
    low, high = scan.points.min(axis=0), scan.points.max(axis=0)
    inside = ((samples > low - far_m) & (samples < high + far_m)).all(axis=1)
    back = np.minimum(tree.query(samples[inside])[0], far_m)
    back = np.maximum(back - 0.03, 0)
    unlikely = SHAPE_COST_M**2 * (state.shape**2).sum()
    return float(np.sqrt((there**2).mean() + (back**2).sum() / max(len(samples), 1) / 3 + unlikely))


def _upright_starts(model: TrackedBody, scan: ScanPoints, arms: list[_Arm], facings: int) -> list[BodyState]:
    """Standing on the floor amid the scan, facing all round, in a few symmetric arm poses."""
    trunk = scan.points[scan.cloth] if scan.cloth.sum() > 100 else scan.points
    middle = np.median(trunk, axis=0)
    root = model.body.joints[0].astype(np.float64)
    starts = []
    for direction, bend in ARMS_TOGETHER if arms else ((0, 0),):
        state = model.rest_state()
        for arm in arms:
            state = _with_arm(state, arm, ARM_DIRECTIONS[direction], ELBOW_BENDS_DEG[bend])
        for facing in range(facings):
            rotations = state.rotations.copy()
            rotations[0] = Rotation.from_euler("y", 360 * facing / facings, degrees=True).as_matrix()
            starts.append(replace(state, rotations=rotations, translation=(middle - root) * (1.0, 0.0, 1.0)))
    return starts


def _arm_poses() -> list[tuple[tuple[float, float, float], float]]:
    return [(direction, bend) for direction in ARM_DIRECTIONS for bend in ELBOW_BENDS_DEG[:2]]


def _with_arm(state: BodyState, arm: _Arm, direction: tuple[float, float, float], bend_deg: float) -> BodyState:
    """Another pose of one arm, the rest as it is; the direction is the trunk's, for a left arm."""
    wanted = np.array(direction) * (arm.side, 1, 1)
    rotations = state.rotations.copy()
    rotations[arm.shoulder] = Rotation.align_vectors(wanted[None], arm.rest_direction[None])[0].as_matrix()
    rotations[arm.elbow] = Rotation.from_rotvec((np.radians(bend_deg) - arm.rest_bend) * arm.axis).as_matrix()
    return replace(state, rotations=rotations)


def _arms(body: Body, prior: JointPrior) -> list[_Arm]:
    """The arms of a body whose joints are named so that they can be found; else none."""
    arms = []
    for elbow, name in enumerate(body.joint_names):
        if not re.search(r"lowerarm01|elbow", name) or not prior.hinge_axes[elbow].any():
            continue
        shoulder = int(body.parents[elbow])
        while re.search(r"02", body.joint_names[shoulder]):
            shoulder = int(body.parents[shoulder])
        along = body.joints[elbow].astype(np.float64) - body.joints[shoulder]
        bend = float(-prior.hinge_ranges[elbow, 0] + np.radians(-12.0))
        side = float(np.sign(body.joints[elbow, 0]))
        arms.append(_Arm(shoulder, elbow, prior.hinge_axes[elbow], along / np.linalg.norm(along), bend, side))
    return arms


def _distinct(ranked: list[tuple[float, BodyState]], count: int) -> list[tuple[float, BodyState]]:
    """The best few that differ from each other by more than an iteration would settle.

    A third of the places is for bodies that face away from the best one: front and back look much alike from afar.
    """
    kept: list[tuple[float, BodyState]] = []
    away = 0
    for score, state in ranked:
        turns = [state.rotations @ other.rotations.swapaxes(1, 2) for _, other in kept]
        if not all(Rotation.from_matrix(turn).magnitude().max() > DISTINCT_RAD for turn in turns):
            continue
        opposed = bool(kept) and float(state.rotations[0, :, 2] @ kept[0][1].rotations[0, :, 2]) < 0
        if not opposed and len(kept) - away >= count - max(count // 3, 1):
            continue
        kept.append((score, state))
        away += opposed
        if len(kept) == count:
            break
    return kept
