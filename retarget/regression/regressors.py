"""From control vectors to blendshape coefficients: what every regressor has in common, and its file.

A regressor answers frame by frame (`stream`), and a whole motion at once (`predict`), with the same numbers. Controls
are standardised and coefficients whitened inside; outside they are in their own units.

Letters: T frames, D controls (with the history), K coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, Float64

from capture4d.errors import InputError
from capture4d.files.json_values import entry, number, texts, wholes
from capture4d.files.reading import reading
from capture4d.files.tensors import TensorFile, read_tensors, write_tensors
from capture4d.value_checks import require_frame_rate
from retarget.config import ControlConfig
from retarget.regression.controls import ControlLayout

__all__ = [
    "Clip",
    "FittingClips",
    "History",
    "Regressor",
    "Scales",
    "Stream",
    "Trust",
    "good_frames",
    "mean_squared_error",
    "read_regressor",
    "require_scales",
    "usual_response",
    "with_best_ridge",
    "with_history",
    "write_regressor",
]


UNITS = {
    "rotations": "R - I, first two columns",
    "velocity": "m/s",
    "acceleration": "m/s^2",
    "turning": "rad/s",
    "history": "whitened coefficients",
    "coefficients": "m",
}
"""Written with every regressor, for people."""

LEAST_LIVELY = 0.2
"""Share of the largest standard deviation of a kind of controls by which each of them is divided at least."""


RESPONSE_RIDGE = 0.3
"""Penalty of the regression that says what a control counts, relative to the variance of a standardised control."""
LEAST_RESPONSE = 0.02
"""A control counts at least this share of the mean of all."""
TRUST_FRAMES, MOST_KNOTS = 12, 12
"""Frames at like distances from which a share of trust is told, at least; and how often, at most."""
HALF_RIGHT = 0.5
"""A share of trust down to which a distance counts as safe."""


@dataclass(frozen=True, slots=True, eq=False)
class Clip:
    """Consecutive frames to learn from or to be measured on."""

    controls: Float32[np.ndarray, "frames controls"]
    coefficients: Float32[np.ndarray, "frames shapes"]
    good: np.ndarray
    """(T,) bool: frames whose coefficients are known; the others only lead up to them."""
    take: int = 0
    """Number of the take that it is from, or a mirror image of."""


@dataclass(frozen=True, slots=True, eq=False)
class FittingClips:
    """What a regressor is fitted to. Settings are chosen by learning from some clips and looking at others; with the
    chosen ones everything is learned from."""

    training: Sequence[Clip]
    validation: Sequence[Clip]
    """Choose the settings; none: the first of each is taken."""
    all: Sequence[Clip]
    """To learn from in the end: the training clips, those that validated, and those seen in a mirror."""

    @staticmethod
    def create(training: Sequence[Clip], validation: Sequence[Clip] = ()) -> FittingClips:
        return FittingClips(training, validation, [*training, *validation])

    @property
    def settled(self) -> FittingClips:
        """The training clips alone, with nothing left to choose."""
        return FittingClips(self.training, (), self.training)


@dataclass(frozen=True, slots=True, eq=False)
class Trust:
    """What share of its answers a regressor is believed, by how far a pose is from every learned one."""

    knots: Float32[np.ndarray, "knots 2"]
    """Degrees, ascending, and shares from 1 to 0, not ascending; between them it is linear, beyond them level."""

    @staticmethod
    def whole() -> Trust:
        """Of a regressor that was never examined."""
        return Trust(np.array([[0.0, 1.0]], np.float32))

    @staticmethod
    def of(
        distances_deg: Float64[np.ndarray, " frames"],
        answers: Float[np.ndarray, "frames shapes"],
        truth: Float[np.ndarray, "frames shapes"],
    ) -> Trust:
        """As frames that were not learned from show it: the share with which answers come nearest to the truth.

        Frames at like distances are told together, by least squares; shares that would rise with the distance are
        levelled (isotonic regression). A learned pose itself is believed whole.
        """
        count = min(len(distances_deg) // TRUST_FRAMES, MOST_KNOTS)
        if not count:
            return Trust.whole()
        levels: list[list[float]] = []  # degrees, <answer, truth> and <answer, answer> of neighbouring groups
        groups: list[float] = []
        for rows in np.array_split(np.argsort(distances_deg, kind="stable"), count):
            said, true = answers[rows].astype(np.float64), truth[rows].astype(np.float64)
            groups.append(float(distances_deg[rows].mean()))
            levels.append([1, float((said * true).sum()), float((said**2).sum()) + 1e-12])
            while len(levels) > 1 and levels[-1][1] / levels[-1][2] > levels[-2][1] / levels[-2][2]:
                last = levels.pop()
                levels[-1] = [a + b for a, b in zip(levels[-1], last, strict=True)]
        shares = [np.clip(level[1] / level[2], 0, 1) for level in levels for _ in range(int(level[0]))]
        return Trust(np.column_stack([[0.0, *groups], [1.0, *shares]]).astype(np.float32))

    def at(self, degrees: Float64[np.ndarray, " frames"]) -> Float64[np.ndarray, " frames"]:
        return np.interp(degrees, self.knots[:, 0], self.knots[:, 1])

    @property
    def reach_deg(self) -> float:
        """The farthest distance at which answers were at least half right; 0 if there is none."""
        right = self.knots[self.knots[:, 1] >= HALF_RIGHT, 0]
        return float(right.max(initial=0.0))


@runtime_checkable
class Stream(Protocol):
    """Frames of one motion, as they come."""

    def push(self, controls: Float[np.ndarray, " controls"]) -> Float32[np.ndarray, " shapes"]:
        """The coefficients of the next frame."""
        ...


@runtime_checkable
class Regressor(Protocol):
    """A learned map from motion to coefficients."""

    @property
    def layout(self) -> ControlLayout: ...

    def stream(self) -> Stream:
        """Start a motion."""
        ...

    def predict(self, controls: Float32[np.ndarray, "frames controls"]) -> Float32[np.ndarray, "frames shapes"]:
        """The coefficients of a whole motion."""
        ...


class RidgeRegressor(Regressor, Protocol):
    """A regressor with a penalty."""

    @property
    def ridge(self) -> float: ...


Ridged = TypeVar("Ridged", bound=RidgeRegressor)


@dataclass(frozen=True, slots=True, eq=False)
class Scales:
    """How controls are standardised and coefficients whitened."""

    control_mean: Float32[np.ndarray, " controls"]
    control_std: Float32[np.ndarray, " controls"]
    std: Float32[np.ndarray, " shapes"]

    @staticmethod
    def of(
        controls: Float[np.ndarray, "frames controls"], std: Float[np.ndarray, " shapes"], layout: ControlLayout
    ) -> Scales:
        """Controls that move little, beside the liveliest of their kind, are left small, not blown up: what a leg that
        hardly moved says about a shirt is wrong in a new motion.
        """
        spread = controls.std(axis=0)
        start = 0
        for count in (*layout.kinds, len(spread) - layout.size):  # the history behind them is whitened already
            kind = slice(start, start + count)
            liveliest = float(spread[kind].max(initial=0.0))
            spread[kind] = np.maximum(spread[kind], max(LEAST_LIVELY * liveliest, 1e-6))
            start += count
        whole = np.asarray(std, np.float32)
        return Scales(
            controls.mean(axis=0).astype(np.float32),
            spread.astype(np.float32),
            np.maximum(whole, np.float32(1e-6) * whole.max(initial=np.float32(1e-6))),
        )

    def standardised(self, controls: Float[np.ndarray, "*frames controls"]) -> Float32[np.ndarray, "*frames controls"]:
        return ((controls - self.control_mean) / self.control_std).astype(np.float32)

    def weighed(self, response: Float[np.ndarray, "controls shapes"]) -> Scales:
        """The same, with controls larger the farther the garment moves with them."""
        lengths = np.linalg.norm(response, axis=1)
        usual = max(float(lengths.mean()), 1e-30)
        wide = np.maximum(lengths / usual, LEAST_RESPONSE)
        return Scales(self.control_mean, (self.control_std / wide).astype(np.float32), self.std)

    def whitened(self, coefficients: Float[np.ndarray, "*frames shapes"]) -> Float32[np.ndarray, "*frames shapes"]:
        return (coefficients / self.std).astype(np.float32)


def usual_response(
    known: Float[np.ndarray, "frames controls"], coefficients: Float[np.ndarray, "frames shapes"]
) -> Float64[np.ndarray, "controls shapes"]:
    """How coefficients change with each standardised control, by a ridge regression: what a control counts.

    The length of a row is how far the garment moves when that control alone goes by its standard deviation.
    """
    centred = known.astype(np.float64) - known.mean(axis=0, dtype=np.float64)
    offsets = coefficients.astype(np.float64) - coefficients.mean(axis=0, dtype=np.float64)
    penalty = RESPONSE_RIDGE * max(len(known), 1) * np.eye(known.shape[1])
    return np.linalg.solve(centred.T @ centred + penalty, centred.T @ offsets)


class History:
    """The coefficients of a few frames before, whitened, latest first; zeros before a motion begins."""

    def __init__(self, frames: int, shapes: int) -> None:
        self._past = np.zeros((frames, shapes), np.float32)

    def extend(self, controls: Float[np.ndarray, " controls"]) -> Float32[np.ndarray, " all"]:
        """Controls with the history behind them."""
        return np.concatenate([np.asarray(controls, np.float32), self._past.reshape(-1)])

    def push(self, whitened: Float[np.ndarray, " shapes"]) -> None:
        """Take in the frame that has just been answered."""
        if len(self._past):
            self._past = np.concatenate([np.asarray(whitened, np.float32)[None], self._past[:-1]])


def with_history(clip: Clip, frames: int, std: Float32[np.ndarray, " shapes"]) -> Clip:
    """A clip whose controls hold the true coefficients of the frames before: how an autoregressive model learns."""
    if frames == 0:
        return clip
    whitened = np.where(clip.good[:, None], clip.coefficients / std, 0).astype(np.float32)
    past = [np.concatenate([np.zeros_like(whitened[:step]), whitened[:-step]]) for step in range(1, frames + 1)]
    past = [each[: len(whitened)] for each in past]
    return replace(clip, controls=np.concatenate([clip.controls, *past], axis=1))


def mean_squared_error(regressor: Regressor, clips: Sequence[Clip]) -> float:
    """Mean square of the coefficients' errors over good frames and coefficients, square metres; running freely."""
    total = count = 0.0
    for clip in clips:
        errors = (regressor.predict(clip.controls) - clip.coefficients)[clip.good].astype(np.float64)
        total += float((errors**2).sum())
        count += errors.size
    return total / max(count, 1.0)


def good_frames(
    clips: Sequence[Clip],
) -> tuple[Float64[np.ndarray, "frames controls"], Float64[np.ndarray, "frames shapes"]]:
    """Controls and coefficients of all good frames, in their own units.

    Raises:
        InputError: there are not two.
    """
    controls = np.concatenate([clip.controls[clip.good] for clip in clips]).astype(np.float64)
    if len(controls) < 2:
        raise InputError(f"takes: expected at least 2 good frames to learn from, found {len(controls)}")
    return controls, np.concatenate([clip.coefficients[clip.good] for clip in clips]).astype(np.float64)


def with_best_ridge(
    clips: FittingClips, ridges: Sequence[float], fit: Callable[[Sequence[Clip], Sequence[float]], list[Ridged]]
) -> Ridged:
    """The ridge regression with the penalty that the validation clips choose, learned from all clips.

    Args:
        fit: one regressor for each ridge, from some clips.
    """
    if clips.validation and len(ridges) > 1:
        candidates = fit(clips.training, ridges)
        ridges = [min(candidates, key=lambda candidate: mean_squared_error(candidate, clips.validation)).ridge]
    return fit(clips.all, ridges)[0]


# --- files -------------------------------------------------------------------------------------------------------


def write_regressor(
    path: Path,
    kind: str,
    tensors: Mapping[str, np.ndarray],
    *,
    layout: ControlLayout,
    scales: Scales,
    model_digest: str,
    note: Mapping[str, Any],
) -> None:
    """Write a regressor with what its controls are and which model its coefficients belong to."""
    everything = {
        "control_mean": scales.control_mean,
        "control_std": scales.control_std,
        "coefficient_std": scales.std,
        **tensors,
    }
    write_tensors(path, kind, everything, {"layout": asdict(layout), "units": UNITS, "model": model_digest, **note})


def read_regressor(path: Path, kind: str, *, model_digest: str) -> tuple[TensorFile, ControlLayout, Scales]:
    """
    Raises:
        InputError: the file is damaged, another kind, or belongs to another model.
    """
    file = read_tensors(path, kind)
    if file.entry("model") != model_digest:
        raise InputError("expected a regressor of the blendshapes beside it, found one of another model", where=path)
    for name, array in file.tensors.items():
        if not array.ndim or array.dtype.kind != "f":
            raise InputError(f"'{name}': expected floats in rows, found {array.dtype} of {array.shape}", where=path)
        if not np.isfinite(array).all():
            raise InputError(f"expected finite numbers, found NaN or inf in '{name}'", where=path)
    layout = _load_layout(file)
    with reading(path, "regressor"):
        names = ("control_mean", "control_std", "coefficient_std")
        if any(file[name].ndim != 1 for name in names) or len(file[names[0]]) != len(file[names[1]]):
            found = ", ".join(str(file[name].shape) for name in names)
            raise InputError(f"expected scales in one row each, the first two as long as each other, found {found}")
        return file, layout, Scales(*(file[name].astype(np.float32) for name in names))


def _load_layout(file: TensorFile) -> ControlLayout:
    """The layout in a file's note."""
    with reading(file.path, "description of the controls"):
        described = file.entry("layout")
        settings = entry(described, "config")
        config = ControlConfig(**{**settings, "lags": wholes(settings.get("lags", []), "lags")})
        names, fps = texts(entry(described, "joint_names"), "joint_names"), number(entry(described, "fps"), "fps")
        joints = wholes(entry(described, "joints"), "joints")
        parents = wholes(entry(described, "parents"), "parents", least=-1)
        require_frame_rate("fps", fps)
        if max(joints, default=0) >= len(names) or len(parents) not in (0, len(names)):
            raise InputError(f"expected joints of {len(names)} and a parent for each, found others")
        return ControlLayout(names, joints, fps, config, parents)


def require_scales(path: Path, scales: Scales, *, controls: int, shapes: int) -> None:
    """Raises InputError where what standardises a regressor is not of its size, or divides by nothing."""
    found = tuple(len(each) for each in (scales.control_mean, scales.control_std, scales.std))
    if found != (controls, controls, shapes):
        raise InputError(f"expected scales of {controls} controls and {shapes} shapes, found {found}", where=path)
    if min(scales.control_std.min(initial=1), scales.std.min(initial=1)) <= 0:
        raise InputError("expected positive standard deviations, found others", where=path)
