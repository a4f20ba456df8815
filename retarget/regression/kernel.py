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

from capture4d.errors import InputError
from capture4d.files.json_values import number
from capture4d.files.reading import reading
from capture4d.learning.kernels import likeness, ridge_answers
from retarget.config import KernelConfig
from retarget.regression.controls import ControlLayout
from retarget.regression.kernel_views import Views, control_groups, kernel_views
from retarget.regression.regressors import (
    Clip,
    FittingClips,
    Scales,
    good_frames,
    read_regressor,
    require_scales,
    with_best_ridge,
    write_regressor,
)

__all__ = ["KernelRegressor", "fit_kernel", "load_kernel", "save_kernel"]

_KIND = "capture4d kernel regressor"
BATCH = 1024
"""Frames that are answered together."""


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
        alike = likeness(_seen(known, self.views), self._learned, self.shares, self.line)
        return alike @ self.answers + self.middle

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
    alike = likeness(seen, seen, shares, line)
    return [
        KernelRegressor(
            layout, scales, views, shares, line, known, answers.astype(np.float32), middle.astype(np.float32), ridge
        )
        for ridge, answers in zip(ridges, ridge_answers(alike, wanted - middle, ridges), strict=True)
    ]


def _tuned(
    known: Float32[np.ndarray, "frames controls"],
    offsets: Float64[np.ndarray, "frames shapes"],
    takes: Int64[np.ndarray, " frames"],
    layout: ControlLayout,
    config: KernelConfig,
    ridge: float,
) -> Views:
    """The views, tuned if there are takes enough."""
    views = kernel_views(known, offsets, layout, config)
    names, takes = np.unique(takes, return_inverse=True)
    if not config.tuning.enabled or len(names) < config.tuning.least_takes:
        return views
    from retarget.regression.kernel_tuning import tune_kernels  # torch takes a second to load

    others = [takes != take for take in range(len(names))]
    without = [kernel_views(known[rest], offsets[rest], layout, config) for rest in others]
    found = tune_kernels(
        known, offsets, takes, without, groups=control_groups(layout), ridge=ridge, config=config.tuning
    )
    return views.tuned(found.controls, found.widths, found.shares, found.line)


def _seen(
    known: Float32[np.ndarray, "frames controls"], views: Sequence[Float32[np.ndarray, "controls _"]]
) -> list[Float64[np.ndarray, "frames _"]]:
    return [known.astype(np.float64) @ view.astype(np.float64) for view in views]


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
    if (shares.ndim, frames.ndim, answers.ndim, middle.ndim) != (1, 2, 2, 1):
        shapes = ", ".join(str(each.shape) for each in (shares, frames, answers, middle))
        raise InputError(
            f"expected shares, frames, answers, middle of 1, 2, 2, 1 dimensions, found them of {shapes}", where=path
        )
    views = tuple(file[f"views.{number}"] for number in range(len(shares)))
    wanted = (len(frames), layout.size), (len(frames), len(middle))
    found = frames.shape, answers.shape
    if wanted != found or any(view.ndim != 2 or len(view) != layout.size for view in views):
        raise InputError(
            f"expected learned frames of {wanted[0]} and {wanted[1]}, found {found[0]}, {found[1]}", where=path
        )
    require_scales(path, scales, controls=layout.size, shapes=len(middle))
    with reading(path, "kernel regressor"):
        line, ridge = (number(file.entry(name), name) for name in ("line", "ridge"))
    return KernelRegressor(layout, scales, views, shares, line, frames, answers, middle, ridge)
