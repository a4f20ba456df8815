"""Kernels and network together: the mean of their answers errs less than either, for they err differently.

Kernels remember poses, the network goes on between them. The kernels' control vector holds the network's, so one vector
drives both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int64

from retarget.regression.controls import ControlLayout
from retarget.regression.known_range import KnownRange
from retarget.regression.regressors import Regressor

__all__ = ["EnsembleRegressor", "ensemble", "regressors_by_name"]

NETWORK_SHARE = 0.25
"""Weight of the network. At 0.4 the ensemble's mean square is within 2 % of what it is here, at 0.5 within 4 %."""


@dataclass(frozen=True, slots=True, eq=False)
class EnsembleRegressor:
    """The weighted mean of two regressors, of which the second sees some of the controls of the first."""

    first: Regressor
    second: Regressor
    columns: Int64[np.ndarray, " controls"]
    """Where the controls of the second stand among those of the first."""
    share: float
    """Weight of the second."""

    @property
    def layout(self) -> ControlLayout:
        return self.first.layout

    def stream(self) -> EnsembleStream:
        return EnsembleStream(self)

    def predict(self, controls: Float32[np.ndarray, "frames controls"]) -> Float32[np.ndarray, "frames shapes"]:
        known = np.asarray(controls).reshape(-1, self.layout.size)
        return self.mean(self.first.predict(known), self.second.predict(known[:, self.columns]))

    def mean(
        self, first: Float32[np.ndarray, "*frames shapes"], second: Float32[np.ndarray, "*frames shapes"]
    ) -> Float32[np.ndarray, "*frames shapes"]:
        return ((1 - self.share) * first + self.share * second).astype(np.float32)


class EnsembleStream:
    """A motion that is answered frame by frame."""

    def __init__(self, regressor: EnsembleRegressor) -> None:
        self._regressor = regressor
        self._first, self._second = regressor.first.stream(), regressor.second.stream()

    def push(self, controls: Float[np.ndarray, " controls"]) -> Float32[np.ndarray, " shapes"]:
        known = np.asarray(controls)
        return self._regressor.mean(self._first.push(known), self._second.push(known[self._regressor.columns]))


def ensemble(kernel: Regressor, network: Regressor) -> EnsembleRegressor | None:
    """Kernels and network as one; None if the kernels do not see all that the network sees."""
    columns = kernel.layout.columns_of(network.layout)
    return None if columns is None else EnsembleRegressor(kernel, network, columns, NETWORK_SHARE)


def regressors_by_name(
    known: KnownRange, linear: Regressor, lstm: Regressor | None, kernel: Regressor | None
) -> dict[str, Regressor]:
    """The regressors that there are, within what is known."""
    single = {"linear": linear, "lstm": lstm, "kernel": kernel}
    found: dict[str, Regressor] = {name: known.bounded(name, each) for name, each in single.items() if each is not None}
    both = ensemble(found["kernel"], found["lstm"]) if {"kernel", "lstm"} <= {*found} else None
    return found if both is None else {**found, "ensemble": both}
