"""What a learned garment has to beat: predictions that learn nothing, or little.

The single network and the kernels over the body are `StylesConfig`s, `BASELINES`.

References: TailorNet (CVPR 2020), section 6, whose baseline is the single network.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64, Int

from capture4d.learning.convex_fits import convex_weights
from retarget.mixture.config import StylesConfig
from retarget.mixture.evaluation import Unposed
from retarget.mixture.lesson import PairDrapes, StyleLesson
from retarget.mixture.prototype_weights import squared_distances
from retarget.mixture.styled_garment import StyledGarment

__all__ = ["BASELINES", "blended_prototypes", "nearest_drape", "skinned"]

BASELINES: Mapping[str, StylesConfig] = {
    "mlp": StylesConfig(over="body", members=1, kernels=False),
    "kernel": StylesConfig(over="body", members=0),
}


def skinned(garment: StyledGarment) -> Unposed:
    """The garment in the A-pose, moved by its skin weights alone."""

    def predict(pair: PairDrapes) -> np.ndarray:
        return np.repeat((pair.under + garment.canonical(pair.numbers))[None], len(pair.rotations), axis=0)

    return predict


def nearest_drape(lesson: StyleLesson, garment: StyledGarment) -> Unposed:
    """The prototype that is most alike in the A-pose, in the nearest pose that was learned from."""

    def predict(pair: PairDrapes) -> np.ndarray:
        prototypes = lesson.prototypes
        here = garment.canonical(pair.numbers)
        there = np.stack([garment.canonical(each.numbers) for each in prototypes])
        nearest = prototypes[int(np.argmin(squared_distances(here[None], there)[0]))]
        return pair.under + (nearest.unposed - nearest.under)[_nearest_poses(garment, pair, nearest)]

    return predict


def blended_prototypes(lesson: StyleLesson, garment: StyledGarment) -> Unposed:
    """The convex combination of the prototypes that is most alike in the A-pose, each in its nearest learned pose."""

    def predict(pair: PairDrapes) -> np.ndarray:
        prototypes = lesson.prototypes
        there = np.stack([garment.canonical(each.numbers).ravel() for each in prototypes])
        shares = convex_weights(there, garment.canonical(pair.numbers).ravel())
        blend = sum(
            share * (each.unposed - each.under)[_nearest_poses(garment, pair, each)].astype(np.float64)
            for share, each in zip(shares, prototypes, strict=True)
        )
        return pair.under + blend

    return predict


def _nearest_poses(garment: StyledGarment, pair: PairDrapes, learned: PairDrapes) -> Int[np.ndarray, " drapes"]:
    """For each drape of a pair, the drape of another in the most alike of the poses that may be learned from."""
    ours: Float64[np.ndarray, "drapes numbers"] = garment.pose.of(pair.rotations).astype(np.float64)
    seen = np.flatnonzero(~learned.unseen)
    theirs = garment.pose.of(learned.rotations[seen]).astype(np.float64)
    squares = ((ours[:, None] - theirs[None]) ** 2).sum(axis=2)
    return seen[np.argmin(squares, axis=1)]
