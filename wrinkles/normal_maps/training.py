"""One training step of the wrinkle GAN, and its state in a checkpoint, so that a resumed run is the same run.

Step t (DeepWrinkles, Eq. 3): y = G(low_t). D learns to tell (low_t, high_t) from (low_t, y); G learns from
1 * GAN + 100 * L1(y, high_t) + 50 * temporal(y, high_t-1). Texels without information are zero for D, and absent from
the other losses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from capture4d.errors import InputError
from capture4d.learning.checkpoints import read_checkpoint, write_checkpoint
from wrinkles.half_precision import has_bfloat16
from wrinkles.normal_maps.config import LossConfig, ScheduleConfig, WrinkleConfig
from wrinkles.normal_maps.losses import data_loss, gan_loss, temporal_loss
from wrinkles.normal_maps.networks import PatchDiscriminator, UNet
from wrinkles.normal_maps.pairs import Batch, augmented

__all__ = ["TrainingState", "learning_rate", "load_state", "new_state", "save_state", "train_step"]

_KIND = "capture4d wrinkle training"


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
    _require_fit(config)
    generator = UNet(config.network).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    discriminator = PatchDiscriminator(config.network).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    settings = config.schedule

    def adam(network: nn.Module) -> torch.optim.Adam:
        return torch.optim.Adam(network.parameters(), lr=settings.learning_rate, betas=(settings.beta1, 0.999))

    return TrainingState(generator, discriminator, adam(generator), adam(discriminator))


def _require_fit(config: WrinkleConfig) -> None:
    """
    Raises:
        InputError: the network's layers do not halve the maps, or squares are larger than they.
    """
    layers, seen = config.network.layers, config.crop or config.texels
    if seen > config.texels:
        raise InputError(f"crop: expected at most the {config.texels} texels of the maps, found {seen}")
    if seen % 2**layers:
        most, what = (seen & -seen).bit_length() - 1, "squares" if config.crop else "maps"
        raise InputError(f"network.layers: expected at most {most} for {what} of {seen} texels, found {layers}")


def train_step(state: TrainingState, batch: Batch, config: WrinkleConfig) -> dict[str, float]:
    """Improve both networks on one batch; the losses."""
    batch = augmented(batch, config.augmentation)
    for optimizer in (state.generator_optimizer, state.discriminator_optimizer):
        optimizer.param_groups[0]["lr"] = learning_rate(state.step, config.schedule)
    state.generator.train()
    state.discriminator.train()
    with torch.autocast("cpu", torch.bfloat16, enabled=config.schedule.half_precision and has_bfloat16()):
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
    with torch.autocast("cpu", torch.bfloat16, enabled=config.schedule.half_precision and has_bfloat16()):
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
        with torch.autocast("cpu", torch.bfloat16, enabled=config.schedule.half_precision and has_bfloat16()):
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


# --- checkpoints -------------------------------------------------------------------------------------------------


def save_state(path: Path, state: TrainingState, losses: Sequence[Mapping[str, float]]) -> None:
    """Write everything a resume needs.

    Args:
        losses: of the last steps, which no line of the log holds yet.
    """
    names = sorted(losses[0]) if losses else ()
    unlogged = {name: torch.tensor([each[name] for each in losses], dtype=torch.float64) for name in names}
    write_checkpoint(
        path, _KIND, modules=_networks(state), optimisers=_optimizers(state), tensors=unlogged,
        note={"step": state.step},
    )  # fmt: skip


def load_state(path: Path, state: TrainingState) -> list[dict[str, float]]:
    """Go on from a checkpoint; the losses that it had not logged yet.

    Raises:
        InputError: it is damaged, or of another architecture.
    """
    unlogged, note = read_checkpoint(
        path, _KIND, modules=_networks(state), optimisers=_optimizers(state), command="capture4d wrinkles train"
    )
    state.step = note["step"]
    return [
        dict(zip(unlogged, losses, strict=True))
        for losses in zip(*(each.tolist() for each in unlogged.values()), strict=True)
    ]


def _networks(state: TrainingState) -> dict[str, nn.Module]:
    return {"generator": state.generator, "discriminator": state.discriminator}


def _optimizers(state: TrainingState) -> dict[str, torch.optim.Optimizer]:
    return {"generator": state.generator_optimizer, "discriminator": state.discriminator_optimizer}
