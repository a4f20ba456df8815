"""Trainings that go on where they were stopped, to the same bits: checkpoints and the log of the epochs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from capture4d.files.atomic import write_bytes
from capture4d.learning.checkpoints import read_checkpoint, write_checkpoint
from capture4d.runs.progress import progress
from wrinkles.offset_images.config import OffsetTrainingConfig
from wrinkles.offset_images.training import OffsetTraining, train_epoch

__all__ = ["METRICS", "TrainingLog", "train_resumably"]

METRICS = "metrics.jsonl"
KIND = "training of offset images"


@dataclass(frozen=True, slots=True)
class TrainingLog:
    """Where a folder's trainings are told of, network after network."""

    folder: Path
    command: str
    """That starts anew with --overwrite; for messages."""
    before: Sequence[Mapping[str, Any]]
    """Rows about the networks that learned before this one."""

    @property
    def path(self) -> Path:
        return self.folder / METRICS

    def checkpoints(self, name: str) -> list[Path]:
        """Of a network, the oldest first."""
        return sorted((self.folder / "checkpoints").glob(f"{name}-*.safetensors"))

    def write(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write the log: the networks before, and these rows."""
        write_bytes(self.path, "".join(json.dumps(row) + "\n" for row in [*self.before, *rows]).encode())


def train_resumably(
    log: TrainingLog, name: str, training: OffsetTraining, config: OffsetTrainingConfig
) -> list[dict[str, Any]]:
    """Go on from the newest checkpoint, if there is one, to the last epoch; the rows of the log about the network,
    which is left as it was after its best epoch.

    Raises:
        InputError: a checkpoint is damaged or of another network.
    """
    _resume(log, name, training)
    with progress(name.replace("_", " "), config.epochs, completed=len(training.errors)) as advance:
        while not training.is_over(config):
            train_epoch(training, config)
            advance(1)
            if len(training.errors) % config.checkpoint_every == 0 or training.is_over(config):
                log.write(_history(name, training))
                _save(log, name, training)
    training.network.load_state_dict(training.best.state_dict())
    return _history(name, training)


def _save(log: TrainingLog, name: str, training: OffsetTraining) -> None:
    earlier = log.checkpoints(name)
    path = log.folder / "checkpoints" / f"{name}-{len(training.errors):06d}.safetensors"
    write_checkpoint(
        path,
        KIND,
        modules={"network": training.network, "best": training.best},
        optimisers={"network": training.optimizer},
        tensors={"losses": _numbers(training.losses), "errors": _numbers(training.errors)},
    )
    for old in earlier:
        if old != path:
            old.unlink()


def _resume(log: TrainingLog, name: str, training: OffsetTraining) -> None:
    paths = log.checkpoints(name)
    if not paths:
        return
    tensors, _ = read_checkpoint(
        paths[-1],
        KIND,
        modules={"network": training.network, "best": training.best},
        optimisers={"network": training.optimizer},
        command=log.command,
    )
    training.go_on_from(tensors["losses"].tolist(), tensors["errors"].tolist())


def _numbers(values: Sequence[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _history(name: str, training: OffsetTraining) -> list[dict[str, Any]]:
    """One row an epoch; null where a number is not finite, as JSON has it."""
    return [
        {
            "network": name,
            "epoch": epoch,
            "loss": loss if math.isfinite(loss) else None,
            "validation_cm": error if math.isfinite(error) else None,
        }
        for epoch, (loss, error) in enumerate(zip(training.losses, training.errors, strict=True), start=1)
    ]
