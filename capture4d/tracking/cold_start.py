"""The pose of a scan of which nothing is known: many starts, few survivors.

Gauss-Newton finds the next pose from the last one, not from nowhere: an arm that starts on the wrong side of the trunk
stays there. So the search tries facings all round with a few arm poses on some hundred points, keeps the best, then
tries other poses of each leg and each arm on those, and fits the winners in full. What is compared is how far scan and
body are from each other, both ways: a scan point that no body explains counts, and so does a body part where nothing
was scanned.

Until the winners are fitted the shape keeps near the mean one. Free from the start, it bends the back of one person
into the front of a stranger one, and the right facing loses before its limbs are in place. If the winner still leaves
much unexplained, its limbs are tried once more, now that trunk and shape are known.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from capture4d.body.posed_surface import BodyState, TrackedBody, match, pose_surface, tracked_body
from capture4d.body.skinning import with_pose, with_shape
from capture4d.captures.points.scan_points import ScanPoints, subsample
from capture4d.tracking.config import ColdStartConfig, FitConfig, Schedule
from capture4d.tracking.fit import Fit, fit_body
from capture4d.tracking.joint_prior import JointPrior
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
LEG_POSES_DEG = ((35.0, 50.0), (75.0, 90.0), (-15.0, 45.0), (5.0, 80.0))
"""Flexion of hip and knee of a leg in motion: a step, a leap, a leg left behind, a heel that is raised."""
MEDIAN_COST = 4.0
"""What the median distance on skin and suit counts against the misfit: 0.8 mm where the pose is right, above 3 where
front and back are exchanged, with misfits of 8 and 14."""
SHAPE_COST_M = 0.0015
"""Misfit that one standard deviation of one shape coefficient is worth."""
DISTINCT_M = 0.12
"""Two poses that differ by less than this at every joint are one: so far a fit settles by itself."""
COARSE_SAMPLES = 2500
"""Surface samples of the body while the search is on."""
LIMB_SPREAD = 0.5
"""Joints of a smaller spread, radians, are no limbs' and stay nearly at rest while the search is on: a head that turns
freely before the trunk is in place ends up facing backwards."""


@dataclass(frozen=True, slots=True, eq=False)
class _Leg:
    hip: int
    knee: int
    axis: Float64[np.ndarray, "3"]
    """The knee's hinge."""
    side: float
    """+1 left, -1 right."""


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


_Variants = Callable[[BodyState], Iterable[BodyState]]
_Ranked = tuple[float, BodyState]
"""Misfit in metres, and the state that has it."""


def find_pose(
    model: TrackedBody, prior: JointPrior, scan: ScanPoints, *, config: ColdStartConfig, fit: FitConfig
) -> tuple[Fit, float]:
    """Fit a body to a scan without a start.

    Returns:
        The best fit, and its mean misfit in metres (see `misfit`).
    """
    search = _Search.create(model, prior, scan, config, fit)
    starts = _upright_starts(model, scan, search.arms, config.facings)
    found = search.distinct(search.settle(starts, config.rough), config.survivors)
    best = search.finish(search.follow_up(found))
    if best.misfit_m > config.second_round_m:
        # trunk and shape are mostly right by now, which the limbs of the first round could not know
        again = search.finish(search.follow_up([(best.misfit_m, best.fit.state)], keep_shape=True))
        best = min(best, again, key=lambda each: each.cost_m)
    return best.fit, best.misfit_m


@dataclass(frozen=True, slots=True, eq=False)
class _Finalist:
    fit: Fit
    misfit_m: float
    cost_m: float


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """What all steps of one search share."""

    model: TrackedBody
    coarse: TrackedBody
    prior: JointPrior
    stiff: JointPrior
    scan: ScanPoints
    few: ScanPoints
    tree: KDTree
    config: ColdStartConfig
    fit: FitConfig
    cautious: FitConfig
    """Holds the shape back."""
    arms: list[_Arm]
    legs: list[_Leg]

    @staticmethod
    def create(
        model: TrackedBody, prior: JointPrior, scan: ScanPoints, config: ColdStartConfig, fit: FitConfig
    ) -> _Search:
        return _Search(
            model,
            tracked_body(model.body, samples=COARSE_SAMPLES),
            prior,
            replace(prior, spread=np.where(prior.spread < LIMB_SPREAD, prior.spread / 4, prior.spread)),
            scan,
            subsample(scan, config.points),
            KDTree(scan.points),
            config,
            fit,
            replace(fit, shape_spread=config.shape_spread),
            _arms(model.body, prior),
            _legs(model.body, prior),
        )

    def settle(self, starts: Iterable[BodyState], schedule: Schedule, *, keep_shape: bool = False) -> list[_Ranked]:
        """Fit every start to a few points; the best first."""
        fits = [
            fit_body(
                self.coarse, self.stiff, self.few, start,
                schedule=schedule, config=self.cautious, fixed_shape=keep_shape,
            ).state
            for start in starts
        ]  # fmt: skip
        return _ranked((misfit(self.coarse, self.few, self.tree, state), state) for state in fits)

    def distinct(self, ranked: list[_Ranked], count: int) -> list[_Ranked]:
        return _distinct(self.model.body, ranked, count)

    def follow_up(self, found: list[_Ranked], *, keep_shape: bool = False) -> list[_Ranked]:
        """Try other poses of one limb after the other."""
        variants: list[_Variants] = [partial(_legs_apart, self.legs)] if self.legs else []
        variants += [partial(_leg_variants, leg) for leg in self.legs]
        variants += [partial(_arm_variants, arm) for arm in self.arms]
        for vary in variants:
            tried = (variant for _, state in found for variant in vary(state))
            settled = self.settle(tried, self.config.limbs, keep_shape=keep_shape)
            count = max(self.config.survivors - 2, self.config.finalists)
            found = self.distinct(_ranked([*found, *settled]), count)
        return found

    def finish(self, found: list[_Ranked]) -> _Finalist:
        """Fit the best few to all points, the shape held back at first; the best of them."""
        finalists = []
        for _, start in self.distinct(found, self.config.finalists):
            settled = self._full(start, self.config.settle, self.cautious).state
            fit = self._full(settled, self.config.full, self.fit)
            far = misfit(self.model, self.scan, self.tree, fit.state)
            finalists.append(_Finalist(fit, far, far + MEDIAN_COST * _median_distance(fit, self.scan)))
        return min(finalists, key=lambda each: each.cost_m)

    def _full(self, start: BodyState, schedule: Schedule, config: FitConfig) -> Fit:
        return fit_body(self.model, self.prior, self.scan, start, schedule=schedule, config=config)


def _ranked(found: Iterable[_Ranked]) -> list[_Ranked]:
    return sorted(found, key=lambda each: each[0])


def _median_distance(fit: Fit, scan: ScanPoints) -> float:
    """Between skin or suit and body, metres; points whose normals disagree are as far as any."""
    bare = np.abs(fit.distances[~scan.cloth]) if (~scan.cloth).any() else np.abs(fit.distances)
    return float(np.median(np.where(np.isnan(bare), np.nanmax(bare, initial=0.0), bare)))


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


def _arm_variants(arm: _Arm, state: BodyState) -> Iterable[BodyState]:
    return (_with_arm(state, arm, direction, bend) for direction in ARM_DIRECTIONS for bend in ELBOW_BENDS_DEG[:2])


def _legs_apart(legs: list[_Leg], state: BodyState) -> Iterable[BodyState]:
    """Both legs anew, straight and astride: crossed, each lies in the other's place and stays there."""
    for spread in (0.0, 20.0):
        variant = state
        for leg in legs:
            variant = _with_leg(variant, leg, 0.0, 0.0, spread)
        yield variant


def _leg_variants(leg: _Leg, state: BodyState) -> Iterable[BodyState]:
    return (_with_leg(state, leg, *degrees) for degrees in LEG_POSES_DEG)


def _with_leg(state: BodyState, leg: _Leg, flexion_deg: float, bend_deg: float, spread_deg: float = 0.0) -> BodyState:
    """Another pose of one leg, the rest as it is."""
    rotations = state.rotations.copy()
    rotations[leg.hip] = Rotation.from_euler("xz", (-flexion_deg, leg.side * spread_deg), degrees=True).as_matrix()
    rotations[leg.knee] = Rotation.from_rotvec(np.radians(bend_deg) * leg.axis).as_matrix()
    return replace(state, rotations=rotations)


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
        shoulder = _above(body, elbow)
        along = body.joints[elbow].astype(np.float64) - body.joints[shoulder]
        bend = float(-prior.hinge_ranges[elbow, 0] + np.radians(-12.0))
        side = float(np.sign(body.joints[elbow, 0]))
        arms.append(_Arm(shoulder, elbow, prior.hinge_axes[elbow], along / np.linalg.norm(along), bend, side))
    return arms


def _legs(body: Body, prior: JointPrior) -> list[_Leg]:
    """The legs, likewise."""
    return [
        _Leg(_above(body, knee), knee, prior.hinge_axes[knee], float(np.sign(body.joints[knee, 0])))
        for knee, name in enumerate(body.joint_names)
        if re.search(r"lowerleg01|knee", name) and prior.hinge_axes[knee].any()
    ]


def _above(body: Body, joint: int) -> int:
    """The joint at which the limb above begins: its twist bones are passed over."""
    above = int(body.parents[joint])
    while re.search(r"02", body.joint_names[above]):
        above = int(body.parents[above])
    return above


def _distinct(body: Body, ranked: list[_Ranked], count: int) -> list[_Ranked]:
    """The best few that differ from each other.

    A third of the places is for bodies that face away from the best one: front and back look much alike from afar.
    """
    kept: list[_Ranked] = []
    places: list[np.ndarray] = []
    away = 0
    for score, state in ranked:
        centres = _centres(body, state)
        if not all(np.linalg.norm(centres - other, axis=1).max() > DISTINCT_M for other in places):
            continue
        opposed = bool(kept) and float(state.rotations[0, :, 2] @ kept[0][1].rotations[0, :, 2]) < 0
        if not opposed and len(kept) - away >= count - max(count // 3, 1):
            continue
        kept.append((score, state))
        places.append(centres)
        away += opposed
        if len(kept) == count:
            break
    return kept


def _centres(body: Body, state: BodyState) -> Float64[np.ndarray, "joints 3"]:
    """World joint positions."""
    return with_pose(with_shape(body, state.shape), state.rotations, state.translation).joint_centres()
