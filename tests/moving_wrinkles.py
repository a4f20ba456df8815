"""A wrinkle generator for the tube of `tests.moving_garment`, as `wrinkles train` leaves one; it adds faint noise."""

from __future__ import annotations

from pathlib import Path

import torch

from tests.moving_garment import cloth
from wrinkles.normal_maps.config import MapConfig, NetworkConfig
from wrinkles.normal_maps.inference import WrinkleModel, generator_path, save_model
from wrinkles.normal_maps.networks import UNet
from wrinkles.normal_maps.pair_files import layout_digest

SIZE = 64


def write_wrinkle_model(folder: Path, config: NetworkConfig | None = None, *, crop: int | None = None) -> WrinkleModel:
    """Write it; its maps have 64 texels."""
    torch.manual_seed(3)
    config = config or NetworkConfig(filters=4, layers=4, output="residual", dropout=0.0)
    mesh = cloth()
    model = WrinkleModel(
        UNet(config), config, texels=SIZE, crop=crop, maps=MapConfig(size=SIZE, padding=2),
        layout_digest=layout_digest(mesh, SIZE), template=mesh,
    )  # fmt: skip
    with torch.no_grad():
        model.generator.up[-1][1].weight.mul_(0.02)  # what a picture that is compressed can keep
    folder.mkdir(parents=True, exist_ok=True)
    save_model(generator_path(folder), model)
    return model
