"""A take, frame after frame: follow the body, then refine every frame with the one shape of the take.

The first pass goes forwards. Each frame starts where the last motion leads, and what frames say about the shape adds up
(each one's information about the shape, its pose eliminated), so that the shape settles within a second of footage. A
frame that fits badly is tried again from farther away, then searched for afresh; one that still fits badly is flagged,
keeps the pose of the last good one, and the take goes on.

The second pass knows the shape, and both neighbours of a frame: it needs no order. Lost frames start between the
nearest good ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from capture4d.body.posed_surface import BodyState, TrackedBody, match, pose_surface, tracked_body
from capture4d.body.skinning import with_pose, with_shape
from capture4d.captures.points.scan_points import ScanPoints
from capture4d.tracking.cold_start import find_pose
from capture4d.tracking.config import Schedule, SequenceConfig, TrackingConfig
from capture4d.tracking.fit import Expectation, Fit, fit_body
from capture4d.tracking.joint_prior import JointPrior, joint_prior
from capture4d.types import Body

__all__ = [
    "NOTHING",
    "Followed",
    "Quality",
    "Refined",
    "Tracker",
    "apart_mm",
    "between",
    "joint_shape",
    "judge",
    "outlying",
]

NOTHING = "nothing"
"""Where frames before the first that can be read start from."""
SEEN_POINTS = 8
"""A joint is seen if so many explained points lie on what it moves itself."""


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
    """How far a frame can be trusted."""

    reasons: tuple[str, ...]
    """Empty for a good frame."""
    lost: bool
    explained: float
    """Share of the points on skin and suit that lie on the body."""
    median_m: float
    """Their median distance from it."""
    inside: float
    """Share of the garment's points that are inside the body."""


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """A frame after the first pass."""

    state: BodyState
    shape_information: Float64[np.ndarray, "shapes shapes"]
    """Of this and all frames before."""
    quality: Quality
    started_from: str
    lost_frames: int
    """Lost ones in a row, this one included."""
    doubtful_frames: int
    """Flagged ones in a row, lost or not."""


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A frame after the second pass."""

    state: BodyState
    quality: Quality
    seen: Bool[np.ndarray, " joints"]
    """Joints whose own part of the body was scanned; the others follow their prior."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracker:
    """A body and settings; frames are values that go in and come out."""

    model: TrackedBody
    prior: JointPrior
    config: TrackingConfig

    @staticmethod
    def create(body: Body, config: TrackingConfig) -> Tracker:
        return Tracker(tracked_body(body), joint_prior(body), config)

    def begin(self, scan: ScanPoints, start: BodyState | None) -> Followed:
        """The first frame: from a start, or from nowhere."""
        if start is None:
            fit, name = self._search(scan), "search"
        else:
            fit, name = self._fit(scan, start, self.config.cold_start.full, Expectation()), "start"
        quality = self._judge(scan, fit)
        shapes = len(fit.state.shape)
        information = np.zeros((shapes, shapes)) if quality.reasons else self._shape_information(fit)
        return Followed(fit.state, information, quality, name, int(quality.lost), int(bool(quality.reasons)))

    def nothing(self, scan: ScanPoints) -> Followed:
        """A frame without points before the first that has some."""
        state, quality = self.model.rest_state(), judge(np.zeros(len(scan.cloth)), scan.cloth, self.config.sequence)
        shapes = len(state.shape)
        return Followed(state, np.zeros((shapes, shapes)), quality, NOTHING, 1, 1)

    def follow(self, scan: ScanPoints, last: Followed, before: Followed | None) -> Followed:
        """The frame after `last`; `before` is the one before that."""
        sequence = self.config.sequence
        expected = _extrapolate(last.state, before.state, sequence.momentum) if before else last.state
        spread = np.full(len(self.prior.spread), sequence.motion_spread * (1 + last.lost_frames))
        expectation = Expectation(expected.rotations, spread, last.shape_information, expected.shape)
        known = replace(expectation, rotations=None, spread=None)
        attempts = [
            ("motion", lambda: self._fit(scan, expected, sequence.follow, expectation)),
            ("last frame", lambda: self._fit(scan, last.state, sequence.retry, known)),
        ]
        if last.doubtful_frames % sequence.search_every == 0:
            attempts.append(("search", lambda: self._search_again(scan, known)))
        enough = np.count_nonzero(~scan.cloth) >= sequence.least_points
        name, fit, quality = self._first_good(scan, attempts if enough else attempts[:1])
        doubtful = last.doubtful_frames + 1 if quality.reasons else 0
        if quality.lost:
            return Followed(last.state, last.shape_information, quality, name, last.lost_frames + 1, doubtful)
        information = last.shape_information if quality.reasons else self._shape_information(fit)
        return Followed(fit.state, information, quality, name, 0, doubtful)

    def refine(
        self, scan: ScanPoints, start: BodyState, around: Sequence[BodyState], *, interval_s: float, lost: bool
    ) -> Refined:
        """A frame with the shape of `start` kept, drawn towards the mean of the frames `around` it, two or none."""
        sequence = self.config.sequence
        expectation = Expectation()
        if len(around) == 2:
            mean = between(around[0], around[1], 0.5)
            expectation = Expectation(
                mean.rotations, np.full(len(self.prior.spread), sequence.acceleration * interval_s**2)
            )
        schedule = sequence.retry if lost else sequence.refine
        fit = fit_body(
            self.model,
            self.prior,
            scan,
            start,
            schedule=schedule,
            config=self.config.fit,
            expectation=expectation,
            fixed_shape=True,
        )
        quality, seen = self._look(scan, fit.state)
        return Refined(start if quality.lost else fit.state, quality, seen)

    def _first_good(
        self, scan: ScanPoints, attempts: Sequence[tuple[str, Callable[[], Fit]]]
    ) -> tuple[str, Fit, Quality]:
        """The first attempt that is not flagged, or else the one that explains most."""
        tried = []
        for name, attempt in attempts:
            fit = attempt()
            tried.append((name, fit, self._judge(scan, fit)))
            if not tried[-1][2].reasons:
                return tried[-1]
        return max(tried, key=lambda each: each[2].explained)

    def _shape_information(self, fit: Fit) -> np.ndarray:
        """What this frame and those before it say; the prior, which every fit adds, is taken out."""
        information = fit.shape_information()
        return self.config.sequence.shape_memory * (
            information - np.eye(len(information)) / self.config.fit.shape_spread**2
        )

    def _search_again(self, scan: ScanPoints, known: Expectation) -> Fit:
        """A search whose result takes up the shape that is known."""
        found = self._search(scan).state
        shape = found.shape if known.shape is None else known.shape
        return self._fit(scan, replace(found, shape=shape), self.config.sequence.retry, known)

    def _search(self, scan: ScanPoints) -> Fit:
        return find_pose(self.model, self.prior, scan, config=self.config.cold_start, fit=self.config.fit)[0]

    def _fit(self, scan: ScanPoints, start: BodyState, schedule: Schedule, expectation: Expectation) -> Fit:
        return fit_body(
            self.model, self.prior, scan, start, schedule=schedule, config=self.config.fit, expectation=expectation
        )

    def _judge(self, scan: ScanPoints, fit: Fit) -> Quality:
        quality = judge(fit.distances, scan.cloth, self.config.sequence)
        largest = float(np.abs(fit.state.shape).max(initial=0.0))
        if largest <= self.config.sequence.largest_shape:
            return quality
        reason = f"a shape coefficient of {largest:.1f} standard deviations"
        return replace(quality, reasons=(*quality.reasons, reason))

    def _look(self, scan: ScanPoints, state: BodyState) -> tuple[Quality, np.ndarray]:
        """Quality of a state, and the joints it was seen by."""
        surface = pose_surface(self.model, state)
        matches = match(surface, scan.points, scan.normals)
        along = np.einsum("na,na->n", scan.points - matches.points, matches.normals)
        agree = np.einsum("na,na->n", scan.normals, matches.normals) > self.config.fit.normal_cosine
        distances = np.where(agree, along, np.nan)
        explained = ~scan.cloth & (np.abs(distances) < self.config.sequence.explained_m)
        corner = self.model.body.template.faces[matches.faces[explained], 0]
        joints = len(self.model.body.joint_names)
        counts = np.bincount(self.model.vertex_joints[corner, 0], minlength=joints)
        return judge(distances, scan.cloth, self.config.sequence), counts >= SEEN_POINTS


def judge(
    distances: Float64[np.ndarray, " points"], cloth: Bool[np.ndarray, " points"], config: SequenceConfig
) -> Quality:
    """Flag a frame by what its body leaves unexplained.

    Args:
        distances: signed, metres, NaN where normals disagree.
    """
    bare = distances[~cloth] if len(distances) else np.zeros(0)
    if len(bare) < config.least_points:
        reason = f"{len(bare)} points on skin and suit, expected at least {config.least_points}"
        return Quality((reason,), True, 0.0, float("nan"), 0.0)
    explained = float((np.abs(bare) < config.explained_m).mean())
    found = np.abs(bare[np.isfinite(bare)])
    median = float(np.median(found)) if len(found) else float("nan")
    inside = float((distances[cloth] < -config.explained_m).mean()) if cloth.any() else 0.0
    reasons = []
    if explained < config.check_explained:
        reasons.append(f"the body explains {100 * explained:.0f} % of skin and suit")
    if median > config.check_median_m:
        reasons.append(f"skin and suit lie {1e3 * median:.1f} mm from the body in the median")
    far = float((np.isnan(bare) | (np.abs(bare) > config.far_m)).mean())
    if far > config.check_far:
        reasons.append(f"{100 * far:.0f} % of skin and suit are far from the body")
    if inside > 1 - config.check_explained:
        reasons.append(f"{100 * inside:.0f} % of the garment lies inside the body")
    return Quality(tuple(reasons), explained < config.fail_explained, explained, median, inside)


def outlying(
    medians_m: Float64[np.ndarray, " frames"], config: SequenceConfig
) -> tuple[float, Bool[np.ndarray, " frames"]]:
    """Frames that lie farther from the body than the take's noise explains.

    Args:
        medians_m: distance on skin and suit in every frame, NaN for frames without.
    Returns:
        What is usual in the take, metres, and which frames exceed it.
    """
    usual = float(np.nanmedian(medians_m)) if np.isfinite(medians_m).any() else 0.0
    return usual, medians_m > max(config.outlier_median * usual, config.least_outlier_m)


def apart_mm(body: Body, first: BodyState, second: BodyState) -> float:
    """How far two poses of a frame are from each other, each with its own shape: mean over the joints, millimetres."""
    places = [
        with_pose(with_shape(body, state.shape), state.rotations, state.translation).joint_centres()
        for state in (first, second)
    ]
    return 1e3 * float(np.linalg.norm(places[1] - places[0], axis=1).mean())


def joint_shape(
    shapes: Sequence[Float64[np.ndarray, " shapes"]],
    information: Sequence[Float64[np.ndarray, "shapes shapes"]],
    prior: float,
) -> Float64[np.ndarray, " shapes"]:
    """The shape that several parts of a take say together.

    Args:
        shapes: the most likely one of each part by itself.
        information: what each part says of it, the prior left out.
        prior: inverse variance of a coefficient before any scan.
    """
    alone = prior * np.eye(len(shapes[0]))
    told = sum((known + alone) @ shape for known, shape in zip(information, shapes, strict=True))
    return np.linalg.solve(sum(information, alone), told)


def between(first: BodyState, second: BodyState, share: float) -> BodyState:
    """The pose a share of the way from one to the other, with the first one's shape."""
    turn = Rotation.from_matrix(second.rotations @ first.rotations.swapaxes(1, 2)).as_rotvec()
    rotations = Rotation.from_rotvec(share * turn).as_matrix() @ first.rotations
    translation = first.translation + share * (second.translation - first.translation)
    return BodyState(rotations, translation, first.shape)


def _extrapolate(last: BodyState, before: BodyState, momentum: float) -> BodyState:
    return replace(between(before, last, 1.0 + momentum), shape=last.shape)
