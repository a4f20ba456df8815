"""The baselines of the decoder: networks from a pose to offsets of cloth pixels.

A pose is the rotation matrices of some joints, flattened: 90 numbers for the ten of the paper's T-shirt.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 5 and 6 and appendix.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from capture4d.learning.networks import perceptron

__all__ = ["FullyConnected", "PcaFullyConnected"]


class FullyConnected(nn.Module):
    """The baseline without images: pose to all offsets, two hidden layers of 256."""

    def __init__(self, pose_size: int, pixels: int, *, hidden: int = 256) -> None:
        super().__init__()
        self.layers = perceptron(pose_size, hidden, 3 * pixels)

    def forward(self, pose: Float[Tensor, "B pose"]) -> Float[Tensor, "B P 3"]:
        return self.layers(pose).unflatten(1, (-1, 3))


class PcaFullyConnected(nn.Module):
    """The baseline with PCA: pose to coefficients of the offsets' principal components."""

    def __init__(
        self, pose_size: int, offsets: Float[Tensor, "frames P 3"], *, components: int, hidden: int = 256
    ) -> None:
        """Analyse the training offsets; components beyond their rank are left out."""
        super().__init__()
        flat = offsets.flatten(1).double()
        mean = flat.mean(dim=0)
        _, strength, basis = torch.linalg.svd(flat - mean, full_matrices=False)
        count = min(components, int((strength > 1e-9 * strength[0].clamp(min=1e-30)).sum().clamp(min=1)))
        scale = (strength[:count] / max(len(flat) - 1, 1) ** 0.5).clamp(min=1e-12)
        self.layers = perceptron(pose_size, hidden, count)
        self.register_buffer("mean", mean.float())
        self.register_buffer("basis", (scale[:, None] * basis[:count]).float())

    def forward(self, pose: Float[Tensor, "B pose"]) -> Float[Tensor, "B P 3"]:
        return (self.mean + self.layers(pose) @ self.basis).unflatten(1, (-1, 3))
