"""Learning offsets from poses: one loop for decoders of images, of windows, and the baselines. Lengths in centimetres.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 5.2 and 6.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from capture4d.learning.networks import ImageDecoder
from wrinkles.half_precision import has_bfloat16
from wrinkles.offset_images.canvas import Canvas, OffsetSampler, Window, drawn_values
from wrinkles.offset_images.config import OffsetTrainingConfig
from wrinkles.offset_images.frames import OffsetFrames, vertex_errors_cm
from wrinkles.offset_images.layout import OffsetLayout
from wrinkles.offset_images.losses import edge_length_loss, grid_loss, normal_loss
from wrinkles.offset_images.networks import FullyConnected, PcaFullyConnected

__all__ = [
    "OffsetLesson",
    "OffsetTraining",
    "predict",
    "predicted_offsets",
    "start_training",
    "train_epoch",
    "train_offsets",
]


def predicted_offsets(
    network: nn.Module, sampler: OffsetSampler, pose: Float[Tensor, "frames pose"]
) -> Float[Tensor, "frames Q 3"]:
    """Offsets of the sampler's cloth pixels that a network gives to poses, centimetres."""
    network.eval()
    parts = []
    with torch.inference_mode():
        for part in pose.split(8):
            made = network(part)
            parts.append(sampler(made) if isinstance(network, ImageDecoder) else made)
    return torch.cat(parts)


def predict(network: nn.Module, sampler: OffsetSampler, frames: OffsetFrames) -> Float[Tensor, "frames V 3"]:
    """The sampler's vertices that a network gives to poses, centimetres."""
    made = predicted_offsets(network, sampler, frames.pose)
    parts = []
    for rows in torch.arange(len(frames)).split(8):
        points, axes = (each[rows][:, sampler.pixels] for each in (frames.points, frames.axes))
        parts.append(sampler.positions(made[rows], points, axes))
    return torch.cat(parts)


@dataclass(frozen=True, slots=True, eq=False)
class OffsetLesson:
    """What networks learn from: frames, and those that choose the epoch."""

    layout: OffsetLayout
    train: OffsetFrames
    validation: OffsetFrames
    window: Window | None = None
    """What a decoder draws; both images whole without it."""
    values: Float[Tensor, "frames P 3"] | None = None
    """What is drawn of the frames to train on, if that is known from another lesson of the same frames."""


@dataclass(slots=True, eq=False)
class OffsetTraining:
    """A network while it learns: everything an epoch changes, and what it needs of the lesson."""

    network: nn.Module
    best: nn.Module
    """As the network was after the epoch with the least validation error."""
    optimizer: torch.optim.Adam
    schedule: torch.optim.lr_scheduler.CosineAnnealingLR
    lesson: OffsetLesson
    sampler: OffsetSampler
    canvas: Canvas | None
    """What a decoder draws on."""
    targets: Tensor
    """What is drawn of each frame for a decoder; coefficients or offsets for the baselines."""
    losses: list[float]
    """Mean over an epoch's batches, of every epoch so far."""
    errors: list[float]
    """Validation error of every epoch so far, cm."""

    def is_over(self, config: OffsetTrainingConfig) -> bool:
        """All epochs are done, or the last ones brought nothing."""
        done = len(self.errors)
        return done >= config.epochs or (done > 0 and done - int(np.argmin(self.errors)) > config.patience)

    def go_on_from(self, losses: Sequence[float], errors: Sequence[float]) -> None:
        """Continue after so many epochs; network and optimiser are as they were then."""
        self.losses, self.errors = list(losses), list(errors)
        self.schedule.last_epoch = len(errors)  # the optimiser's rate is that of this epoch already


def start_training(network: nn.Module, lesson: OffsetLesson, config: OffsetTrainingConfig) -> OffsetTraining:
    """Make a network that has learned nothing ready for its first epoch; seeds torch's generator."""
    torch.manual_seed(config.seed)
    canvas, offsets = None, lesson.train.offsets
    if isinstance(network, ImageDecoder):
        network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        canvas = Canvas.create(lesson.layout, lesson.window)
        known = lesson.values
        targets = torch.from_numpy(drawn_values(lesson.layout, offsets.numpy())) if known is None else known
    else:
        assert lesson.window is None, "the baselines have no images"
        targets = network.coefficients(offsets) if isinstance(network, PcaFullyConnected) else offsets
    if config.centred:
        _start_from_mean(network, canvas, targets)
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.epochs)
    sampler = OffsetSampler(lesson.layout, lesson.window)
    return OffsetTraining(network, copy.deepcopy(network), optimizer, falling, lesson, sampler, canvas, targets, [], [])


def _start_from_mean(network: nn.Module, canvas: Canvas | None, targets: Tensor) -> None:
    """Let a network that has learned nothing yet give the mean of the frames, whatever the pose."""
    mean = targets.mean(dim=0, keepdim=True, dtype=torch.float64).float()
    with torch.no_grad():
        if isinstance(network, ImageDecoder):
            assert canvas is not None
            network.mean.copy_(canvas.draw(mean)[0])
            last = network.last
        elif isinstance(network, FullyConnected):
            last = network.layers[-1]
            assert isinstance(last, nn.Linear)
        else:
            return
        assert last.bias is not None
        last.weight.zero_()
        last.bias.zero_()
        if isinstance(network, FullyConnected):
            last.bias.copy_(mean.flatten())


def train_epoch(training: OffsetTraining, config: OffsetTrainingConfig) -> None:
    """Show all frames once, and keep the network if it is better than before."""
    train, validation = training.lesson.train, training.lesson.validation
    training.network.train()
    losses = []
    for rows in torch.randperm(len(train)).split(config.batch):
        if len(rows) == 1 and len(train) > 1:
            continue  # batch norm needs two
        loss = _loss(training, rows, config)
        training.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        training.optimizer.step()
        losses.append(loss.item())
    training.schedule.step()
    truth = validation.vertices[:, training.sampler.vertices]
    error = vertex_errors_cm(predict(training.network, training.sampler, validation), truth)
    if not training.errors or error < min(training.errors):
        training.best.load_state_dict(training.network.state_dict())
    training.losses.append(float(np.mean(losses)))
    training.errors.append(error)


def _loss(training: OffsetTraining, rows: Int[Tensor, " B"], config: OffsetTrainingConfig) -> Float[Tensor, ""]:
    """Of a batch: of offsets or coefficients for the baselines; of images, and with a weight each of normals and edge
    lengths, for a decoder."""
    network, canvas, frames = training.network, training.canvas, training.lesson.train
    pose, targets = frames.pose[rows], training.targets[rows]
    if isinstance(network, PcaFullyConnected):
        return (network.layers(pose) - targets).norm(dim=-1).mean()
    if canvas is None:
        return (network(pose) - targets).norm(dim=-1).mean()
    with torch.autocast("cpu", torch.bfloat16, enabled=config.half_precision and has_bfloat16()):
        made = network(pose)
    made = made.float()
    loss = grid_loss(made, canvas.draw(targets), canvas.mask, config.norm)
    if config.normal_weight > 0 or config.edge_weight > 0:
        sampler = training.sampler
        points, axes = frames.points[rows][:, sampler.pixels], frames.axes[rows][:, sampler.pixels]
        placed, truth = sampler.positions(sampler(made), points, axes), frames.vertices[rows][:, sampler.vertices]
        if config.normal_weight > 0:
            loss = loss + config.normal_weight * normal_loss(placed, truth, sampler.faces)
        if config.edge_weight > 0:
            loss = loss + config.edge_weight * edge_length_loss(placed, truth, sampler.edges)
    return loss


def train_offsets(network: nn.Module, lesson: OffsetLesson, config: OffsetTrainingConfig) -> list[float]:
    """Train a decoder or a baseline in place, keep its best epoch; the validation error of every epoch, cm.

    The baseline without PCA minimises the mean length of the difference of offsets, that with PCA the mean over frames
    of the length of the difference of all coefficients; decoders the grid loss, and with a weight each the losses of
    normals and of edge lengths.
    """
    training = start_training(network, lesson, config)
    while not training.is_over(config):
        train_epoch(training, config)
    network.load_state_dict(training.best.state_dict())
    return training.errors
