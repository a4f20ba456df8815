"""What kernels compare, as a linear regression of the same frames says; see `kernel`.

Letters: D controls, K coefficients, V views.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from capture4d.errors import InputError
from capture4d.learning.principal_directions import main_directions
from retarget.config import KernelConfig
from retarget.regression.controls import ControlLayout
from retarget.regression.regressors import usual_response
from retarget.shapes.mirroring import opposite_joints

__all__ = ["KINDS", "Views", "control_groups", "kernel_views"]

STILL = 1e-6
"""A side that moves the garment by less than this share of what everything does has no kernels of its own."""
KEPT = 1 - 1e-6
"""Share of the squared response of the garment that is compared."""
KINDS = 3
"""Of views."""


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """What kernels compare."""

    matrices: tuple[Float64[np.ndarray, "controls _"], ...]
    """From standardised controls."""
    kinds: tuple[int, ...]
    """0: everything; 1: what a side contributes; 2: how the joints of a side are turned."""
    weights: Float64[np.ndarray, " views"]
    """Of the kernels."""
    line: float = 0.0
    """Of the linear kernel over everything."""

    def tuned(
        self,
        controls: Float64[np.ndarray, " controls"],
        widths: Float64[np.ndarray, " kinds"],
        shares: Float64[np.ndarray, " kinds"],
        line: float,
    ) -> Views:
        """The same, with factors of the controls, and of the widths and weights of each kind.

        Args:
            line: weight of the linear kernel, which compares what the first view does before that is widened.
        """
        kinds = list(self.kinds)
        matrices = (controls[:, None] * view / width for view, width in zip(self.matrices, widths[kinds], strict=True))
        return Views(tuple(matrices), self.kinds, self.weights * shares[kinds], line * float(widths[0]) ** 2)


def kernel_views(
    known: Float32[np.ndarray, "frames controls"],
    offsets: Float64[np.ndarray, "frames shapes"],
    layout: ControlLayout,
    config: KernelConfig,
) -> Views:
    """What a linear regression says: everything has a third of the weight, what the sides contribute another, and their
    rotations the last."""
    response = main_directions(usual_response(known, offsets), KEPT)
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


def control_groups(layout: ControlLayout) -> Int64[np.ndarray, " controls"]:
    """Which controls are tuned as one, (D,) numbers from 0: the rotations of a joint with those of its partner, and all
    that there is of any other kind."""
    _, pairs = np.unique(np.minimum(layout.joints, _opposite(layout)), return_inverse=True)
    sets, lags = layout.rotation_sets, len(layout.config.lags)
    others = layout.kinds[sets : len(layout.kinds) - lags]
    parts = [number * (pairs.max(initial=0) + 1) + np.repeat(pairs, 6) for number in range(sets)]
    for count in (*others, *(6 * len(layout.joints) for _ in range(sets * lags))):
        parts.append(np.full(count, parts[-1].max(initial=0) + 1))
    return np.concatenate(parts)
