"""Generator and discriminator of the wrinkle GAN: pix2pix's U-Net and PatchGAN, torch in, torch out.

With 64 filters and 8 layers on 3-channel maps they have 54,413,955 and 2,768,705 parameters.

References: DeepWrinkles (ECCV 2018), section 4.1; Isola et al., Image-to-image translation with conditional
adversarial networks, CVPR 2017, appendix 6.1; Ronneberger et al. 2015.
"""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from wrinkles.normal_maps.config import NetworkConfig

__all__ = ["PatchDiscriminator", "UNet", "set_test_statistics"]

Image = Float[Tensor, "batch 3 size size"]


class UNet(nn.Module):
    """Low-resolution normals in, high-resolution normals out.

    `layers` 4x4 convolutions of stride 2 down, as many up, each of these fed with its mirror image on the way down.
    Values outside the unit ball are possible; whoever uses a map normalises it.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.output = config.output
        width = [config.filters * min(2**layer, 8) for layer in range(config.layers)]
        last = config.layers - 1
        self.down = nn.ModuleList(
            nn.Sequential(
                *([nn.LeakyReLU(0.2)] if layer else []),
                nn.Conv2d(width[layer - 1] if layer else 3, width[layer], 4, 2, 1, bias=False),
                *([nn.BatchNorm2d(width[layer])] if 0 < layer < last else []),
            )
            for layer in range(config.layers)
        )
        # The inner layers, all of the full width, are those that drop out, but for the innermost.
        dropping = range(4, last) if config.dropout > 0 else range(0)
        self.up = nn.ModuleList(
            nn.Sequential(
                nn.ReLU(),
                nn.ConvTranspose2d(
                    width[layer] * (1 if layer == last else 2),
                    width[layer - 1] if layer else 3,
                    4,
                    2,
                    1,
                    bias=not layer,
                ),
                *([nn.BatchNorm2d(width[layer - 1])] if layer else [nn.Tanh()]),
                *([nn.Dropout(config.dropout)] if layer in dropping else []),
            )
            for layer in reversed(range(config.layers))
        )
        self.apply(_initialise)

    def forward(self, low: Image) -> Image:
        painted = self.paint(low)
        return low + painted if self.output == "residual" else painted

    def paint(self, low: Image) -> Image:
        """What the last layer says: the map, or what to add to the low one."""
        passed = [low]
        for layer in self.down:
            passed.append(layer(passed[-1]))
        image = passed.pop()
        for layer in self.up:
            image = layer(image)
            beside = passed.pop()
            if passed:
                image = torch.cat([beside, image], dim=1)
        return image


class PatchDiscriminator(nn.Module):
    """Judges 70x70 patches of a map beside the map it was made from: one logit each."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        f = config.filters
        self.layers = nn.Sequential(
            nn.Conv2d(6, f, 4, 2, 1),
            nn.LeakyReLU(0.2),
            *_block(f, 2 * f, stride=2),
            *_block(2 * f, 4 * f, stride=2),
            *_block(4 * f, 8 * f, stride=1),
            nn.Conv2d(8 * f, 1, 4, 1, 1),
        )
        self.apply(_initialise)

    def forward(self, low: Image, high: Image) -> Float[Tensor, "batch 1 rows columns"]:
        return self.layers(torch.cat([low, high], dim=1))


def set_test_statistics(network: nn.Module, statistics: Literal["instance", "running"]) -> None:
    """Evaluation mode, with batch norm on the statistics of each map (pix2pix's habit) or on training's means."""
    network.eval()
    if statistics == "instance":
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.train()
                module.momentum = 0.0  # look, but do not learn


def _block(before: int, after: int, *, stride: int) -> tuple[nn.Module, ...]:
    return nn.Conv2d(before, after, 4, stride, 1, bias=False), nn.BatchNorm2d(after), nn.LeakyReLU(0.2)


def _initialise(module: nn.Module) -> None:
    if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)):
        nn.init.normal_(module.weight, 0.0, 0.02)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, nn.BatchNorm2d):
        nn.init.normal_(module.weight, 1.0, 0.02)
        nn.init.zeros_(module.bias)
