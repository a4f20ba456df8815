"""Using a trained generator: low maps in, unit normals out, one map at a time."""

from __future__ import annotations

import json
from dataclasses import asdict

import safetensors.torch
import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.nn import functional

from capture4d.errors import InputError
from wrinkles.config import NetworkConfig
from wrinkles.networks import UNet, set_test_statistics
from wrinkles.training import load_weights

__all__ = ["WrinkleModel", "load_model", "model_bytes"]

MAP_KEYS = ("texels", "map_size", "layout_digest")


class WrinkleModel:
    """A generator and the maps it was trained on."""

    def __init__(
        self, generator: UNet, config: NetworkConfig, *, texels: int, map_size: int, layout_digest: str
    ) -> None:
        self.generator = generator
        self.config = config
        self.texels = texels
        """Side of the maps the generator sees."""
        self.map_size = map_size
        """Side of the maps on disk."""
        self.layout_digest = layout_digest
        """Of the UV layout; other layouts mean nothing to the generator."""
        set_test_statistics(generator, config.norm_at_test)

    @torch.inference_mode()
    def generate(
        self, low: Float[Tensor, "3 size size"], *, half_precision: bool = False
    ) -> Float[Tensor, "3 size size"]:
        """Unit normals of a map; zero where `low` is. What a smaller generator adds is enlarged."""
        shown = (low != 0).any(dim=0, keepdim=True).float()[None]
        image = low[None]
        while image.shape[-1] > self.texels:
            image, shown = _halved(image, shown)
        with torch.autocast("cpu", torch.bfloat16, enabled=half_precision):
            made = self.generator(image.contiguous(memory_format=torch.channels_last))
        made = made.float()
        if image.shape[-1] != low.shape[-1]:
            added = (functional.normalize(made, dim=1, eps=1e-6) - image) * shown
            made = low + functional.interpolate(added, size=low.shape[-2:], mode="bilinear", align_corners=False)
        return functional.normalize(made, dim=1, eps=1e-6)[0] * (low != 0).any(dim=0)


def _halved(image: Tensor, shown: Tensor) -> tuple[Tensor, Tensor]:
    mean = functional.avg_pool2d(image * shown, 2)
    return functional.normalize(mean, dim=1, eps=1e-6), (functional.avg_pool2d(shown, 2) > 0).float()


def model_bytes(model: WrinkleModel) -> bytes:
    """The weights as safetensors; what is needed to rebuild the network is in the metadata."""
    about = {"network": asdict(model.config)} | {key: getattr(model, key) for key in MAP_KEYS}
    weights = {name: tensor.contiguous() for name, tensor in model.generator.state_dict().items()}
    return safetensors.torch.save(weights, {"capture4d_wrinkles": json.dumps(about)})


def load_model(path: str) -> WrinkleModel:
    """Read a generator.

    Raises:
        InputError: the file is missing, damaged, not a generator of ours, or its weights are not those of the
            architecture it claims.
    """
    try:
        with safe_open(path, framework="pt") as file:
            about = (file.metadata() or {}).get("capture4d_wrinkles")
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; run: capture4d wrinkles train WORK --output MODEL") from None
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path}: not a readable safetensors file, cut off or damaged ({error})") from None
    try:
        described = json.loads(about or "null")
        config = NetworkConfig(**described["network"])
        maps = {key: described[key] for key in MAP_KEYS}
    except (TypeError, KeyError, ValueError):
        raise InputError(f"{path}: expected a wrinkle generator, found other weights") from None
    with torch.device("meta"):
        generator = UNet(config)
    generator.to_empty(device="cpu")
    load_weights(generator, weights, source=path)
    return WrinkleModel(generator.to(memory_format=torch.channels_last), config, **maps)  # pyright: ignore[reportCallIssue]
