"""The networks of offset images, and their baselines: from a pose to images, to offsets of cloth pixels, or to
coefficients of their principal components.

A pose is the rotation matrices of some joints, flattened: 90 numbers for the ten of the paper's T-shirt, 36 for the
four of its necktie. Letters: B frames of a batch, P cloth pixels.

| network | paper's layout | parameters |
|---|---|---|
| `whole_decoder` | 8 x 8 x 384 to 256 x 256 x 6 | 3,785,322 |
| `patch_decoder` | 5 x 5 x 512 to 160 x 160 x 3 | 3,960,195 |
| `strip_decoder` | 8 x 32 x 64 to 64 x 256 x 3 | 2,161,667 |
| `FullyConnected` | 256, 256, 3 m | 2,402,088 for m = 3,000 |
| `PcaFullyConnected` | 256, 256, 128 | 121,984 |

The paper prints 8 x 8 x 64 for the necktie's first map, which neither reaches 64 x 256 nor has as many parameters.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 5 and 6 and appendix.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from capture4d.learning.networks import ImageDecoder, perceptron
from capture4d.learning.principal_directions import exact_directions, randomised_directions

__all__ = [
    "FullyConnected",
    "PcaFullyConnected",
    "image_decoder",
    "patch_decoder",
    "principal_offsets",
    "strip_decoder",
    "whole_decoder",
]

EXACT_ROWS = 1000
"""Principal directions of more frames are found by subspace iteration."""


def image_decoder(pose_size: int, size: int) -> ImageDecoder:
    """A decoder to front and back of a shirt, images of this many texels a side, a power of two: the paper's at 256,
    smaller ones in its proportions."""
    return whole_decoder(pose_size, size)


def whole_decoder(pose_size: int, size: int = 256, *, shuffled: int = 0) -> ImageDecoder:
    """`image_decoder`, whose last doublings may be done by one convolution."""
    doublings = size.bit_length() - 4
    channels = max(size * 3 // 2, 2**doublings)
    return ImageDecoder(pose_size, channels=channels, doublings=doublings, shuffled=min(shuffled, doublings))


def patch_decoder(pose_size: int, side: int = 160, *, channels: int = 512, shuffled: int = 0) -> ImageDecoder:
    """A decoder to a square of one image, so many texels a side: 80, 160, or any number that is doubled from a small
    one."""
    doublings = min((side & -side).bit_length() - 1, channels.bit_length() - 1, 5)
    return ImageDecoder(
        pose_size, outputs=3, first=side >> doublings, channels=channels, doublings=doublings,
        shuffled=min(shuffled, doublings), hidden=(),
    )  # fmt: skip


def strip_decoder(pose_size: int, rows: int = 64, columns: int = 256, *, channels: int = 64) -> ImageDecoder:
    """A decoder to a strip of one image, such as a necktie, through a fully connected layer of 128."""
    first = (rows >> 3, columns >> 3)
    return ImageDecoder(pose_size, outputs=3, first=first, channels=channels, doublings=3, hidden=(128,))


def principal_offsets(
    offsets: Float[Tensor, "frames P 3"], components: int
) -> tuple[Float[Tensor, " values"], Float[Tensor, "components values"], Float[Tensor, " components"]]:
    """Mean, orthonormal directions and standard deviations of offsets, 3 P values each; directions without extent are
    left out, so that there may be fewer, but at least one."""
    flat = offsets.flatten(1).double().numpy()
    mean = flat.mean(axis=0)
    count, columns = flat.shape

    def rows(part: slice) -> np.ndarray:
        return flat[part] - mean

    if count <= EXACT_ROWS:
        directions, values = exact_directions(rows, count, columns, components)
    else:
        directions, values = randomised_directions(rows, count, columns, components, np.random.default_rng(0))
    if not len(values):
        directions, values = np.eye(1, columns), np.zeros(1)
    deviations = values / max(count - 1, 1) ** 0.5
    return (
        torch.from_numpy(mean).float(),
        torch.from_numpy(np.ascontiguousarray(directions)).float(),
        torch.from_numpy(deviations).float(),
    )


class FullyConnected(nn.Module):
    """The baseline without images: pose to all offsets, two hidden layers of 256."""

    def __init__(self, pose_size: int, pixels: int, *, hidden: int = 256) -> None:
        super().__init__()
        self.layers = perceptron(pose_size, hidden, 3 * pixels)

    def forward(self, pose: Float[Tensor, "B pose"]) -> Float[Tensor, "B P 3"]:
        return self.layers(pose).unflatten(1, (-1, 3))


class PcaFullyConnected(nn.Module):
    """The baseline with PCA: pose to coefficients of the offsets' principal components.

    It learns the coefficients themselves, all in units of the first one's standard deviation: the length of an
    error of coefficients is then that of one of offsets.
    """

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
        mean, directions, deviations = principal_offsets(offsets, components)
        network = PcaFullyConnected(pose_size, offsets.shape[1], components=len(directions), hidden=hidden)
        network.mean.copy_(mean)
        network.basis.copy_(deviations[0].clamp(min=1e-12) * directions)
        return network

    def coefficients(self, offsets: Float[Tensor, "B P 3"]) -> Float[Tensor, "B components"]:
        """What the layers should give: the offsets' coordinates along the components."""
        lengths = self.basis.square().sum(dim=1).clamp(min=1e-30)
        return (offsets.flatten(1) - self.mean) @ self.basis.T / lengths

    def forward(self, pose: Float[Tensor, "B pose"]) -> Float[Tensor, "B P 3"]:
        return (self.mean + self.layers(pose) @ self.basis).unflatten(1, (-1, 3))
