"""Linear regression from controls to coefficients.

References: DeepWrinkles (ECCV 2018), section 3.3: F = Lambda Theta^+, Moore-Penrose, without an intercept; an option.
The default has an intercept and a ridge that the validation clips choose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from capture4d.errors import InputError
from capture4d.files.json_values import number
from capture4d.files.reading import reading
from retarget.config import LinearConfig
from retarget.regression.controls import ControlLayout
from retarget.regression.regressors import (
    Clip,
    FittingClips,
    History,
    Scales,
    good_frames,
    read_regressor,
    require_scales,
    with_best_ridge,
    with_history,
    write_regressor,
)

__all__ = ["LinearRegressor", "fit_linear", "load_linear", "save_linear"]

_KIND = "capture4d linear regressor"


@dataclass(frozen=True, slots=True, eq=False)
class LinearRegressor:
    """Coefficients are linear in the controls."""

    layout: ControlLayout
    scales: Scales
    matrix: Float32[np.ndarray, "controls shapes"]
    """From standardised controls, the history behind them, to coefficients."""
    intercept: Float32[np.ndarray, " shapes"]
    ridge: float

    def stream(self) -> LinearStream:
        return LinearStream(self)

    def predict(self, controls: Float32[np.ndarray, "frames controls"]) -> Float32[np.ndarray, "frames shapes"]:
        if self.layout.config.history:
            stream = self.stream()
            return np.array([stream.push(row) for row in controls], np.float32).reshape(-1, len(self.intercept))
        return self.scales.standardised(controls) @ self.matrix + self.intercept


class LinearStream:
    """A motion that is answered frame by frame."""

    def __init__(self, regressor: LinearRegressor) -> None:
        self._regressor = regressor
        self._history = History(regressor.layout.config.history, len(regressor.intercept))

    def push(self, controls: Float[np.ndarray, " controls"]) -> Float32[np.ndarray, " shapes"]:
        regressor = self._regressor
        known = regressor.scales.standardised(self._history.extend(controls))
        answer = known @ regressor.matrix + regressor.intercept
        self._history.push(answer / regressor.scales.std)
        return answer


def fit_linear(
    clips: FittingClips, layout: ControlLayout, std: Float[np.ndarray, " shapes"], config: LinearConfig
) -> LinearRegressor:
    """Least squares; the validation clips choose the ridge, running freely where there is a history, and then all clips
    are learned from.

    Args:
        std: spread of the coefficients, with which the history is whitened.
    Raises:
        InputError: there are not two good frames.
    """
    ridges = (0.0,) if config.fit == "moore-penrose" else config.ridges
    return with_best_ridge(clips, ridges, lambda known, ridges: _fit(known, layout, std, config, ridges))


def _fit(
    clips: Sequence[Clip],
    layout: ControlLayout,
    std: Float[np.ndarray, " shapes"],
    config: LinearConfig,
    ridges: Sequence[float],
) -> list[LinearRegressor]:
    """One regressor for each ridge."""
    whole = np.asarray(std, np.float32)
    history = layout.config.history
    controls, wanted = good_frames([with_history(clip, history, np.maximum(whole, 1e-6)) for clip in clips])
    scales = Scales.of(controls, whole, layout)
    if config.fit == "moore-penrose":
        plain = Scales(np.zeros_like(scales.control_mean), np.ones_like(scales.control_std), scales.std)
        matrix = np.linalg.pinv(controls) @ wanted
        return [LinearRegressor(layout, plain, matrix.astype(np.float32), np.zeros(len(whole), np.float32), 0.0)]
    standard = scales.standardised(controls).astype(np.float64)
    centre, middle = standard.mean(axis=0), wanted.mean(axis=0)
    left, values, right = np.linalg.svd(standard - centre, full_matrices=False)
    scores = left.T @ (wanted - middle)
    kept = values > 1e-6 * values.max(initial=0.0)  # standardised in single precision
    candidates = []
    for ridge in ridges:
        # The penalty is relative to the mean square of a standardised control, which is about the number of frames.
        shrunk = np.where(kept, values / np.where(kept, values**2 + ridge * len(standard), 1.0), 0.0)
        matrix = right.T @ (shrunk[:, None] * scores)
        intercept = middle - centre @ matrix
        candidates.append(
            LinearRegressor(layout, scales, matrix.astype(np.float32), intercept.astype(np.float32), ridge)
        )
    return candidates


def save_linear(path: Path, regressor: LinearRegressor, *, model_digest: str) -> None:
    write_regressor(
        path,
        _KIND,
        {"matrix": regressor.matrix, "intercept": regressor.intercept},
        layout=regressor.layout,
        scales=regressor.scales,
        model_digest=model_digest,
        note={"ridge": regressor.ridge},
    )


def load_linear(path: Path, *, model_digest: str) -> LinearRegressor:
    """Raises InputError: the file is damaged, another kind, or belongs to another model."""
    file, layout, scales = read_regressor(path, _KIND, model_digest=model_digest)
    matrix, intercept = file["matrix"], file["intercept"]
    inputs = layout.size + layout.config.history * len(intercept)
    if matrix.shape != (inputs, len(intercept)):
        raise InputError(f"expected a matrix of {(inputs, len(intercept))}, found {matrix.shape}", where=path)
    require_scales(path, scales, controls=inputs, shapes=len(intercept))
    with reading(path, "linear regressor"):
        return LinearRegressor(layout, scales, matrix, intercept, number(file.entry("ridge"), "ridge"))
