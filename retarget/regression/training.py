"""Training the network: one loop, from the first step to the best weights, that can be killed at any moment.

Everything a resume needs is in one checkpoint: weights, the best weights so far, the optimiser's state, torch's random
state, the place in the data, and the lines of metrics.jsonl. The order of the windows in an epoch follows from the seed
and the epoch's number. On a CPU, with the same number of threads, a run that was killed and continued ends with the
same bits as one that was not.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from capture4d.errors import InputError
from capture4d.files.atomic import write_bytes
from capture4d.files.tensors import read_tensors, write_tensors
from retarget.config import LinearConfig, LstmConfig, TrainingConfig
from retarget.regression.controls import ControlLayout
from retarget.regression.linear import LinearRegressor, fit_linear
from retarget.regression.lstm import EncoderDecoder, LstmRegressor, frame_windows, usable_device
from retarget.regression.regressors import Clip, FittingClips, Scales, mean_squared_error, usual_response, with_history

__all__ = ["fit_lstm", "train_lstm"]

_KIND = "capture4d training checkpoint"
_CHECKPOINT = "last.safetensors"
METRICS = "metrics.jsonl"
USUAL_EPOCHS, LEAST_STEPS = 30, 500
"""Where the settings leave the number of epochs open."""


@dataclass(slots=True)
class _Progress:
    """Where a run stands; saved with every checkpoint."""

    epoch: int = 0
    step: int = 0
    """Steps done in this epoch."""
    loss_sum: float = 0.0
    """Of this epoch's steps."""
    best: float = math.inf
    best_epoch: int = -1
    records: list[dict[str, Any]] | None = None


def fit_lstm(
    clips: FittingClips,
    layout: ControlLayout,
    std: Float[np.ndarray, " shapes"],
    folder: Path,
    *,
    lstm: LstmConfig,
    config: TrainingConfig,
    linear: LinearRegressor,
    linear_config: LinearConfig,
    device: str = "cpu",
) -> LstmRegressor:
    """Train on some clips until those that validate get no better; then as long on all of them.

    Args:
        folder: gets training/ and final/, each with checkpoints and metrics.jsonl.
        linear: the regression over which the network stands, if `lstm.over_linear`; fitted to all clips.
        linear_config: how it was fitted, for its like on the training clips alone.
    Raises:
        InputError: torch does not know the device, or a checkpoint is damaged.
    """
    if not clips.validation:
        return train_lstm(
            clips.all, (), layout, std, folder / "final", lstm=lstm, config=config, linear=linear, device=device
        )
    alone = fit_linear(clips.settled, layout, std, replace(linear_config, ridges=(linear.ridge,)))
    found = train_lstm(
        clips.training, clips.validation, layout, std, folder / "training",
        lstm=lstm, config=config, linear=alone, device=device,
    )  # fmt: skip
    if len(clips.all) == len(clips.training):
        return found
    records = (folder / "training" / METRICS).read_text().splitlines()
    enough = json.loads(records[-1])["best_epoch"] + 1
    epochs = config.epochs or _usual_epochs(sum(int(clip.good.sum()) for clip in clips.training), config)
    return train_lstm(
        clips.all, (), layout, std, folder / "final",
        lstm=lstm, config=replace(config, epochs=epochs), linear=linear, device=device, stop_after=enough,
    )  # fmt: skip


def _usual_epochs(windows: int, config: TrainingConfig) -> int:
    return max(USUAL_EPOCHS, math.ceil(LEAST_STEPS / max(1, math.ceil(windows / config.batch))))


def train_lstm(
    training: Sequence[Clip],
    validation: Sequence[Clip],
    layout: ControlLayout,
    std: Float[np.ndarray, " shapes"],
    folder: Path,
    *,
    lstm: LstmConfig,
    config: TrainingConfig,
    linear: LinearRegressor | None = None,
    device: str = "cpu",
    stop_after: int | None = None,
) -> LstmRegressor:
    """Train until the validation clips get no better, going on from the checkpoint in `folder` if there is one.

    Args:
        validation: decide when to stop and which weights to keep; without any, the training clips do.
        folder: gets checkpoints/ and metrics.jsonl.
        linear: the regression whose remainder is predicted, where `lstm.over_linear` wants that.
        stop_after: epochs after which to stop and keep what there is, though the learning rate was to fall on.
    Raises:
        InputError: torch does not know the device, or the checkpoint is damaged.
    """
    validation = validation or training
    if not lstm.over_linear:
        linear = None
    elif linear is None:
        raise InputError("training: expected a linear regression, over which the LSTM is to learn, found none")
    scales, inputs, targets, known = _windows(training, layout, std, lstm, linear)
    place = usable_device(device)
    with _threads(config.threads):
        torch.manual_seed(config.seed)
        network = EncoderDecoder(inputs.shape[2], targets.shape[2], lstm).to(place)
        optimiser = torch.optim.Adam(
            network.parameters(),
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
            decoupled_weight_decay=True,
            foreach=False,
        )
        count = max(1, math.ceil(len(inputs) / config.batch))
        epochs = config.epochs or _usual_epochs(len(inputs), config)
        last = epochs if stop_after is None else min(stop_after, epochs)
        best = {name: each.clone() for name, each in network.state_dict().items()}
        progress = _Progress(records=[])
        checkpoint = folder / "checkpoints" / _CHECKPOINT
        if checkpoint.is_file():
            progress = _resume(checkpoint, network, optimiser, best)
        weight = _loss_weights(scales, config).to(place)
        assert progress.records is not None
        saved = time.monotonic()

        while progress.epoch < last and progress.epoch - progress.best_epoch <= config.patience:
            order = np.random.default_rng([config.seed, progress.epoch]).permutation(len(inputs))
            batches = np.array_split(order, count)
            for group in optimiser.param_groups:
                group["lr"] = config.learning_rate * (1 + math.cos(math.pi * progress.epoch / epochs)) / 2
            network.train()
            for batch in batches[progress.step :]:
                controls, wanted, mask = (torch.from_numpy(each[batch]).to(place) for each in (inputs, targets, known))
                if config.control_noise > 0:
                    controls = controls + config.control_noise * torch.randn(controls.shape).to(place)
                said = network(controls, wanted, config.teacher_forcing)
                loss = (weight * (said - wanted) ** 2 * mask[..., None]).sum() / (mask.sum() * len(weight)).clamp(min=1)
                optimiser.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(network.parameters(), config.clip_gradient, foreach=False)
                optimiser.step()
                progress.loss_sum += float(loss.detach())
                if not math.isfinite(progress.loss_sum):
                    raise InputError(f"training: the loss is no number in epoch {progress.epoch}; try a lower rate")
                progress.step += 1
                if time.monotonic() - saved >= config.checkpoint_s:
                    _save(checkpoint, network, optimiser, best, progress)
                    saved = time.monotonic()

            network.eval()
            error = mean_squared_error(LstmRegressor(layout, scales, lstm, network, linear), validation)
            if not math.isfinite(error):
                raise InputError(f"training: the loss is no number after epoch {progress.epoch}; try a lower rate")
            if error < progress.best or stop_after is not None:
                progress.best, progress.best_epoch = error, progress.epoch
                best = {name: each.clone() for name, each in network.state_dict().items()}
            progress.records.append(
                {
                    "epoch": progress.epoch,
                    "training_loss": progress.loss_sum / len(batches),
                    "validation_mse_mm2": 1e6 * error,
                    "best_epoch": progress.best_epoch,
                }
            )
            progress.epoch, progress.step, progress.loss_sum = progress.epoch + 1, 0, 0.0
            _write_metrics(folder / METRICS, progress.records)

        _save(checkpoint, network, optimiser, best, progress)
        _write_metrics(folder / METRICS, progress.records)
        network.load_state_dict(best)
        return LstmRegressor(layout, scales, lstm, network.eval(), linear)


def _windows(
    clips: Sequence[Clip],
    layout: ControlLayout,
    std: Float[np.ndarray, " shapes"],
    lstm: LstmConfig,
    linear: LinearRegressor | None,
) -> tuple[Scales, np.ndarray, np.ndarray, np.ndarray]:
    """All windows of the clips that end in a good frame: scales, controls (B, W, D), whitened coefficients (B, W, K),
    and which of those are known (B, W)."""
    full = [with_history(clip, layout.config.history, np.maximum(np.asarray(std, np.float32), 1e-6)) for clip in clips]
    controls = np.concatenate([clip.controls[clip.good] for clip in full]).astype(np.float64)
    scales = Scales.of(controls, std, layout)
    if lstm.weighed:
        coefficients = np.concatenate([clip.coefficients[clip.good] for clip in full])
        scales = scales.weighed(usual_response(scales.standardised(controls), coefficients))
    inputs, targets, known = [], [], []
    for clip, plain in zip(full, clips, strict=True):
        wanted = plain.coefficients if linear is None else plain.coefficients - linear.predict(plain.controls)
        whitened = scales.whitened(np.where(clip.good[:, None], wanted, 0))
        inputs.append(frame_windows(scales.standardised(clip.controls), lstm.window)[clip.good])
        targets.append(frame_windows(whitened, lstm.window)[clip.good])
        known.append(frame_windows(clip.good.astype(np.float32)[:, None], lstm.window)[clip.good, :, 0])
    if sum(map(len, inputs)) < 2:
        raise InputError(f"takes: expected at least 2 good frames to learn from, found {sum(map(len, inputs))}")
    return scales, np.concatenate(inputs), np.concatenate(targets), np.concatenate(known)


def _loss_weights(scales: Scales, config: TrainingConfig) -> Float[Tensor, " shapes"]:
    """What the square of a whitened error counts; 1 on average."""
    if config.loss == "whitened":
        return torch.ones(len(scales.std))
    squares = torch.from_numpy(scales.std.astype(np.float64) ** 2)
    return (squares / squares.mean()).float()


@contextlib.contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


# --- checkpoints -------------------------------------------------------------------------------------------------


def _save(
    path: Path,
    network: EncoderDecoder,
    optimiser: torch.optim.Optimizer,
    best: dict[str, Tensor],
    progress: _Progress,
) -> None:
    tensors = {f"network.{name}": each.numpy(force=True) for name, each in network.state_dict().items()}
    tensors |= {f"best.{name}": each.numpy(force=True) for name, each in best.items()}
    for index, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{index}.{name}": each.numpy(force=True) for name, each in state.items()}
    tensors["random_state"] = torch.get_rng_state().numpy()
    note = {
        "epoch": progress.epoch,
        "step": progress.step,
        "loss_sum": progress.loss_sum,
        "best": progress.best if math.isfinite(progress.best) else None,
        "best_epoch": progress.best_epoch,
        "records": progress.records,
    }
    write_tensors(path, _KIND, tensors, note)


def _resume(
    path: Path, network: EncoderDecoder, optimiser: torch.optim.Optimizer, best: dict[str, Tensor]
) -> _Progress:
    file = read_tensors(path, _KIND)
    tensors = {name: torch.from_numpy(each) for name, each in file.tensors.items()}

    def part(prefix: str) -> dict[str, Tensor]:
        return {name.removeprefix(prefix): each for name, each in tensors.items() if name.startswith(prefix)}

    try:
        network.load_state_dict(part("network."))
        for name, each in part("best.").items():
            best[name].copy_(each)
        states: dict[int, dict[str, Tensor]] = {}
        for name, each in part("optimiser.").items():
            index, key = name.split(".", 1)
            states.setdefault(int(index), {})[key] = each
        optimiser.load_state_dict({**optimiser.state_dict(), "state": states})
        torch.set_rng_state(tensors["random_state"])
    except (KeyError, RuntimeError) as error:
        raise InputError(f"{path}: a checkpoint of another network, or damaged ({error})") from None
    entry = file.entry
    record = entry("best")
    return _Progress(
        entry("epoch"), entry("step"), entry("loss_sum"), math.inf if record is None else record, entry("best_epoch"),
        list(entry("records")),
    )  # fmt: skip


def _write_metrics(path: Path, records: Sequence[dict[str, Any]]) -> None:
    write_bytes(path, "".join(json.dumps(record, sort_keys=True) + "\n" for record in records).encode())
