"""What says how a garment is displaced: an ensemble of networks and kernels, or the paper's mixture of prototypes.

Letters: N poses, F numbers of a pose, P numbers of a pair of style and shape, K prototypes.

References: TailorNet (CVPR 2020), equation 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from torch import nn

from retarget.mixture.heads import Head
from retarget.mixture.kernel_ridge import KernelRidge
from retarget.mixture.prototype_weights import prototype_weights, squared_distances
from retarget.mixture.training import said_by

__all__ = ["SPEAKS", "Ensemble", "Mixture", "Predictor", "joined"]

SPEAKS = 1e-3
"""Prototypes of less weight are not asked."""


def joined(pose: Float32[np.ndarray, "N F"], numbers: Float64[np.ndarray, " P"]) -> Float32[np.ndarray, "N both"]:
    """A pose, and whose it is."""
    return np.column_stack([pose, np.repeat(numbers[None].astype(np.float32), len(pose), axis=0)])


@dataclass(frozen=True, slots=True, eq=False)
class Ensemble:
    """The mean of what networks say, and of that and what kernels say."""

    head: Head
    networks: Sequence[nn.Sequential]
    kernels: KernelRidge | None
    style_weight: float
    """By how much a number of style or shape counts in the kernels."""

    def displacements(
        self, pose: Float32[np.ndarray, "N F"], numbers: Float64[np.ndarray, " P"], canonical: np.ndarray
    ) -> Float64[np.ndarray, "N V 3"]:
        """Metres.

        Args:
            canonical: displacements in the A-pose, which an ensemble has no use for.
        """
        said: list[np.ndarray] = []
        if self.networks:
            inputs = joined(pose, numbers)
            answers = np.stack([said_by(network, inputs) for network in self.networks])
            said.append(np.asarray(answers.mean(axis=0, dtype=np.float64)))
        if self.kernels is not None:
            said.append(self.kernels.predict(joined(pose, self.style_weight * numbers)))
        return self.head.decoded(np.mean(said, axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class Mixture:
    """What is smooth from one network, the rest from the prototypes that are alike in the A-pose."""

    low_head: Head
    low: nn.Sequential
    high_head: Head
    high: Sequence[nn.Sequential]
    """A network for each prototype, which sees the pose alone."""
    prototypes: Float64[np.ndarray, "K V 3"]
    """Their displacements in the A-pose, g(phi_k), metres."""
    bandwidth: float
    normalised: bool

    def weights(self, canonical: Float64[np.ndarray, "V 3"]) -> Float64[np.ndarray, " K"]:
        """psi of each prototype.

        Args:
            canonical: g(phi), displacements in the A-pose, metres.
        """
        distances = squared_distances(canonical[None], self.prototypes)[0]
        return prototype_weights(distances, self.bandwidth, normalised=self.normalised)

    def displacements(
        self, pose: Float32[np.ndarray, "N F"], numbers: Float64[np.ndarray, " P"], canonical: np.ndarray
    ) -> Float64[np.ndarray, "N V 3"]:
        """Metres; equation 8."""
        low = self.low_head.decoded(said_by(self.low, joined(pose, numbers)))
        weights = self.weights(canonical)
        high = np.zeros_like(low)
        for weight, network in zip(weights, self.high, strict=True):
            if weight >= SPEAKS:
                high += weight * self.high_head.decoded(said_by(network, pose))
        return low + high


Predictor = Ensemble | Mixture
