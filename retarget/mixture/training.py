"""Training a network from rows of numbers to rows of numbers: one loop for all, that can be killed at any moment.

Everything a resume needs is in the network's checkpoint: weights, the best weights so far, the optimiser's state,
torch's random state and what every epoch brought. On a CPU, with the same number of threads, a run that was killed and
continued ends with the same bits as one that was not.

References: TailorNet (CVPR 2020), section 4.3 (the loss), section 6 (the networks); the released code keeps the best
epoch.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from capture4d.errors import InputError
from capture4d.learning.checkpoints import read_checkpoint, write_checkpoint
from capture4d.learning.networks import perceptron
from capture4d.runs.progress import progress
from retarget.mixture.config import NetworkConfig

__all__ = ["Examples", "Trained", "Trainer", "made_network", "said_by"]

KIND = "training of styles"
COMMAND = "capture4d fit-styles STYLES --output MODEL"
STEPS, SMALLEST_BATCH = 8, 4
"""Of an epoch at least, unless a step would be of fewer drapes."""


@dataclass(frozen=True, slots=True, eq=False)
class Examples:
    """What a network is shown, and what it shall say; `checked` rows choose the epoch alone."""

    inputs: Float32[np.ndarray, "rows inputs"]
    wanted: Float32[np.ndarray, "rows outputs"]
    checked_inputs: Float32[np.ndarray, "checked inputs"]
    checked_wanted: Float32[np.ndarray, "checked outputs"]


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """A network as it was after its best epoch."""

    network: nn.Sequential
    history: list[dict[str, Any]]
    """Loss and validation error of every epoch."""


def made_network(inputs: int, outputs: int, config: NetworkConfig) -> nn.Sequential:
    """A network that has learned nothing."""
    return perceptron(inputs, config.hidden, outputs, dropout=config.dropout)


def said_by(network: nn.Sequential, inputs: Float32[np.ndarray, "rows inputs"]) -> Float32[np.ndarray, "rows outputs"]:
    """What a network says to some rows."""
    network.eval()
    with torch.inference_mode():
        return network(torch.from_numpy(inputs)).numpy(force=True)


@dataclass(frozen=True, slots=True)
class Trainer:
    """Trains networks one after the other, none of which another's random numbers touch."""

    folder: Path
    """Gets a checkpoint of each."""
    checkpoint_every: int
    seed: int

    def __call__(self, name: str, examples: Examples, config: NetworkConfig, *, seed: int = 0) -> Trained:
        """Train a network, or go on where it was stopped.

        Args:
            name: of its checkpoint.
            seed: apart from the trainer's own: networks that are to differ.
        Raises:
            InputError: there is nothing to learn from, the loss is no number any more, or the checkpoint is damaged.
        """
        if not len(examples.inputs):
            raise InputError(f"{name}: expected drapes to learn from, found none")
        run = _Run.begin(examples, config, self.seed * 1000 + seed)
        path = self.folder / f"{name}.safetensors"
        if path.is_file():
            run.resume(path)
        with progress(name, config.epochs, completed=len(run.errors)) as advance:
            while not run.is_over:
                run.epoch()
                advance(1)
                if len(run.errors) % self.checkpoint_every == 0 or run.is_over:
                    run.save(path)
        history = [
            {"network": name, "epoch": epoch, "loss": loss, "validation": error}
            for epoch, (loss, error) in enumerate(zip(run.losses, run.errors, strict=True), 1)
        ]
        return Trained(run.best.eval(), history)


@dataclass(slots=True, eq=False)
class _Run:
    """A network while it learns."""

    network: nn.Sequential
    best: nn.Sequential
    optimiser: torch.optim.Adam
    tensors: tuple[Tensor, Tensor, Tensor, Tensor]
    config: NetworkConfig
    losses: list[float]
    errors: list[float]

    @staticmethod
    def begin(examples: Examples, config: NetworkConfig, seed: int) -> _Run:
        """Seeds torch's generator."""
        torch.manual_seed(seed)
        network = made_network(examples.inputs.shape[1], examples.wanted.shape[1], config)
        optimiser = torch.optim.Adam(
            network.parameters(),
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
            decoupled_weight_decay=not config.coupled,
            fused=True,
        )
        arrays = examples.inputs, examples.wanted, examples.checked_inputs, examples.checked_wanted
        inputs, wanted, checked, checked_wanted = (torch.from_numpy(each) for each in arrays)
        rows = inputs, wanted, checked, checked_wanted
        return _Run(network, copy.deepcopy(network), optimiser, rows, config, [], [])

    @property
    def batch(self) -> int:
        return min(self.config.batch, max(SMALLEST_BATCH, len(self.tensors[0]) // STEPS))

    @property
    def is_over(self) -> bool:
        done = len(self.errors)
        idle = done - 1 - int(np.argmin(self.errors)) if done else 0
        return done >= self.config.epochs or idle >= self.config.patience

    def epoch(self) -> None:
        """Show everything once, and keep the network if it is better than before."""
        inputs, wanted, checked, checked_wanted = self.tensors
        if self.config.falling:
            for group in self.optimiser.param_groups:
                share = (1 + math.cos(math.pi * len(self.errors) / self.config.epochs)) / 2
                group["lr"] = self.config.learning_rate * share
        self.network.train()
        losses = []
        for rows in torch.randperm(len(inputs)).split(self.batch):
            loss = _loss(self.network(inputs[rows]), wanted[rows], self.config)
            self.optimiser.zero_grad(set_to_none=True)
            loss.backward()
            self.optimiser.step()
            losses.append(loss.item())
        self.network.eval()
        with torch.inference_mode():
            shown = (checked, checked_wanted) if len(checked) else (inputs, wanted)
            error = _loss(self.network(shown[0]), shown[1], self.config).item()
        if not math.isfinite(error):
            raise InputError(f"training: the loss is no number in epoch {len(self.errors) + 1}; try a lower rate")
        if not self.errors or error < min(self.errors):
            self.best.load_state_dict(self.network.state_dict())
        self.losses.append(float(np.mean(losses)))
        self.errors.append(error)

    def save(self, path: Path) -> None:
        tensors = {name: torch.tensor(values, dtype=torch.float64) for name, values in
                   (("losses", self.losses), ("errors", self.errors))}  # fmt: skip
        modules = {"network": self.network, "best": self.best}
        write_checkpoint(path, KIND, modules=modules, optimisers={"adam": self.optimiser}, tensors=tensors)

    def resume(self, path: Path) -> None:
        modules = {"network": self.network, "best": self.best}
        found, _ = read_checkpoint(path, KIND, modules=modules, optimisers={"adam": self.optimiser}, command=COMMAND)
        if not {"losses", "errors"} <= set(found) or found["losses"].shape != found["errors"].shape:
            raise InputError("expected losses and errors of the epochs, found none", where=path)
        self.losses, self.errors = found["losses"].tolist(), found["errors"].tolist()


def _loss(said: Float[Tensor, "B outputs"], wanted: Float[Tensor, "B outputs"], config: NetworkConfig) -> Tensor:
    """Squared distance; or the mean over the vertices of |dx| + |dy| + |dz|, if the outputs are displacements."""
    if config.loss == "l2":
        return ((said - wanted) ** 2).sum(dim=1).mean()
    return 3 * (said - wanted).abs().mean()
