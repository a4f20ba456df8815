"""Learning offsets from poses: frames, losses and one loop for the decoder and its baselines. Lengths in centimetres.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 5.2 and 6.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Int
from torch import Tensor, nn

from capture4d.body.skinning import pose_frame, with_shape
from capture4d.learning.networks import ImageDecoder
from capture4d.types import Body, PoseSequence
from wrinkles.offset_images.config import OffsetTrainingConfig
from wrinkles.offset_images.layout import OffsetLayout, OffsetSampler, OffsetSpace, encode
from wrinkles.offset_images.networks import FullyConnected

__all__ = [
    "OffsetFrames",
    "OffsetLesson",
    "OffsetTraining",
    "grid_loss",
    "normal_loss",
    "offset_frames",
    "pose_joints",
    "predict",
    "start_training",
    "train_epoch",
    "train_offsets",
    "vertex_errors_cm",
]

CM = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class OffsetFrames:
    """Poses and what they shall give, one row a frame."""

    pose: Float[Tensor, "frames pose"]
    offsets: Float[Tensor, "frames P 3"]
    points: Float[Tensor, "frames P 3"]
    axes: Float[Tensor, "frames P 3 3"]
    vertices: Float[Tensor, "frames V 3"]

    def __len__(self) -> int:
        return len(self.pose)

    def rows(self, index: Tensor | Sequence[int]) -> OffsetFrames:
        """Some of the frames."""
        at = torch.as_tensor(index)
        return OffsetFrames(self.pose[at], self.offsets[at], self.points[at], self.axes[at], self.vertices[at])


def pose_joints(
    poses: PoseSequence, skin_weights: Float[np.ndarray, "V joints"], *, count: int = 10
) -> Int[np.ndarray, " count"]:
    """The joints that move the garment most: by how much they turn, times what of the garment hangs on them.

    The root is left out: offsets turn with the body.
    """
    mean = poses.rotations.mean(axis=0)
    turn = np.linalg.norm(poses.rotations - mean, axis=(2, 3)).mean(axis=0)
    rank = turn * skin_weights.sum(axis=0)
    rank[0] = -1
    return np.sort(np.argsort(-rank, kind="stable")[:count])


def offset_frames(
    layout: OffsetLayout,
    body: Body,
    poses: PoseSequence,
    vertices: Float[np.ndarray, "frames V 3"],
    joints: Int[np.ndarray, " joints"],
    *,
    space: OffsetSpace = "local",
) -> OffsetFrames:
    """Encode registered frames, whose poses are those of `poses`, row by row."""
    shaped = with_shape(body, poses.shape)
    offsets, points, axes = [], [], []
    for row, placed in enumerate(vertices):
        anchors = layout.anchors(pose_frame(shaped, poses, row), space)
        offsets.append(CM * encode(anchors, placed[layout.vertex].astype(np.float64)))
        points.append(CM * anchors.points)
        axes.append(anchors.axes)

    def stacked(arrays: list[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.stack(arrays).astype(np.float32))

    pose = torch.from_numpy(np.ascontiguousarray(poses.rotations[:, joints]).reshape(len(vertices), -1))
    return OffsetFrames(
        pose, stacked(offsets), stacked(points), stacked(axes), CM * torch.from_numpy(np.array(vertices))
    )


def grid_loss(
    made: Float[Tensor, "B 6 size size"],
    truth: Float[Tensor, "B 6 size size"],
    mask: Bool[Tensor, "2 size size"],
    norm: Literal["l1", "l2"],
) -> Float[Tensor, ""]:
    """The mean over the texels of both images of the length of the difference."""
    difference = (made - truth).unflatten(1, (2, 3))
    length = difference.abs().sum(dim=2) if norm == "l1" else difference.norm(dim=2)
    return (length * mask).sum() / (mask.sum() * len(made))


def normal_loss(
    made: Float[Tensor, "B V 3"], truth: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, ""]:
    """The mean over the vertices of 1 - cos of the angle between the normals."""
    return (1 - (_vertex_normals(made, faces) * _vertex_normals(truth, faces)).sum(dim=-1)).mean()


def _vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    corner, along, across = (vertices[:, faces[:, k]] for k in range(3))
    vector = torch.linalg.cross(along - corner, across - corner)
    total = torch.zeros_like(vertices)
    for k in range(3):
        total = total.index_add(1, faces[:, k], vector)
    return nn.functional.normalize(total, dim=-1, eps=1e-12)


def predict(network: nn.Module, sampler: OffsetSampler, frames: OffsetFrames) -> Float[Tensor, "frames V 3"]:
    """Vertices that a network gives to poses, centimetres."""
    network.eval()
    parts = []
    with torch.inference_mode():
        for rows in torch.arange(len(frames)).split(8):
            part = frames.rows(rows)
            made = network(part.pose)
            pixels = sampler(made) if isinstance(network, ImageDecoder) else made
            parts.append(sampler.positions(pixels, part.points, part.axes))
    return torch.cat(parts)


def vertex_errors_cm(made: Float[Tensor, "frames V 3"], truth: Float[Tensor, "frames V 3"]) -> float:
    """Mean distance of a vertex from where it should be."""
    return float((made - truth).norm(dim=-1).mean())


def _drawn(layout: OffsetLayout, frames: OffsetFrames) -> Float16[Tensor, "frames 6 size size"]:
    """The images of all frames, drawn once; half precision errs by 0.01 mm at 2 cm."""
    images = torch.empty((len(frames), 6, *layout.mask.shape[:2]), dtype=torch.float16)
    for image, offsets in zip(images, frames.offsets.numpy(), strict=True):
        image.copy_(torch.from_numpy(layout.draw(offsets)).permute(2, 0, 1))
    return images


def _start_from_mean(network: nn.Module, train: OffsetFrames, drawn: Tensor | None) -> None:
    """Let a network that has learned nothing yet give the mean of the frames, whatever the pose."""
    with torch.no_grad():
        if isinstance(network, ImageDecoder) and drawn is not None:
            network.mean.copy_(drawn.mean(dim=0, dtype=torch.float32))
        if isinstance(network, (ImageDecoder, FullyConnected)):
            last = network.layers[-1]
            assert isinstance(last, (nn.Conv2d, nn.Linear))
            assert last.bias is not None
            last.weight.zero_()
            last.bias.zero_()
            if isinstance(network, FullyConnected):
                last.bias.copy_(train.offsets.mean(dim=0).flatten())


@dataclass(frozen=True, slots=True, eq=False)
class OffsetLesson:
    """What networks learn from: frames, and those that choose the epoch."""

    layout: OffsetLayout
    train: OffsetFrames
    validation: OffsetFrames


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
    mask: Bool[Tensor, "2 size size"]
    """Texels that count."""
    drawn: Float16[Tensor, "frames 6 size size"] | None
    """The images to learn, for the decoder."""
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
    drawn = _drawn(lesson.layout, lesson.train) if isinstance(network, ImageDecoder) else None
    if drawn is not None:
        network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        drawn = drawn.contiguous(memory_format=torch.channels_last)
    if config.centred:
        _start_from_mean(network, lesson.train, drawn)
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.epochs)
    mask = torch.from_numpy(lesson.layout.mask).permute(2, 0, 1)
    return OffsetTraining(
        network, copy.deepcopy(network), optimizer, falling, lesson, OffsetSampler(lesson.layout), mask, drawn, [], []
    )


def train_epoch(training: OffsetTraining, config: OffsetTrainingConfig) -> None:
    """Show all frames once, and keep the network if it is better than before."""
    train, validation = training.lesson.train, training.lesson.validation
    training.network.train()
    losses = []
    for rows in torch.randperm(len(train)).split(config.batch):
        if len(rows) == 1 and len(train) > 1:
            continue  # batch norm needs two
        loss = _loss(training, train.rows(rows), rows, config)
        training.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        training.optimizer.step()
        losses.append(loss.item())
    training.schedule.step()
    error = vertex_errors_cm(predict(training.network, training.sampler, validation), validation.vertices)
    if not training.errors or error < min(training.errors):
        training.best.load_state_dict(training.network.state_dict())
    training.losses.append(float(np.mean(losses)))
    training.errors.append(error)


def _loss(
    training: OffsetTraining, part: OffsetFrames, rows: Int[Tensor, " B"], config: OffsetTrainingConfig
) -> Float[Tensor, ""]:
    """Of a batch: of offsets for the baselines; of images, and with a weight of normals, for the decoder."""
    drawn = training.drawn
    half_precision = config.half_precision and drawn is not None
    with torch.autocast("cpu", torch.bfloat16, enabled=half_precision):
        made = training.network(part.pose)
    if drawn is None:
        return (made - part.offsets).norm(dim=-1).mean()
    made = made.float()
    loss = grid_loss(made, drawn[rows].float(), training.mask, config.norm)
    if config.normal_weight > 0:
        faces = torch.from_numpy(training.lesson.layout.garment.template.faces).long()
        placed = training.sampler.positions(training.sampler(made), part.points, part.axes)
        loss = loss + config.normal_weight * normal_loss(placed, part.vertices, faces)
    return loss


def train_offsets(network: nn.Module, lesson: OffsetLesson, config: OffsetTrainingConfig) -> list[float]:
    """Train a decoder or a baseline in place, keep its best epoch; the validation error of every epoch, cm.

    Baselines minimise the mean length of the difference of offsets; the decoder the grid loss, and with a weight the
    loss of the normals.
    """
    training = start_training(network, lesson, config)
    while not training.is_over(config):
        train_epoch(training, config)
    network.load_state_dict(training.best.state_dict())
    return training.errors
