"""A skinned body fitted to the points of one scan: point-to-plane Gauss-Newton on pose and shape.

Points on skin and suit pull the body to them from both sides. Points on the garment push from outside only: the body
must stay inside the cloth, and how far inside the scan does not say; where cloth nearly touches it also pulls a little,
for it rests on shoulders and back. Far and contradicting points lose their weight (Geman-McClure), priors decide what
no point decides.

Letters as in `body_tracking_jacobian`. Weights are inverse variances: a term of 1 is one standard deviation.

References: cloth term as in Zhang et al., Detailed, Accurate, Human Shape Estimation from Clothed 3D Scan Sequences
(CVPR 2017), eq. 5, one-sided and without its texture terms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.linalg import cho_factor, cho_solve

from capture4d.body.posed_surface import BodyState, Matches, TrackedBody, match, normal_equations, pose_surface
from capture4d.captures.points.scan_points import ScanPoints, subsample
from capture4d.tracking.config import FitConfig, Schedule
from capture4d.tracking.joint_prior import JointPrior, limit_terms, pull_terms

__all__ = ["Expectation", "Fit", "fit_body"]

WHOLE_STEPS = 3
"""Last steps of a fit that look at all points. With one or two, joints were 2 to 3 % farther off (docs/notebook)."""


@dataclass(frozen=True, slots=True, eq=False)
class Expectation:
    """Where the motion leads, and what earlier frames say about the shape."""

    rotations: Float64[np.ndarray, "joints 3 3"] | None = None
    spread: Float64[np.ndarray, " joints"] | None = None
    """Of the rotations, radians."""
    shape_information: Float64[np.ndarray, "shapes shapes"] | None = None
    """Inverse covariance of the shape about `shape`."""
    shape: Float64[np.ndarray, " shapes"] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fitted frame."""

    state: BodyState
    distances: Float64[np.ndarray, " points"]
    """Metres: signed along the body's normal, of the points whose normals agree; NaN for the others."""
    information: Float64[np.ndarray, "parameters parameters"]
    """Normal equations at the end."""

    def shape_information(self) -> Float64[np.ndarray, "shapes shapes"]:
        """What the frame says about the shape once its pose is eliminated (Schur complement)."""
        pose = 3 + 3 * len(self.state.rotations)
        corner = self.information[:pose, pose:]
        inner = cho_solve(cho_factor(self.information[:pose, :pose]), corner)
        return self.information[pose:, pose:] - corner.T @ inner


def fit_body(
    model: TrackedBody,
    prior: JointPrior,
    scan: ScanPoints,
    start: BodyState,
    *,
    schedule: Schedule,
    config: FitConfig,
    expectation: Expectation | None = None,
    fixed_shape: bool = False,
) -> Fit:
    """Fit pose and shape to a scan.

    Args:
        start: within the reach of the schedule's first scale; see `body_cold_start` for when nothing is known.
        fixed_shape: keep the start's shape.
    """
    expectation = expectation or Expectation()
    state, pose = start, 3 + 3 * len(start.rotations)
    size = pose if fixed_shape else pose + len(start.shape)
    information, distances = np.zeros((size, size)), np.zeros(0)
    ratio = schedule.last_scale_m / schedule.first_scale_m
    damping = np.full(size, 1 / config.shape_step**2)
    damping[:pose] = 1 / config.turn_step**2
    few, settled = subsample(scan, config.few_points), False
    for step in range(schedule.iterations):
        whole = settled or step >= schedule.iterations - WHOLE_STEPS
        looked_at = scan if whole else few
        scale = schedule.first_scale_m * ratio ** (step / max(schedule.iterations - 1, 1))
        surface = pose_surface(model, state)
        matches = match(surface, looked_at.points, looked_at.normals)
        residual, weight, distances = _weigh(looked_at, matches, scale, config)
        information, descent = _prior_terms(state, prior, expectation, config, size)
        seen, pull = normal_equations(surface, matches, weight, residual, with_shape=not fixed_shape)
        information += seen
        change = cho_solve(cho_factor(information + np.diag(damping)), descent + pull)
        state = state.moved(change)
        settled = _largest_motion(model, change) < schedule.stop_m
        if settled and looked_at is scan:
            break
    return Fit(state, distances, information)


def _weigh(
    scan: ScanPoints, matches: Matches, scale: float, config: FitConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals along the body's normals, their weights, and signed distances."""
    away = scan.points - matches.points
    along = np.einsum("na,na->n", away, matches.normals)
    agree = np.einsum("na,na->n", scan.normals, matches.normals) > config.normal_cosine
    residual = np.where(scan.cloth, along - config.cloth_gap_m, along)
    robust = (scale**2 / (scale**2 + (away**2).sum(axis=1))) ** 2
    reach = config.cloth_pull_reach_m
    pull = config.cloth_pull * (reach**2 / (reach**2 + residual**2)) ** 2
    robust = np.where(scan.cloth & (residual > 0), pull, robust)
    uncertain = config.point_sigma_m**2 + (config.mismatch * scale) ** 2
    weight = np.where(agree, robust, 0.0) / uncertain
    return residual, weight, np.where(agree, along, np.nan)


def _prior_terms(
    state: BodyState, prior: JointPrior, expectation: Expectation, config: FitConfig, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of everything that is no point."""
    joints, shapes = len(state.rotations), len(state.shape)
    blocks, turns = pull_terms(state.rotations, np.repeat(np.eye(3)[None], joints, axis=0), prior.spread)
    terms = [limit_terms(state.rotations, prior, np.radians(config.limit_softness_deg))]
    if expectation.rotations is not None and expectation.spread is not None:
        terms.append(pull_terms(state.rotations, expectation.rotations, expectation.spread))
    for more_blocks, more_turns in terms:
        blocks, turns = blocks + more_blocks, turns + more_turns
    information, descent = np.zeros((size, size)), np.zeros(size)
    information[range(3), range(3)] = 1e-3
    for joint in range(joints):
        at = slice(3 + 3 * joint, 6 + 3 * joint)
        information[at, at] = blocks[joint]
    descent[3 : 3 + 3 * joints] = turns.ravel()
    if size > 3 + 3 * joints:
        at = slice(3 + 3 * joints, None)
        information[at, at] = np.eye(shapes) / config.shape_spread**2
        descent[at] = -state.shape / config.shape_spread**2
        if expectation.shape is not None and expectation.shape_information is not None:
            information[at, at] += expectation.shape_information
            descent[at] += expectation.shape_information @ (expectation.shape - state.shape)
    return information, descent


def _largest_motion(model: TrackedBody, change: np.ndarray) -> float:
    """About how far a step moves anything, metres: a turn moves what is half a metre away."""
    joints = len(model.body.joint_names)
    turns = np.linalg.norm(change[3 : 3 + 3 * joints].reshape(joints, 3), axis=1)
    shape = np.abs(change[3 + 3 * joints :]).max(initial=0.0)
    return float(max(np.linalg.norm(change[:3]), 0.5 * turns.max(), 0.03 * shape))
