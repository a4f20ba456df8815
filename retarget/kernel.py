"""Regression by kernels: a frame's folds are put together from the learned frames whose poses are like its own.

Ridge regression with a sum of Gaussian kernels and a linear one. What "like" means is taken from a linear regression of
the same frames, for a control counts by as much as it moves the garment:

- over everything: two frames are alike if the linear regression puts the garment in the same place;
- over each side of the body, and over its middle, the same of what the joints there contribute;
- over each of these again: two frames are alike if the joints there are turned alike, each rotation weighted by how far
  the garment moves with it.

So a fold at one shoulder is learned without waiting for every pose of the other. Where there are takes enough, all
this is then tuned so that takes foretell each other (`kernel_tuning`).

Letters: N learned frames, D controls, K coefficients, V views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from scipy.linalg import cho_factor, cho_solve

from capture4d.errors import InputError
from retarget.config import KernelConfig
from retarget.controls import ControlLayout
from retarget.mirroring import opposite_joints
from retarget.regressors import (
    Clip,
    FittingClips,
    Scales,
    good_frames,
    read_regressor,
    usual_response,
    with_best_ridge,
    write_regressor,
)

__all__ = ["KernelRegressor", "Views", "fit_kernel", "load_kernel", "save_kernel"]

_KIND = "capture4d kernel regressor"
BATCH = 1024
"""Frames that are answered together."""
STILL = 1e-6
"""A side that moves the garment by less than this share of what everything does has no kernels of its own."""


@dataclass(frozen=True, eq=False)
class KernelRegressor:
    """Coefficients are a sum over the learned frames, each weighted by its likeness."""

    layout: ControlLayout
    scales: Scales
    views: tuple[Float32[np.ndarray, "controls _"], ...]
    """From standardised controls to what a kernel compares; frames a distance of 1 apart are alike by exp(-1/2)."""
    shares: Float32[np.ndarray, " views"]
    """Weights of the kernels; 1 in all before they are tuned."""
    line: float
    """Weight of the linear kernel, which compares what the first of the others does; 0 without tuning."""
    frames: Float32[np.ndarray, "learned controls"]
    """Standardised controls of the learned frames."""
    answers: Float32[np.ndarray, "learned shapes"]
    """What each of them contributes."""
    middle: Float32[np.ndarray, " shapes"]
    ridge: float

    def stream(self) -> KernelStream:
        return KernelStream(self)

    def predict(self, controls: Float32[np.ndarray, "frames controls"]) -> Float32[np.ndarray, "frames shapes"]:
        known = self.scales.standardised(np.asarray(controls).reshape(-1, self.layout.size))
        said = [np.zeros((0, len(self.middle)))]
        said += [self.answer(known[start : start + BATCH]) for start in range(0, len(known), BATCH)]
        return np.concatenate(said).astype(np.float32)

    def answer(self, known: Float32[np.ndarray, "frames controls"]) -> Float64[np.ndarray, "frames shapes"]:
        """Coefficients of frames, given by standardised controls."""
        likeness = _likeness(_seen(known, self.views), self._learned, self.shares, self.line)
        return likeness @ self.answers + self.middle

    @cached_property
    def _learned(self) -> list[Float64[np.ndarray, "learned _"]]:
        return _seen(self.frames, self.views)


class KernelStream:
    """A motion that is answered frame by frame; nothing is carried from one to the next."""

    def __init__(self, regressor: KernelRegressor) -> None:
        self._regressor = regressor

    def push(self, controls: Float[np.ndarray, " controls"]) -> Float32[np.ndarray, " shapes"]:
        return self._regressor.predict(np.asarray(controls)[None])[0]


def fit_kernel(
    clips: FittingClips, layout: ControlLayout, std: Float[np.ndarray, " shapes"], config: KernelConfig
) -> KernelRegressor:
    """Kernel ridge regression; the validation clips choose the ridge, and then all clips are learned from.

    Args:
        std: spread of the coefficients.
    Raises:
        InputError: there are not two good frames.
    """
    return with_best_ridge(clips, config.ridges, lambda known, ridges: _fit(known, layout, std, config, ridges))


def _fit(
    clips: Sequence[Clip],
    layout: ControlLayout,
    std: Float[np.ndarray, " shapes"],
    config: KernelConfig,
    ridges: Sequence[float],
) -> list[KernelRegressor]:
    """One regressor for each ridge."""
    controls, wanted = good_frames(clips)
    takes = np.concatenate([np.full(int(clip.good.sum()), clip.take) for clip in clips])
    scales = Scales.of(controls, np.asarray(std, np.float32), layout)
    known, middle = scales.standardised(controls), wanted.mean(axis=0)
    seen_by = _tuned(known, wanted - middle, takes, layout, config, ridges[0])
    views = tuple(view.astype(np.float32) for view in seen_by.matrices)
    shares, line = seen_by.weights.astype(np.float32), float(seen_by.line)
    if len(known) > config.most_frames:
        kept = np.linspace(0, len(known) - 1, config.most_frames).round().astype(int)
        known, wanted = known[kept], wanted[kept]
    seen = _seen(known, views)
    likeness = _likeness(seen, seen, shares, line)
    found = []
    for ridge in ridges:
        factor = cho_factor(likeness + ridge * np.eye(len(likeness)), check_finite=False)
        answers = cho_solve(factor, wanted - middle, check_finite=False)
        found.append(
            KernelRegressor(
                layout, scales, views, shares, line, known,
                answers.astype(np.float32), middle.astype(np.float32), ridge,
            )
        )  # fmt: skip
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """What kernels compare, before it is learned from."""

    matrices: tuple[Float64[np.ndarray, "controls _"], ...]
    """From standardised controls."""
    kinds: tuple[int, ...]
    """0: everything; 1: what a side contributes; 2: how the joints of a side are turned."""
    weights: Float64[np.ndarray, " views"]
    """Of the kernels."""
    line: float = 0.0
    """Of the linear kernel over everything."""


def _views(
    known: Float32[np.ndarray, "frames controls"],
    offsets: Float64[np.ndarray, "frames shapes"],
    layout: ControlLayout,
    config: KernelConfig,
) -> Views:
    """As a linear regression says: everything has a third of the weight, what the sides contribute another, and their
    rotations the last."""
    response = _shortened(usual_response(known, offsets))
    relevance = np.linalg.norm(response, axis=1)
    squares = relevance**2 / max(float((relevance**2).sum()), 1e-30)
    places = config.length * _usual_square(known @ response)
    turns = config.side_length * _usual_square(known * relevance)
    views, kinds = [response / np.sqrt(places)], [0]
    for now, ever in _sides(layout):
        if squares[now].sum() > STILL:
            views.append(np.where(ever[:, None], response, 0) / np.sqrt(places * squares[ever].sum()))
            views.append(np.diag(np.where(now, relevance, 0))[:, now] / np.sqrt(turns * squares[now].sum()))
            kinds += [1, 2]
    weights = np.array([1.0 if kind == 0 else 2.0 / (len(kinds) - 1) for kind in kinds])
    weights /= weights.sum()
    return Views(tuple(views), tuple(kinds), weights)


def _tuned(
    known: Float32[np.ndarray, "frames controls"],
    offsets: Float64[np.ndarray, "frames shapes"],
    takes: Int64[np.ndarray, " frames"],
    layout: ControlLayout,
    config: KernelConfig,
    ridge: float,
) -> Views:
    """The views, tuned if there are takes enough."""
    views = _views(known, offsets, layout, config)
    names, takes = np.unique(takes, return_inverse=True)
    if not config.tuning.enabled or len(names) < config.tuning.least_takes:
        return views
    from retarget.kernel_tuning import tune_kernels  # torch takes a second to load

    others = [takes != take for take in range(len(names))]
    without = [_views(known[rest], offsets[rest], layout, config) for rest in others]
    found = tune_kernels(known, offsets, takes, without, groups=_groups(layout), ridge=ridge, config=config.tuning)
    kinds = list(views.kinds)
    matrices = tuple(
        found.controls[:, None] * view / width for view, width in zip(views.matrices, found.widths[kinds], strict=True)
    )
    # The linear kernel compares what the first view does, before that is widened.
    line = found.line * found.widths[0] ** 2
    return Views(matrices, views.kinds, views.weights * found.shares[kinds], line)


def _shortened(response: Float64[np.ndarray, "controls shapes"]) -> Float64[np.ndarray, "controls directions"]:
    """The same lengths and distances in fewer numbers, up to a millionth of their square."""
    left, values, _ = np.linalg.svd(response, full_matrices=False)
    held = np.cumsum(values**2) / max(float((values**2).sum()), 1e-30)
    return (left * values)[:, : int(np.searchsorted(held, 1 - 1e-6)) + 1]


def _usual_square(features: Float64[np.ndarray, "frames features"]) -> float:
    """Mean squared distance of two frames; positive."""
    return max(2 * float(features.var(axis=0).sum()), 1e-30)


def _opposite(layout: ControlLayout) -> Int64[np.ndarray, " joints"]:
    """Partners of the garment's joints; themselves, where the joints' names tell no sides."""
    joints = np.array(layout.joints, int)
    try:
        return opposite_joints(layout.joint_names)[joints]
    except InputError:
        return joints


def _sides(layout: ControlLayout) -> list[tuple[np.ndarray, np.ndarray]]:
    """Controls of the joints in the middle, on one side, on the other, (D,) bool each: their rotations now, and those
    with how far they have come. All joints together, where their names tell no sides."""
    joints, opposite = np.array(layout.joints, int), _opposite(layout)
    found = []
    for side in (opposite == joints, opposite > joints, opposite < joints):
        if side.any():
            rotations = np.tile(np.repeat(side, 6), layout.rotation_sets)
            lags = np.tile(rotations, len(layout.config.lags))
            between = np.zeros(layout.size - len(rotations) - len(lags), bool)
            now = np.concatenate([rotations, between, np.zeros(len(lags), bool)])
            found.append((now, np.concatenate([rotations, between, lags])))
    return found


def _groups(layout: ControlLayout) -> Int64[np.ndarray, " controls"]:
    """Which controls are tuned as one, (D,) numbers from 0: the rotations of a joint with those of its partner, and all
    that there is of any other kind."""
    _, pairs = np.unique(np.minimum(layout.joints, _opposite(layout)), return_inverse=True)
    sets, lags = layout.rotation_sets, len(layout.config.lags)
    others = layout.kinds[sets : len(layout.kinds) - lags]
    parts = [number * (pairs.max(initial=0) + 1) + np.repeat(pairs, 6) for number in range(sets)]
    for count in (*others, *(6 * len(layout.joints) for _ in range(sets * lags))):
        parts.append(np.full(count, parts[-1].max(initial=0) + 1))
    return np.concatenate(parts)


def _seen(
    known: Float32[np.ndarray, "frames controls"], views: Sequence[Float32[np.ndarray, "controls _"]]
) -> list[Float64[np.ndarray, "frames _"]]:
    return [known.astype(np.float64) @ view.astype(np.float64) for view in views]


def _likeness(
    ours: Sequence[Float64[np.ndarray, "frames _"]],
    theirs: Sequence[Float64[np.ndarray, "others _"]],
    shares: Float[np.ndarray, " views"],
    line: float,
) -> Float64[np.ndarray, "frames others"]:
    total = line * ours[0] @ theirs[0].T
    for one, other, share in zip(ours, theirs, shares, strict=True):
        squares = (one**2).sum(axis=1)[:, None] + (other**2).sum(axis=1) - 2 * one @ other.T
        total += float(share) * np.exp(-0.5 * np.maximum(squares, 0))
    return total


def save_kernel(path: Path, regressor: KernelRegressor, *, model_digest: str) -> None:
    write_regressor(
        path,
        _KIND,
        {
            **{f"views.{number}": view for number, view in enumerate(regressor.views)},
            "shares": regressor.shares,
            "frames": regressor.frames,
            "answers": regressor.answers,
            "middle": regressor.middle,
        },
        layout=regressor.layout,
        scales=regressor.scales,
        model_digest=model_digest,
        note={"ridge": regressor.ridge, "line": regressor.line},
    )


def load_kernel(path: Path, *, model_digest: str) -> KernelRegressor:
    """Raises InputError: the file is damaged, another kind, or belongs to another model."""
    file, layout, scales = read_regressor(path, _KIND, model_digest=model_digest)
    shares, frames, answers, middle = (file[name] for name in ("shares", "frames", "answers", "middle"))
    views = tuple(file[f"views.{number}"] for number in range(len(shares)))
    wanted = (len(frames), layout.size), (len(frames), len(middle))
    found = frames.shape, answers.shape
    if wanted != found or any(len(view) != layout.size for view in views):
        raise InputError(
            f"{path}: expected learned frames of {wanted[0]} and {wanted[1]}, found {found[0]}, {found[1]}"
        )
    line, ridge = float(file.entry("line")), float(file.entry("ridge"))
    return KernelRegressor(layout, scales, views, shares, line, frames, answers, middle, ridge)
