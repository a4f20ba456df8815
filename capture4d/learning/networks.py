"""Networks from a few numbers, a pose say, to an image and to a vector: torch in, torch out.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 5 and 6 and appendix.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["ImageDecoder", "perceptron"]


class ImageDecoder(nn.Module):
    """Numbers to an image, `first` texels wide and doubled so many times: by default the 90 of a pose to the front and
    back images of a whole shirt, 256 x 256 x 6, in 3,785,322 parameters.

    The first layer is a transposed convolution on a 1 x 1 image; the others double the size and halve the channels.
    All carry biases: the count that the paper prints tells. `mean` is an image that is added to what comes out; the
    paper has none (zeros), so its layers learn the garment's own shape besides how it moves.
    """

    mean: Tensor

    def __init__(
        self, inputs: int = 90, *, outputs: int = 6, first: int = 8, channels: int = 384, doublings: int = 5
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.ConvTranspose2d(inputs, channels, first), nn.ReLU()]
        for _ in range(doublings):
            layers += [nn.ConvTranspose2d(channels, channels // 2, 4, 2, 1), nn.BatchNorm2d(channels // 2), nn.ReLU()]
            channels //= 2
        self.layers = nn.Sequential(*layers, nn.Conv2d(channels, outputs, 3, 1, 1))
        self.register_buffer("mean", torch.zeros(outputs, 1, 1).repeat(1, first << doublings, first << doublings))

    def forward(self, known: Float[Tensor, "B inputs"]) -> Float[Tensor, "B outputs size size"]:
        return self.mean + self.layers(known[:, :, None, None])


def perceptron(inputs: int, hidden: int, outputs: int, *, dropout: float = 0.0) -> nn.Sequential:
    """Two hidden layers of the same width; with dropout, a layer of it after the first."""
    first: list[nn.Module] = [nn.Linear(inputs, hidden), nn.ReLU(), *([nn.Dropout(dropout)] if dropout else [])]
    return nn.Sequential(*first, nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs))
