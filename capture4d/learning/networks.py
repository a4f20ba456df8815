"""Networks from a few numbers, a pose say, to an image and to a vector: torch in, torch out.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 5 and 6 and appendix.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["ImageDecoder", "perceptron"]


class ImageDecoder(nn.Module):
    """Numbers to an image, `first` texels wide and doubled so many times: by default the 90 of a pose to the front and
    back images of a whole shirt, 256 x 256 x 6, in 3,785,322 parameters.

    The first layer is a transposed convolution on a 1 x 1 image, or fully connected layers make the first texels; the
    others double the size and halve the channels. All carry biases: the count that the paper prints tells. `mean` is
    an image that is added to what comes out; the paper has none (zeros), so its layers learn the garment's own shape
    besides how it moves.
    """

    mean: Tensor

    def __init__(
        self,
        inputs: int = 90,
        *,
        outputs: int = 6,
        first: int | tuple[int, int] = 8,
        channels: int = 384,
        doublings: int = 5,
        shuffled: int = 0,
        hidden: Sequence[int] | None = None,
    ) -> None:
        """Weights are random, `mean` is zero.

        Args:
            first: texels of the first map, a side or rows and columns.
            shuffled: doublings at the end that one convolution does by pixel shuffle (Shi et al., Real-time single
                image and video super-resolution, CVPR 2016): as many parameters, in about half the time.
            hidden: sizes of fully connected layers before the one that makes the first map; None has a transposed
                convolution make it.
        """
        super().__init__()
        rows, columns = (first, first) if isinstance(first, int) else first
        layers: list[nn.Module] = []
        if hidden is None:
            layers += [nn.ConvTranspose2d(inputs, channels, (rows, columns)), nn.ReLU()]
        else:
            sizes = [inputs, *hidden, channels * rows * columns]
            for size, after in pairwise(sizes):
                layers += [nn.Linear(size, after), nn.ReLU()]
            layers.append(nn.Unflatten(1, (channels, rows, columns)))
        for _ in range(doublings - shuffled):
            layers += [nn.ConvTranspose2d(channels, channels // 2, 4, 2, 1), nn.BatchNorm2d(channels // 2), nn.ReLU()]
            channels //= 2
        layers.append(nn.Conv2d(channels, outputs << 2 * shuffled, 3, 1, 1))
        layers += [nn.PixelShuffle(1 << shuffled)] if shuffled else []
        self.convolved = hidden is None
        self.layers = nn.Sequential(*layers)
        self.register_buffer("mean", torch.zeros(outputs, 1, 1).repeat(1, rows << doublings, columns << doublings))

    @property
    def last(self) -> nn.Conv2d:
        """The layer that makes the values of the image."""
        return next(each for each in self.layers if isinstance(each, nn.Conv2d))

    def forward(self, known: Float[Tensor, "B inputs"]) -> Float[Tensor, "B outputs rows columns"]:
        return self.mean + self.layers(known[:, :, None, None] if self.convolved else known)


def perceptron(inputs: int, hidden: int, outputs: int, *, dropout: float = 0.0) -> nn.Sequential:
    """Two hidden layers of the same width; with dropout, a layer of it after the first."""
    first: list[nn.Module] = [nn.Linear(inputs, hidden), nn.ReLU(), *([nn.Dropout(dropout)] if dropout else [])]
    return nn.Sequential(*first, nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs))
