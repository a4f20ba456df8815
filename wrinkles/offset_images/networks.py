"""The baselines of the decoder: networks from a pose to offsets of cloth pixels.

A pose is the rotation matrices of some joints, flattened: 90 numbers for the ten of the paper's T-shirt.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 5 and 6 and appendix.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from capture4d.learning.networks import ImageDecoder, perceptron

__all__ = ["FullyConnected", "PcaFullyConnected", "image_decoder"]


def image_decoder(pose_size: int, size: int) -> ImageDecoder:
    """A decoder to front and back of a shirt, images of this many texels a side, a power of two: the paper's at 256,
    smaller ones in its proportions."""
    doublings = size.bit_length() - 4
    return ImageDecoder(pose_size, channels=max(size * 3 // 2, 2**doublings), doublings=doublings)


class FullyConnected(nn.Module):
    """The baseline without images: pose to all offsets, two hidden layers of 256."""

    def __init__(self, pose_size: int, pixels: int, *, hidden: int = 256) -> None:
        super().__init__()
        self.layers = perceptron(pose_size, hidden, 3 * pixels)

    def forward(self, pose: Float[Tensor, "B pose"]) -> Float[Tensor, "B P 3"]:
        return self.layers(pose).unflatten(1, (-1, 3))


class PcaFullyConnected(nn.Module):
    """The baseline with PCA: pose to coefficients of the offsets' principal components."""

    mean: Tensor
    basis: Tensor

    def __init__(self, pose_size: int, pixels: int, *, components: int, hidden: int = 256) -> None:
        """Its mean and components are zero; `analysed` finds them."""
        super().__init__()
        self.layers = perceptron(pose_size, hidden, components)
        self.register_buffer("mean", torch.zeros(3 * pixels))
        # in memory as the decomposition leaves it: sums come out the same to the bit, however the values got here
        self.register_buffer("basis", torch.zeros(3 * pixels, components).T)

    @staticmethod
    def analysed(
        pose_size: int, offsets: Float[Tensor, "frames P 3"], *, components: int, hidden: int = 256
    ) -> PcaFullyConnected:
        """A fresh one with the principal components of the training offsets; those beyond their rank are left out."""
        flat = offsets.flatten(1).double()
        mean = flat.mean(dim=0)
        _, strength, basis = torch.linalg.svd(flat - mean, full_matrices=False)
        count = min(components, int((strength > 1e-9 * strength[0].clamp(min=1e-30)).sum().clamp(min=1)))
        scale = (strength[:count] / max(len(flat) - 1, 1) ** 0.5).clamp(min=1e-12)
        network = PcaFullyConnected(pose_size, offsets.shape[1], components=count, hidden=hidden)
        network.mean.copy_(mean.float())
        network.basis.copy_((scale[:, None] * basis[:count]).float())
        return network

    def forward(self, pose: Float[Tensor, "B pose"]) -> Float[Tensor, "B P 3"]:
        return (self.mean + self.layers(pose) @ self.basis).unflatten(1, (-1, 3))
