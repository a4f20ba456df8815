"""Using a trained generator: low maps in, unit normals out, one map at a time."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import asdict
from os import PathLike
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from capture4d.errors import InputError
from capture4d.files.json_values import text, whole
from capture4d.files.reading import one_line, reading
from capture4d.files.tensors import read_tensors, write_tensors
from capture4d.learning.checkpoints import filled
from capture4d.types import Mesh
from wrinkles.half_precision import has_bfloat16
from wrinkles.normal_maps.config import MapConfig, NetworkConfig
from wrinkles.normal_maps.networks import UNet, set_test_statistics

__all__ = ["WrinkleModel", "answer", "generator_path", "load_model", "save_model"]

KIND = "a wrinkle generator"
HALF_FROM = 32
"""Filters from which bfloat16 is faster on a CPU."""
VERTICES, FACES, UV = "reference", "faces", "uv"
"""Names of the template's parts among the tensors."""


class WrinkleModel:
    """A generator and the maps it was trained on."""

    def __init__(
        self,
        generator: UNet,
        config: NetworkConfig,
        *,
        texels: int,
        crop: int | None = None,
        maps: MapConfig,
        layout_digest: str,
        template: Mesh,
    ) -> None:
        self.generator = generator
        self.config = config
        self.texels = texels
        """Side of the maps the generator learned from."""
        self.crop = crop
        """Side of the squares of them that it sees; None: it sees them whole."""
        self.maps = maps
        """Of the maps on disk."""
        self.layout_digest = layout_digest
        """Of the UV layout; other layouts mean nothing to the generator."""
        self.template = template
        """Its vertices as garment coordinates refer to them, its UVs as the maps have them. Models of early versions
        keep only the vertices."""
        set_test_statistics(generator, config.norm_at_test)
        self._narrow: UNet | None = None

    @torch.inference_mode()
    def generate(
        self, low: Float[Tensor, "3 size size"], *, half_precision: bool | None = None
    ) -> Float[Tensor, "3 size size"]:
        """Unit normals of a map; zero where `low` is. What a smaller generator adds is enlarged, bilinearly: `MapMaker`
        heeds seams and makes maps of any size.

        Args:
            half_precision: layers in bfloat16; by default where it pays, from HALF_FROM filters up and where the
                processor has it. A residual is added in full precision.
        """
        added = self.added(low, half_precision=half_precision)[None]
        if added.shape[-1] != low.shape[-1]:
            added = functional.interpolate(added, size=low.shape[-2:], mode="bilinear", align_corners=False)
        return _unit(low[None] + added)[0] * (low != 0).any(dim=0)

    @torch.inference_mode()
    def added(
        self, low: Float[Tensor, "3 size size"], *, half_precision: bool | None = None
    ) -> Float[Tensor, "3 texels texels"]:
        """What the generator adds to the unit normals of a map, at the scale it was trained at; zero where `low` is.

        Args:
            low: of as many texels as it was trained on, or twice as many, or four times, ...
        """
        image, shown = low[None], (low != 0).any(dim=0, keepdim=True).float()[None]
        while image.shape[-1] > self.texels:
            image, shown = _halved(image, shown)
        if half_precision is None:
            half_precision = self.config.filters >= HALF_FROM and has_bfloat16()
        network = self._in_half_precision() if half_precision else self.generator
        seen = (image.to(torch.bfloat16) if half_precision else image).contiguous(memory_format=torch.channels_last)
        made = answer(network, seen, image, crop=self.crop)
        return ((_unit(made) - _unit(image)) * shown)[0]

    def _in_half_precision(self) -> UNet:
        """A copy of the generator, made once: the weights must not change any more."""
        if self._narrow is None:
            self._narrow = copy.deepcopy(self.generator).to(torch.bfloat16)
        return self._narrow


def answer(network: UNet, seen: Tensor, low: Tensor, *, crop: int | None) -> Tensor:
    """A network's maps, full precision, not yet of unit length.

    Args:
        seen: low maps in the network's precision; `low`, the same in full precision.
        crop: side of the squares that it learned from; None: whole maps.
    """
    painted = (_by_tiles(network.paint, seen, side=crop) if crop else network.paint(seen)).float()
    return low + painted if network.output == "residual" else painted


def _by_tiles(paint: Callable[[Tensor], Tensor], image: Tensor, *, side: int) -> Tensor:
    """A network's answer to an image, from overlapping squares as large as those it learned from.

    Where squares overlap, by a quarter of their side or more, their answers fade into one another along a raised
    cosine. Squares that show nothing are left out, and stay zero.
    """
    size = image.shape[-1]
    starts = [round(at) for at in np.linspace(0, size - side, tiles_along(size, side))]
    fade = torch.sin(torch.pi * (torch.arange(side) + 0.5) / side).square().clamp(min=1e-3)
    window = fade[:, None] * fade
    total, weight = torch.zeros(image.shape), torch.zeros(size, size)
    for top in starts:
        tiles = [image[..., top : top + side, left : left + side] for left in starts]
        seen = [(left, tile) for left, tile in zip(starts, tiles, strict=True) if tile.any()]
        for left, tile in seen:
            made = paint(tile.contiguous(memory_format=torch.channels_last)).float()
            total[..., top : top + side, left : left + side] += window * made
            weight[top : top + side, left : left + side] += window
    return total / weight.clamp(min=1e-6)


def tiles_along(size: int, side: int) -> int:
    """Squares along an image of which neighbours overlap by a quarter of their side, or more."""
    return 1 + max(-(-4 * (size - side) // (3 * side)), 0)


def _unit(image: Tensor) -> Tensor:
    """What torch's `normalize` does; its norm over channels takes fifty times as long on a CPU."""
    return image * image.square().sum(dim=1, keepdim=True).clamp(min=1e-12).rsqrt()


def _halved(image: Tensor, shown: Tensor) -> tuple[Tensor, Tensor]:
    mean = functional.avg_pool2d(image * shown, 2)
    return _unit(mean), (functional.avg_pool2d(shown, 2) > 0).float()


def save_model(path: str | Path, model: WrinkleModel) -> None:
    """Write the weights and what is needed to rebuild the network."""
    about = {
        "network": asdict(model.config),
        "texels": model.texels,
        "crop": model.crop,
        "maps": asdict(model.maps),
        "layout_digest": model.layout_digest,
    }
    weights = {name: tensor.numpy() for name, tensor in model.generator.state_dict().items()}
    template = {VERTICES: model.template.vertices, FACES: model.template.faces}
    if model.template.uv is not None:
        template[UV] = model.template.uv
    write_tensors(path, KIND, weights | template, about)


def generator_path(model: str | PathLike[str]) -> Path:
    """The generator in a folder of `wrinkles train`, or the file itself."""
    path = Path(model)
    return path / "generator.safetensors" if path.is_dir() else path


def load_model(path: str | PathLike[str]) -> WrinkleModel:
    """Read a generator: the folder that `wrinkles train` wrote, or the file in it.

    Raises:
        InputError: the file is missing, damaged, not a generator of ours, or its weights are not those of the
            architecture it claims.
    """
    path = generator_path(path)
    if not path.is_file():
        raise InputError("no such file; run: capture4d wrinkles train WORK --output MODEL", where=path)
    file = read_tensors(path, KIND)
    try:
        config, maps = NetworkConfig(**file.entry("network")), MapConfig(**file.entry("maps"))
    except (TypeError, ValueError) as error:
        said = f"expected the settings of a wrinkle generator, found others ({one_line(error)})"
        raise InputError(said, where=path) from None
    own = (VERTICES, FACES, UV)
    weights = {name: torch.from_numpy(each) for name, each in file.tensors.items() if name not in own}
    with reading(path, "wrinkle generator"):
        faces = file.get(FACES)
        template = Mesh(file[VERTICES], np.zeros((0, 3), np.int32) if faces is None else faces, file.get(UV))
        texels = whole(file.entry("texels"), "texels", least=1)
        crop = file.note.get("crop")  # early versions saw maps whole
        crop = None if crop is None else whole(crop, "crop", least=1, most=texels)
        layout = text(file.entry("layout_digest"), "layout_digest")
        if config.layers > len(weights):
            raise InputError(f"expected weights of {config.layers} layers, found {len(weights)} tensors")
    generator = filled(lambda: UNet(config), weights, source=path)
    return WrinkleModel(
        generator.to(memory_format=torch.channels_last),  # pyright: ignore[reportCallIssue]
        config, texels=texels, crop=crop, maps=maps, layout_digest=layout, template=template,
    )  # fmt: skip
