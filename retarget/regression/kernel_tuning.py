"""What kernels go by, tuned so that takes foretell each other.

Each take in turn is left out and foretold from the others, and what the kernels compare is changed until that goes
best: how much each control counts, how wide each kind of kernel is, and which share it has. A joint and its partner on
the other side are tuned as one. The linear regression that says where the garment goes knows nothing of the take that
is left out either: if it does, tuning trusts it too much.

References: Rasmussen and Williams, Gaussian Processes for Machine Learning (MIT Press, 2006), section 5.1 for the
relevance of inputs, 5.3 for cross-validation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int
from scipy.optimize import minimize

from capture4d.learning.principal_directions import main_directions
from retarget.config import KernelTuningConfig
from retarget.regression.kernel_views import KINDS, Views

__all__ = ["Fold", "Tuning", "tune_kernels"]

LARGEST = 6.0
"""No logarithm is tuned beyond this, which keeps the likeness invertible."""


@dataclass(frozen=True, slots=True, eq=False)
class Tuning:
    """Factors, all 1 before tuning, and the weight of the linear kernel."""

    controls: Float64[np.ndarray, " controls"]
    """Of the standardised controls."""
    widths: Float64[np.ndarray, " kinds"]
    """Of each kind of view: by how much alike frames may differ."""
    shares: Float64[np.ndarray, " kinds"]
    """Of the weight of each kind of view."""
    line: float
    """The weight itself."""


def tune_kernels(
    known: Float32[np.ndarray, "frames controls"],
    offsets: Float64[np.ndarray, "frames shapes"],
    takes: Int[np.ndarray, " frames"],
    without: Sequence[Views],
    *,
    groups: Int[np.ndarray, " controls"],
    ridge: float,
    config: KernelTuningConfig,
) -> Tuning:
    """Factors with which takes are foretold best by the others.

    Args:
        known: standardised controls.
        offsets: coefficients about their mean.
        takes: which take each frame is from, its mirror image included: 0, 1, ...
        without: for each take, what the kernels compare as learned from the others.
        groups: which controls share a factor: 0, 1, ...
    """
    rows = np.linspace(0, len(known) - 1, min(len(known), config.frames)).round().astype(int)
    ridge *= len(rows) / len(known)  # each of them stands for several, whose errors are averaged
    controls = torch.from_numpy(known[rows].astype(np.float64))
    wanted = torch.from_numpy(main_directions(offsets[rows], config.kept))
    folds = [Fold.create(takes[rows] == take, views) for take, views in enumerate(without) if take in takes[rows]]
    group = torch.from_numpy(groups)
    sizes = [int(groups.max()) + 1, KINDS, KINDS, 1]

    def factors(logs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        relevance, widths, shares, line = logs.split(sizes)
        return (relevance / 2).exp()[group], widths.exp(), shares.exp(), config.line * line.exp()

    def loss(logs: np.ndarray) -> tuple[float, np.ndarray]:
        total, slope = config.restraint * float((logs**2).sum()), 2 * config.restraint * logs
        for fold in folds:  # one after the other, so that the memory of one is enough
            at = torch.from_numpy(logs.copy()).requires_grad_()
            scale, widths, shares, line = factors(at)
            error = fold.squared_error(controls * scale, wanted, widths, shares, line, ridge)
            off = error.clamp(min=1e-30).log() / len(folds)
            off.backward()
            assert at.grad is not None
            total, slope = total + float(off.detach()), slope + at.grad.numpy()
        return total, slope

    found = minimize(
        loss, np.zeros(sum(sizes)), jac=True, method="L-BFGS-B",
        bounds=[(-LARGEST, LARGEST)] * sum(sizes), options={"maxiter": config.rounds},
    )  # fmt: skip
    scale, widths, shares, line = factors(torch.from_numpy(found.x))
    return Tuning(scale.numpy(), widths.numpy(), shares.numpy(), float(line))


@dataclass(frozen=True, slots=True, eq=False)
class Fold:
    """One take that is left out."""

    inside: torch.Tensor
    """Rows of the take."""
    outside: torch.Tensor
    views: list[torch.Tensor]
    kinds: tuple[int, ...]
    weights: list[float]

    @staticmethod
    def create(inside: np.ndarray, views: Views) -> Fold:
        return Fold(
            torch.from_numpy(np.flatnonzero(inside)),
            torch.from_numpy(np.flatnonzero(~inside)),
            [torch.from_numpy(view) for view in views.matrices],
            views.kinds,
            views.weights.tolist(),
        )

    def squared_error(
        self,
        controls: torch.Tensor,
        wanted: torch.Tensor,
        widths: torch.Tensor,
        shares: torch.Tensor,
        line: torch.Tensor,
        ridge: float,
    ) -> torch.Tensor:
        """Mean over the take's frames of what ridge regression from the others is off, squared."""
        everything = controls @ self.views[0]
        alike = line * everything @ everything[self.outside].T
        for view, kind, weight in zip(self.views, self.kinds, self.weights, strict=True):
            features = controls @ view
            squares = _squares(features, features[self.outside])
            alike = alike + weight * shares[kind] * torch.exp(-squares / (2 * widths[kind] ** 2))
        learned = alike[self.outside] + ridge * torch.eye(len(self.outside), dtype=torch.float64)
        middle = wanted[self.outside].mean(dim=0)
        answers = torch.cholesky_solve(wanted[self.outside] - middle, torch.linalg.cholesky(learned))
        return ((alike[self.inside] @ answers + middle - wanted[self.inside]) ** 2).sum(dim=1).mean()


def _squares(ours: torch.Tensor, theirs: torch.Tensor) -> torch.Tensor:
    """Squared distances of all rows to all."""
    return ((ours**2).sum(dim=1)[:, None] + (theirs**2).sum(dim=1) - 2 * ours @ theirs.T).clamp(min=0)
