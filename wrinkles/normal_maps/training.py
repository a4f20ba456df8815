"""One training step of the wrinkle GAN, and its state as named tensors, so that a resumed run is the same run.

Step t (DeepWrinkles, Eq. 3): y = G(low_t). D learns to tell (low_t, high_t) from (low_t, y); G learns from
1 * GAN + 100 * L1(y, high_t) + 50 * temporal(y, high_t-1). Texels without information are zero for D, and absent from
the other losses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from capture4d.errors import InputError
from wrinkles.normal_maps.config import LossConfig, ScheduleConfig, WrinkleConfig
from wrinkles.normal_maps.losses import data_loss, gan_loss, temporal_loss
from wrinkles.normal_maps.networks import PatchDiscriminator, UNet
from wrinkles.normal_maps.pairs import Batch, augmented

__all__ = ["TrainingState", "learning_rate", "load_tensors", "load_weights", "new_state", "state_tensors", "train_step"]


@dataclass(slots=True, eq=False)
class TrainingState:
    """Everything a step changes."""

    generator: UNet
    discriminator: PatchDiscriminator
    generator_optimizer: torch.optim.Adam
    discriminator_optimizer: torch.optim.Adam
    step: int = 0


def new_state(config: WrinkleConfig) -> TrainingState:
    """Fresh networks; seeds torch's generator."""
    torch.manual_seed(config.seed)
    layers = config.network.layers
    if config.texels % 2**layers:
        most = config.texels.bit_length() - 1
        raise InputError(f"network.layers: expected at most {most} for maps of {config.texels} texels, found {layers}")
    generator = UNet(config.network).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    discriminator = PatchDiscriminator(config.network).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    settings = config.schedule

    def adam(network: nn.Module) -> torch.optim.Adam:
        return torch.optim.Adam(network.parameters(), lr=settings.learning_rate, betas=(settings.beta1, 0.999))

    return TrainingState(generator, discriminator, adam(generator), adam(discriminator))


def train_step(state: TrainingState, batch: Batch, config: WrinkleConfig) -> dict[str, float]:
    """Improve both networks on one batch; the losses."""
    batch = augmented(batch, config.augmentation)
    for optimizer in (state.generator_optimizer, state.discriminator_optimizer):
        optimizer.param_groups[0]["lr"] = learning_rate(state.step, config.schedule)
    state.generator.train()
    state.discriminator.train()
    with torch.autocast("cpu", torch.bfloat16, enabled=config.schedule.half_precision):
        generated = state.generator(batch.low.contiguous(memory_format=torch.channels_last))
    generated = generated.float()
    losses = {"discriminator": 0.0}
    if config.loss.gan > 0:
        losses["discriminator"] = _improve_discriminator(state, batch, generated.detach(), config)
    total, parts = _generator_loss(state, batch, generated, config)
    state.generator_optimizer.zero_grad(set_to_none=True)
    total.backward()
    state.generator_optimizer.step()
    state.step += 1
    return losses | parts


def _improve_discriminator(state: TrainingState, batch: Batch, generated: Tensor, config: WrinkleConfig) -> float:
    with torch.autocast("cpu", torch.bfloat16, enabled=config.schedule.half_precision):
        real = state.discriminator(batch.low, batch.high * batch.valid)
        made = state.discriminator(batch.low, generated * batch.valid)
    loss = 0.5 * (gan_loss(real, real=True) + gan_loss(made, real=False))
    state.discriminator_optimizer.zero_grad(set_to_none=True)
    loss.backward()
    state.discriminator_optimizer.step()
    return loss.item()


def _generator_loss(
    state: TrainingState, batch: Batch, generated: Tensor, config: WrinkleConfig
) -> tuple[Float[Tensor, ""], dict[str, float]]:
    weights: LossConfig = config.loss
    data = data_loss(generated, batch.high, batch.valid)
    temporal = temporal_loss(generated, batch.previous, batch.valid & batch.previous_valid, weights.temporal_kind)
    total = weights.data * data + weights.temporal * temporal
    parts = {"data": data.item(), "temporal": temporal.item(), "gan": 0.0}
    if weights.gan > 0:
        with torch.autocast("cpu", torch.bfloat16, enabled=config.schedule.half_precision):
            logits = state.discriminator(batch.low, generated * batch.valid)
        gan = gan_loss(logits, real=True)
        total = total + weights.gan * gan
        parts["gan"] = gan.item()
    return total, parts


def learning_rate(step: int, config: ScheduleConfig) -> float:
    """Constant, then falling linearly to zero."""
    start = config.decay_from * config.steps
    share = 1.0 if step < start else (config.steps - step) / max(config.steps - start, 1)
    return config.learning_rate * max(share, 0.0)


# --- state as named tensors --------------------------------------------------------------------------------------


def state_tensors(state: TrainingState) -> dict[str, Tensor]:
    """Networks, optimisers, torch's random state and the step, as safetensors takes them."""
    tensors = {"step": torch.tensor(state.step), "random": torch.get_rng_state()}
    for name, network, optimizer in _parts(state):
        tensors |= {f"{name}.{key}": value for key, value in network.state_dict().items()}
        for index, moments in optimizer.state_dict()["state"].items():
            tensors |= {f"{name}_optimizer.{index}.{key}": value for key, value in moments.items()}
    return {name: tensor.contiguous().clone() for name, tensor in tensors.items()}


def load_tensors(state: TrainingState, tensors: Mapping[str, Tensor], *, source: str) -> None:
    """Go on from a checkpoint.

    Raises:
        InputError: `source` holds another architecture, or is not whole.
    """
    for needed in ("step", "random"):
        if needed not in tensors:
            raise InputError(f"{source}: expected a whole checkpoint, found one without '{needed}'")
    for name, network, optimizer in _parts(state):
        weights = {key.removeprefix(f"{name}."): value for key, value in tensors.items() if key.startswith(f"{name}.")}
        load_weights(network, weights, source=source)
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith(f"{name}_optimizer."):
                _, index, entry = key.split(".")
                moments.setdefault(int(index), {})[entry] = value
        for index, parameter in enumerate(optimizer.param_groups[0]["params"]):
            for entry, value in moments.get(index, {}).items():
                if entry != "step" and value.shape != parameter.shape:
                    raise InputError(f"{source}: '{name}_optimizer.{index}.{entry}': expected "
                                     f"{tuple(parameter.shape)}, found {tuple(value.shape)}")  # fmt: skip
        optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})
    state.step = int(tensors["step"])
    torch.set_rng_state(tensors["random"])


def load_weights(network: nn.Module, weights: Mapping[str, Tensor], *, source: str) -> None:
    """Fill a network.

    Raises:
        InputError: `source` holds the weights of another architecture.
    """
    own = network.state_dict()
    missing, strange = own.keys() - weights.keys(), weights.keys() - own.keys()
    other = [key for key in own.keys() & weights.keys() if own[key].shape != weights[key].shape]
    if missing or strange or other:
        key = min(other or missing or strange)
        expected, found = (tuple(each[key].shape) if key in each else "none" for each in (own, weights))
        raise InputError(f"{source}: weights of another architecture: '{key}', expected {expected}, found {found}")
    network.load_state_dict(weights)


def _parts(state: TrainingState) -> tuple[tuple[str, nn.Module, torch.optim.Adam], ...]:
    return (
        ("generator", state.generator, state.generator_optimizer),
        ("discriminator", state.discriminator, state.discriminator_optimizer),
    )
