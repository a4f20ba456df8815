"""What a garment was learned from, and answers that stay within it.

A regressor is believed where it was taught, as far as takes that were left out have shown it right. The distance of two
poses is the root mean square, over the garment's joints, of the angle between their rotations. Farther from every
learned pose than is known to be safe, the regressor is asked about the nearest point that is safe, and its answer fades
towards the garment at rest, which is the template. How the root moves and how the joints turn is judged part by part:
beyond what was learned, a part fades towards its mean, so that what is left is what the pose alone can say.
Coefficients stay within those of the learned frames.

Letters: N learned frames, D controls, K coefficients.
References: DeepWrinkles (ECCV 2018), section 5.3: retargeting works best near the training poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64

from capture4d.captures.animations.known_poses import PoseRange
from capture4d.errors import InputError
from capture4d.files.json_values import number, texts, wholes
from capture4d.files.reading import reading, shortened
from capture4d.files.tensors import TensorFile, read_tensors, write_tensors
from retarget.regression.controls import ControlLayout
from retarget.regression.regressors import Clip, Regressor, Trust, good_frames

__all__ = [
    "BoundedRegressor",
    "CoefficientRange",
    "ControlRange",
    "KnownRange",
    "load_known_range",
    "save_known_range",
]

_KIND = "capture4d known range"
PAIRS = 4_000_000
"""Joint angles that are compared at once."""
MOST_POSES = 1000
"""Learned poses that are kept for a regressor, evenly spread."""
SAFE_DEG = (10.0, 20.0)
"""A pose as near as the first to a learned one is safe, even if no validation frame was as far; one farther than the
second is not, even if such frames validated."""
FADED = 3.0
"""Times the largest motion that was learned, where nothing of it is left."""
FADED_POSES = 2.0
"""Times the safe distance, where nothing of a regressor's answer is left."""
NEAREST_SHARE = 0.15
"""Learned poses count in the nearest safe point as far as they are nearer than this share beyond the nearest: the point
then moves without jumps."""
NUMBERS_OF_A_RADIAN = np.sqrt(4 / 3)
"""Length, on average over axes, of the change of two columns of a rotation matrix, for each radian of a small turn."""
LEAST_MOTION = {"velocity": 0.1, "acceleration": 1.0, "turning": 0.5}
"""Motion that is always taken for known: m/s, m/s^2, rad/s; a hand's breadth at arm's length."""


# --- controls ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ControlRange:
    """The controls of one layout that were learned from."""

    mean: Float32[np.ndarray, " controls"]
    largest: Float32[np.ndarray, " parts"]
    """For each part of the layout, the largest distance of a learned frame from the mean; poses have none, 0."""
    poses: Float32[np.ndarray, "learned poses"]
    """What of the controls of some learned frames is their pose."""
    trust: Trust = field(default_factory=Trust.whole)
    """In the regressor that they drive."""

    @staticmethod
    def of(clips: Sequence[Clip], layout: ControlLayout) -> ControlRange:
        """That of clips, without the history.

        Raises:
            InputError: there are not two good frames.
        """
        controls = good_frames(clips)[0][:, : layout.size].astype(np.float64)
        mean = controls.mean(axis=0)
        largest = [
            max(float(np.linalg.norm(controls[:, part] - mean[part], axis=1).max()), LEAST_MOTION.get(name, 0.0))
            if moves
            else 0.0
            for name, part, moves in layout.parts
        ]
        kept = np.linspace(0, len(controls) - 1, min(len(controls), MOST_POSES)).round().astype(int)
        poses = controls[kept][:, layout.pose_columns]
        return ControlRange(mean.astype(np.float32), np.array(largest, np.float32), poses.astype(np.float32))

    def bounded(
        self, controls: Float[np.ndarray, "frames controls"], layout: ControlLayout, safe_deg: float
    ) -> tuple[Float32[np.ndarray, "frames controls"], Float64[np.ndarray, " frames"]]:
        """Controls that are known, as near as may be to those given; and how far answers can be believed, 0 to 1."""
        found = controls.astype(np.float64)
        for (_, part, moves), largest in zip(layout.parts, self.largest.astype(np.float64), strict=True):
            if moves:
                offset = found[:, part] - self.mean[part]
                length = np.linalg.norm(offset, axis=1) / max(float(largest), 1e-9)
                kept = np.where(length <= 1, 1.0, _fading(length, FADED) / np.maximum(length, 1.0))
                found[:, part] = self.mean[part] + kept[:, None] * offset
        columns = layout.pose_columns
        turned = slice(0, 6 * len(layout.joints))
        anchors, distances = _nearest_points(found[:, columns], self.poses.astype(np.float64), turned)
        offset = found[:, columns] - anchors
        apart = _degrees(offset[:, turned])
        inward = np.minimum(1.0, safe_deg / np.maximum(apart, 1e-9))
        found[:, columns] = anchors + inward[:, None] * offset
        return found.astype(np.float32), self.trust.at(distances) * _fading(distances / safe_deg, FADED_POSES)

    def distances(
        self, controls: Float[np.ndarray, "frames controls"], layout: ControlLayout
    ) -> Float64[np.ndarray, " frames"]:
        """Degrees to the nearest learned pose."""
        columns, turned = layout.pose_columns, slice(0, 6 * len(layout.joints))
        return _nearest_points(controls[:, columns].astype(np.float64), self.poses.astype(np.float64), turned)[1]


def _fading(times: Float[np.ndarray, " frames"], gone: float) -> Float64[np.ndarray, " frames"]:
    """1 up to 1, then smoothly down to 0."""
    beyond = np.clip((np.asarray(times, np.float64) - 1) / (gone - 1), 0, 1)
    return 1 - beyond**2 * (3 - 2 * beyond)


def _degrees(offsets: Float64[np.ndarray, "frames rotations"]) -> Float64[np.ndarray, " frames"]:
    """Root mean square angle of differences of rotations, 6 numbers a joint."""
    joints = max(offsets.shape[1] // 6, 1)
    return np.degrees(np.linalg.norm(offsets, axis=1) / np.sqrt(joints) / NUMBERS_OF_A_RADIAN)


def _nearest_points(
    poses: Float64[np.ndarray, "frames poses"], learned: Float64[np.ndarray, "learned poses"], turned: slice
) -> tuple[Float64[np.ndarray, "frames poses"], Float64[np.ndarray, " frames"]]:
    """For each pose a point amid the learned ones that are nearest, and the degrees to the very nearest."""
    if not len(learned) or not poses.shape[1]:
        return poses.copy(), np.zeros(len(poses))
    points, nearest = np.empty_like(poses), np.empty(len(poses))
    size = max(1, PAIRS // max(len(learned) * learned[:, turned].shape[1], 1))
    for start in range(0, len(poses), size):
        part = slice(start, start + size)
        squares = (
            (poses[part, turned] ** 2).sum(axis=1)[:, None]
            + (learned[:, turned] ** 2).sum(axis=1)
            - 2 * poses[part, turned] @ learned[:, turned].T
        )
        apart = np.sqrt(np.maximum(squares, 0.0))
        least = apart.min(axis=1)
        weights = np.exp(-((apart - least[:, None]) / np.maximum(NEAREST_SHARE * least, 1e-6)[:, None]))
        points[part] = weights @ learned / weights.sum(axis=1, keepdims=True)
        joints = max(learned[:, turned].shape[1] // 6, 1)
        nearest[part] = np.degrees(least / np.sqrt(joints) / NUMBERS_OF_A_RADIAN)
    return points, nearest


# --- coefficients ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class CoefficientRange:
    """The coefficients of the learned frames: an ellipsoid, and a box around it."""

    std: Float32[np.ndarray, " shapes"]
    largest: Float32[np.ndarray, " shapes"]
    """Of each coefficient's size."""
    length: float
    """The largest length of a frame's coefficients, each over its standard deviation."""
    resting: Float32[np.ndarray, " shapes"] | None = None
    """The garment that is left where no answer is believed; None is the mean garment."""

    def faded(
        self, answers: Float[np.ndarray, "frames shapes"], trust: Float64[np.ndarray, " frames"]
    ) -> Float32[np.ndarray, "frames shapes"]:
        """Answers within what was learned, faded towards the garment at rest."""
        resting = 0.0 if self.resting is None else self.resting
        return (resting + trust[:, None] * (self.inside(answers) - resting)).astype(np.float32)

    @staticmethod
    def of(clips: Sequence[Clip], std: Float[np.ndarray, " shapes"]) -> CoefficientRange:
        """
        Raises:
            InputError: there are not two good frames.
        """
        known = good_frames(clips)[1].astype(np.float64)
        whole = np.maximum(np.asarray(std, np.float64), 1e-6 * float(np.max(std, initial=1e-6)))
        lengths = np.linalg.norm(known / whole, axis=1)
        return CoefficientRange(
            whole.astype(np.float32), np.abs(known).max(axis=0).astype(np.float32), float(lengths.max())
        )

    def inside(self, coefficients: Float[np.ndarray, "frames shapes"]) -> Float32[np.ndarray, "frames shapes"]:
        """Coefficients in the box, drawn together into the ellipsoid."""
        found = np.clip(coefficients, -self.largest, self.largest)
        lengths = np.linalg.norm(found / self.std, axis=1)
        return (found * np.minimum(1.0, self.length / np.maximum(lengths, 1e-9))[:, None]).astype(np.float32)


# --- regressors --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class BoundedRegressor:
    """A regressor that is asked about what it knows, and believed as far as that goes."""

    regressor: Regressor
    controls: ControlRange
    coefficients: CoefficientRange
    safe_deg: float

    @property
    def layout(self) -> ControlLayout:
        return self.regressor.layout

    def stream(self) -> BoundedStream:
        return BoundedStream(self)

    def predict(self, controls: Float32[np.ndarray, "frames controls"]) -> Float32[np.ndarray, "frames shapes"]:
        known, trust = self.controls.bounded(controls, self.layout, self.safe_deg)
        return self.believed(self.regressor.predict(known), trust)

    def believed(
        self, answers: Float32[np.ndarray, "frames shapes"], trust: Float64[np.ndarray, " frames"]
    ) -> Float32[np.ndarray, "frames shapes"]:
        """Answers within what was learned, faded towards the garment at rest."""
        return self.coefficients.faded(answers, trust)


class BoundedStream:
    """A motion that is answered frame by frame."""

    def __init__(self, regressor: BoundedRegressor) -> None:
        self._regressor, self._inner = regressor, regressor.regressor.stream()

    def push(self, controls: Float[np.ndarray, " controls"]) -> Float32[np.ndarray, " shapes"]:
        regressor = self._regressor
        known, trust = regressor.controls.bounded(np.asarray(controls)[None], regressor.layout, regressor.safe_deg)
        return regressor.believed(self._inner.push(known[0])[None], trust)[0]


@dataclass(frozen=True, slots=True, eq=False)
class KnownRange:
    """All that a garment was learned from."""

    poses: PoseRange
    controls: Mapping[str, ControlRange]
    """By the regressor that they drive; the network's are those of the linear regression."""
    coefficients: CoefficientRange

    def safe_deg(self, name: str) -> float:
        """How far from every learned pose a regressor's answers do not fade yet: as far as it was right where it was
        examined."""
        examined = max(self.poses.validated_deg, self.controls[name].trust.reach_deg)
        return min(max(SAFE_DEG[0], examined), SAFE_DEG[1])

    def require(self, name: str, layout: ControlLayout, shapes: int) -> None:
        """Raise InputError unless it belongs to such a regressor."""
        found, coefficients = self.controls.get(name), len(self.coefficients.std)
        if found is None:
            raise InputError(f"expected controls of the {name} regressor, found none")
        sizes = len(found.mean), len(found.largest), found.poses.shape[1]
        expected = layout.size, len(layout.parts), len(layout.pose_columns)
        if sizes != expected:
            raise InputError(f"{name}: expected controls, parts and poses of {expected} numbers, found {sizes}")
        if name == "linear" and self.poses.joints != layout.joints:
            raise InputError(f"expected poses of the joints {layout.joints}, found {self.poses.joints}")
        if coefficients != shapes:
            raise InputError(f"expected the range of {shapes} coefficients, found {coefficients}")

    def bounded(self, name: str, regressor: Regressor) -> BoundedRegressor:
        """A regressor of that name within what is known."""
        driven = "kernel" if name == "kernel" else "linear"
        return BoundedRegressor(regressor, self.controls[driven], self.coefficients, self.safe_deg(driven))


# --- files -------------------------------------------------------------------------------------------------------


def save_known_range(path: Path, known: KnownRange, *, model_digest: str) -> None:
    poses, coefficients = known.poses, known.coefficients
    resting = np.zeros_like(coefficients.std) if coefficients.resting is None else coefficients.resting
    tensors = {
        "quaternions": poses.quaternions, "std": coefficients.std, "largest": coefficients.largest, "resting": resting,
    }  # fmt: skip
    for name, controls in known.controls.items():
        tensors |= {f"{name}.{part}": getattr(controls, part) for part in ("mean", "largest", "poses")}
        tensors[f"{name}.trust"] = controls.trust.knots
    note = {
        "joints": list(poses.joints),
        "validated_deg": poses.validated_deg,
        "length": coefficients.length,
        "controls": sorted(known.controls),
        "model": model_digest,
    }
    write_tensors(path, _KIND, tensors, note)


def load_known_range(path: Path, *, model_digest: str) -> KnownRange:
    """Raises InputError: the file is damaged, another kind, or belongs to another model."""
    file = read_tensors(path, _KIND)
    if file.entry("model") != model_digest:
        raise InputError("expected the range of the blendshapes beside it, found that of another model", where=path)
    with reading(path, "known range"):
        joints = wholes(file.entry("joints"), "joints")
        quaternions = file["quaternions"]
        if quaternions.dtype != np.float32 or quaternions.shape[1:] != (len(joints), 4):
            found = f"{quaternions.dtype} of {quaternions.shape}"
            raise InputError(f"expected quaternions of {len(joints)} joints as float32, found {found}")
        if not (np.abs(np.linalg.norm(quaternions, axis=2) - 1) < 1e-3).all():
            raise InputError("expected quaternions of length 1, found others")
        if min(joints, default=0) < 0 or len({*joints}) < len(joints):
            raise InputError(f"expected joints once each, from 0 up, found {shortened(str(joints), 80)}")
        names = texts(file.entry("controls"), "controls")
        if "linear" not in names or not {*names} <= {"linear", "kernel"}:
            raise InputError(f"expected controls of linear, or linear and kernel, found {shortened(str(names), 80)}")
        return KnownRange(
            PoseRange(quaternions, joints, _amount(file, "validated_deg")),
            {name: _control_range(file, name) for name in names},
            _coefficient_range(file),
        )


def _amount(file: TensorFile, name: str) -> float:
    """A number of the note, not below 0."""
    found = number(file.entry(name), name)
    if found < 0:
        raise InputError(f"expected {name} from 0, found {found:g}")
    return found


def _control_range(file: TensorFile, name: str) -> ControlRange:
    found = ControlRange(
        file[f"{name}.mean"], file[f"{name}.largest"], file[f"{name}.poses"], Trust(file[f"{name}.trust"])
    )
    for each, axes in ((found.mean, 1), (found.largest, 1), (found.poses, 2)):
        if each.ndim != axes or each.dtype != np.float32 or not np.isfinite(each).all():
            raise InputError(f"{name}: expected finite float32 controls, found {each.dtype} of {each.shape}, or NaN")
    if found.largest.min(initial=0) < 0:
        raise InputError(f"{name}: expected distances from 0, found {found.largest.min():g}")
    knots = found.trust.knots
    if knots.ndim != 2 or knots.shape[1] != 2 or not len(knots) or knots.dtype != np.float32:
        raise InputError(f"{name}: expected knots of trust in two columns of float32, found {knots.shape}")
    ascending, falling = (np.diff(knots[:, 0]) >= 0).all(), (np.diff(knots[:, 1]) <= 0).all()
    within = knots[:, 0].min() >= 0 and knots[:, 1].min() >= 0 and knots[:, 1].max() <= 1
    if not (np.isfinite(knots).all() and ascending and falling and within):
        raise InputError(f"{name}: expected trust that falls from 1 to 0 with the distance, found another")
    return found


def _coefficient_range(file: TensorFile) -> CoefficientRange:
    std, largest, resting = file["std"], file["largest"], file["resting"]
    finite = all(np.isfinite(each).all() for each in (std, largest, resting))
    if std.ndim != 1 or not std.shape == largest.shape == resting.shape or not finite:
        found = f"{std.shape}, {largest.shape} and {resting.shape}"
        raise InputError(f"expected a finite range for each coefficient, found {found}, or NaN")
    if std.min(initial=1) <= 0 or largest.min(initial=0) < 0:
        raise InputError("expected positive standard deviations and sizes from 0, found others")
    return CoefficientRange(std, largest, _amount(file, "length"), resting)
