"""What kernels go by, tuned so that takes foretell each other.

Each take in turn is left out and foretold from the others, and what the kernels compare is changed until that goes
best: how much each control counts, how wide each kind of kernel is, and which share it has. A joint and its partner on
the other side are tuned as one. The answers for a left-out take follow from the one inverse of all frames' likeness
(`left_out_errors`), so a round costs little more than a fit.

References: Rasmussen and Williams, Gaussian Processes for Machine Learning (MIT Press, 2006), section 5.4.2, for one
frame at a time; relevance of inputs: section 5.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int, Int64
from scipy.optimize import minimize

from retarget.config import KernelTuningConfig

__all__ = ["Tuning", "left_out_errors", "tune_kernels"]

LARGEST = 6.0
"""No logarithm is tuned beyond this, which keeps the likeness invertible."""


@dataclass(frozen=True, slots=True, eq=False)
class Tuning:
    """Factors; all 1 before tuning."""

    controls: Float64[np.ndarray, " controls"]
    """Of the standardised controls."""
    widths: Float64[np.ndarray, " views"]
    """Of the views: by how much alike frames may differ."""
    shares: Float64[np.ndarray, " views"]
    """Of the kernels' weights."""


def tune_kernels(
    known: Float32[np.ndarray, "frames controls"],
    offsets: Float64[np.ndarray, "frames shapes"],
    takes: Int[np.ndarray, " frames"],
    *,
    views: Sequence[Float[np.ndarray, "controls _"]],
    shares: Float[np.ndarray, " views"],
    kinds: Sequence[int],
    groups: Int[np.ndarray, " controls"],
    ridge: float,
    config: KernelTuningConfig,
) -> Tuning | None:
    """Factors with which takes are foretold best by the others; None if there are not enough takes to tell.

    Args:
        known: standardised controls.
        offsets: coefficients about their mean.
        takes: which take each frame is from, its mirror image included.
        views: from standardised controls to what a kernel compares.
        shares: weights of the kernels.
        kinds: which views share a width and a factor of their weight, 0, 1, ...
        groups: which controls share a factor, 0, 1, ...
    """
    rows = np.linspace(0, len(known) - 1, min(len(known), config.frames)).round().astype(int)
    left_out = [torch.from_numpy(np.flatnonzero(takes[rows] == take)) for take in np.unique(takes[rows])]
    if len(left_out) < config.least_takes:
        return None
    controls = torch.from_numpy(known[rows].astype(np.float64))
    wanted = torch.from_numpy(_main_directions(offsets[rows], config.kept))
    seen = [torch.from_numpy(np.asarray(view, np.float64)) for view in views]
    weights, kind, group = torch.from_numpy(np.asarray(shares, np.float64)), torch.tensor(kinds), torch.tensor(groups)
    sizes = [int(groups.max()) + 1, max(kinds) + 1, max(kinds) + 1]
    still = ridge * torch.eye(len(rows), dtype=torch.float64)

    def factors(logs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        relevance, widths, amounts = logs.split(sizes)
        return (relevance / 2).exp()[group], widths.exp()[kind], amounts.exp()[kind]

    def loss(logs: np.ndarray) -> tuple[float, np.ndarray]:
        at = torch.from_numpy(logs.copy()).requires_grad_()
        scale, widths, amounts = factors(at)
        likeness = still
        for view, width, amount in zip(seen, widths, amounts * weights, strict=True):
            features = (controls * scale) @ view
            likeness = likeness + amount * torch.exp(-_squares(features) / (2 * width**2))
        errors = left_out_errors(likeness, wanted, left_out)
        off = torch.stack([(error**2).sum(dim=1).mean() for error in errors]).mean()
        total = off.clamp(min=1e-30).log() + config.restraint * (at**2).sum()
        total.backward()
        assert at.grad is not None
        return float(total.detach()), at.grad.numpy()

    found = minimize(
        loss, np.zeros(sum(sizes)), jac=True, method="L-BFGS-B",
        bounds=[(-LARGEST, LARGEST)] * sum(sizes), options={"maxiter": config.rounds},
    )  # fmt: skip
    scale, widths, amounts = factors(torch.from_numpy(found.x))
    return Tuning(scale.numpy(), widths.numpy(), amounts.numpy())


def left_out_errors(
    likeness: Float64[torch.Tensor, "frames frames"],
    wanted: Float64[torch.Tensor, "frames shapes"],
    left_out: Sequence[Int64[torch.Tensor, " _"]],
) -> list[Float64[torch.Tensor, "_ shapes"]]:
    """What ridge regression by kernels is off at frames that it has not learned from, for each set of them in turn.

    With A the inverse of K + ridge I, the errors at the frames B are (A_BB)^-1 (A wanted)_B: the block form of the
    leave-one-out formula.

    Args:
        likeness: K + ridge I.
    """
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(likeness))
    answers = inverse @ wanted
    return [torch.linalg.solve(inverse[out][:, out], answers[out]) for out in left_out]


def _squares(features: torch.Tensor) -> torch.Tensor:
    """Squared distances of all rows."""
    lengths = (features**2).sum(dim=1)
    return (lengths[:, None] + lengths - 2 * features @ features.T).clamp(min=0)


def _main_directions(
    offsets: Float64[np.ndarray, "frames shapes"], kept: float
) -> Float64[np.ndarray, "frames directions"]:
    """Offsets along as many principal directions as hold a share of their square; tuning needs no more."""
    left, values, _ = np.linalg.svd(offsets, full_matrices=False)
    held = np.cumsum(values**2) / max(float((values**2).sum()), 1e-30)
    count = int(np.searchsorted(held, kept)) + 1
    return (left * values)[:, :count]
