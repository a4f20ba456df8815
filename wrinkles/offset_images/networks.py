"""Networks from a pose to offsets of cloth pixels.

A pose is the rotation matrices of some joints, flattened: 90 numbers for the ten of the paper's T-shirt.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 5 and 6 and appendix.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["FullyConnected", "ImageDecoder", "PcaFullyConnected"]


class ImageDecoder(nn.Module):
    """Pose to the front and back images of a whole shirt: 90 numbers to 256 x 256 x 6 in 3,785,322 parameters.

    The first layer is an 8 x 8 transposed convolution on a 1 x 1 image; five more double the size and halve the
    channels. All carry biases: the count that the paper prints tells. `mean` is an image that is added to what comes
    out; the paper has none (zeros), so its layers learn the garment's own shape besides how it moves.
    """

    mean: Tensor

    def __init__(self, pose_size: int = 90, *, channels: int = 384, doublings: int = 5) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.ConvTranspose2d(pose_size, channels, 8), nn.ReLU()]
        for _ in range(doublings):
            layers += [nn.ConvTranspose2d(channels, channels // 2, 4, 2, 1), nn.BatchNorm2d(channels // 2), nn.ReLU()]
            channels //= 2
        self.layers = nn.Sequential(*layers, nn.Conv2d(channels, 6, 3, 1, 1))
        self.register_buffer("mean", torch.zeros(6, 1, 1).repeat(1, 8 << doublings, 8 << doublings))

    def forward(self, pose: Float[Tensor, "B pose"]) -> Float[Tensor, "B 6 size size"]:
        return self.mean + self.layers(pose[:, :, None, None])


class FullyConnected(nn.Module):
    """The baseline without images: pose to all offsets, two hidden layers of 256."""

    def __init__(self, pose_size: int, pixels: int, *, hidden: int = 256) -> None:
        super().__init__()
        self.layers = _perceptron(pose_size, hidden, 3 * pixels)

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
        self.layers = _perceptron(pose_size, hidden, count)
        self.register_buffer("mean", mean.float())
        self.register_buffer("basis", (scale[:, None] * basis[:count]).float())

    def forward(self, pose: Float[Tensor, "B pose"]) -> Float[Tensor, "B P 3"]:
        return (self.mean + self.layers(pose) @ self.basis).unflatten(1, (-1, 3))


def _perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs)
    )
