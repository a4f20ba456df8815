"""Training the network: a step on a state, and a loop from the first step to the best weights that can be killed at
any moment.

Everything a resume needs is in one checkpoint: weights, the best weights so far, the optimiser's state, torch's random
state, the place in the data, and the lines of metrics.jsonl. The order of the windows in an epoch follows from the seed
and the epoch's number. On a CPU, with the same number of threads, a run that was killed and continued ends with the
same bits as one that was not.
"""

from __future__ import annotations

import contextlib
import copy
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from capture4d.errors import InputError
from capture4d.files.atomic import write_json_lines
from capture4d.learning.checkpoints import read_checkpoint, write_checkpoint
from retarget.config import FitConfig, LstmConfig, TrainingConfig
from retarget.regression.controls import ControlLayout
from retarget.regression.linear import LinearRegressor, fit_linear
from retarget.regression.lstm import EncoderDecoder, LstmRegressor, frame_windows, usable_device
from retarget.regression.regressors import Clip, FittingClips, Scales, mean_squared_error, usual_response, with_history

__all__ = ["Batch", "FittedLstm", "TrainedLstm", "TrainingState", "fit_lstm", "train_lstm", "train_step"]

_KIND = "capture4d lstm training"
_CHECKPOINT = "last.safetensors"
METRICS = "metrics.jsonl"
USUAL_EPOCHS, LEAST_STEPS = 30, 500
"""Where the settings leave the number of epochs open."""


class TrainedLstm(NamedTuple):
    """A network, and after how many epochs it was at its best."""

    regressor: LstmRegressor
    epochs: int


class FittedLstm(NamedTuple):
    """A network of all clips, and one of the training clips alone, which shows how it validated."""

    regressor: LstmRegressor
    alone: LstmRegressor


@dataclass(slots=True, eq=False)
class TrainingState:
    """Everything that training changes; saved with every checkpoint."""

    network: EncoderDecoder
    optimiser: torch.optim.Adam
    best: EncoderDecoder
    """The weights that validated best."""
    best_error: float = math.inf
    """Mean square, square metres."""
    best_epoch: int = -1
    epoch: int = 0
    step: int = 0
    """Steps done in this epoch."""
    loss_sum: float = 0.0
    """Of this epoch's steps."""
    records: list[dict[str, Any]] = field(default_factory=list)
    """One of each epoch, for metrics.jsonl."""


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Windows that end in a good frame: what the network is given, and what it shall say."""

    controls: Float32[np.ndarray, "windows W controls"]
    """Standardised."""
    coefficients: Float32[np.ndarray, "windows W shapes"]
    """Whitened."""
    known: Float32[np.ndarray, "windows W"]
    """1: a frame whose coefficients are known; 0: one whose are not."""

    def __len__(self) -> int:
        return len(self.controls)


class Batch(NamedTuple):
    """Some windows, where the network is."""

    controls: Float[Tensor, "B W controls"]
    coefficients: Float[Tensor, "B W shapes"]
    known: Float[Tensor, "B W"]


def fit_lstm(
    clips: FittingClips,
    layout: ControlLayout,
    std: Float[np.ndarray, " shapes"],
    folder: Path,
    config: FitConfig,
    *,
    linear: LinearRegressor,
    device: str = "cpu",
) -> FittedLstm:
    """Train on some clips until those that validate get no better; then as long on all of them.

    Args:
        folder: gets training/ and final/, each with checkpoints and metrics.jsonl.
        config: of which `lstm`, `training` and `linear` count.
        linear: the regression over which the network stands, if `lstm.over_linear`; fitted to all clips.
    Raises:
        InputError: torch does not know the device, or a checkpoint is damaged.
    """
    everything = FittingClips(clips.all, (), clips.all)
    if not clips.validation:
        found = train_lstm(everything, layout, std, folder / "final", config, linear=linear, device=device)
        return FittedLstm(found.regressor, found.regressor)
    alone = fit_linear(clips.settled, layout, std, replace(config.linear, ridges=(linear.ridge,)))
    found = train_lstm(clips, layout, std, folder / "training", config, linear=alone, device=device)
    if len(clips.all) == len(clips.training):
        return FittedLstm(found.regressor, found.regressor)
    epochs = config.training.epochs or _usual_epochs(
        sum(int(clip.good.sum()) for clip in clips.training), config.training
    )
    settled = replace(config, training=replace(config.training, epochs=epochs))
    final = train_lstm(
        everything, layout, std, folder / "final", settled, linear=linear, device=device, stop_after=found.epochs
    )
    return FittedLstm(final.regressor, found.regressor)


def _usual_epochs(windows: int, config: TrainingConfig) -> int:
    return max(USUAL_EPOCHS, math.ceil(LEAST_STEPS / _steps_per_epoch(windows, config)))


def _steps_per_epoch(windows: int, config: TrainingConfig) -> int:
    return max(1, math.ceil(windows / config.batch))


def train_lstm(
    clips: FittingClips,
    layout: ControlLayout,
    std: Float[np.ndarray, " shapes"],
    folder: Path,
    config: FitConfig,
    *,
    linear: LinearRegressor | None = None,
    device: str = "cpu",
    stop_after: int | None = None,
) -> TrainedLstm:
    """Train on the training clips until the validation clips get no better, going on from the checkpoint in `folder`
    if there is one.

    Args:
        clips: those that validate decide when to stop and which weights to keep; without any, the training clips do.
        folder: gets checkpoints/ and metrics.jsonl.
        config: of which `lstm` and `training` count.
        linear: the regression whose remainder is predicted, where `lstm.over_linear` wants that.
        stop_after: epochs after which to stop and keep what there is, though the learning rate was to fall on.
    Raises:
        InputError: torch does not know the device, or the checkpoint is damaged.
    """
    lstm, training = config.lstm, config.training
    if not lstm.over_linear:
        linear = None
    elif linear is None:
        raise InputError("training: expected a linear regression, over which the LSTM is to learn, found none")
    scales, windows = _windows(clips.training, layout, std, lstm, linear)
    epochs = training.epochs or _usual_epochs(len(windows), training)
    last = epochs if stop_after is None else min(stop_after, epochs)
    place, checkpoint = usable_device(device), folder / "checkpoints" / _CHECKPOINT
    with _threads(training.threads):
        state, weight = _new_state(windows, config, place), _loss_weights(scales, training).to(place)
        if checkpoint.is_file():
            _load(checkpoint, state)
        regressor, saved = LstmRegressor(layout, scales, lstm, state.network, linear), time.monotonic()
        while state.epoch < last and state.epoch - state.best_epoch <= training.patience:
            _set_learning_rate(state, epochs, training)
            for batch in _batches(windows, state, training, place):
                train_step(state, batch, weight, training)
                if time.monotonic() - saved >= training.checkpoint_s:
                    _save(checkpoint, state)
                    saved = time.monotonic()
            state.network.eval()
            error = mean_squared_error(regressor, clips.validation or clips.training)
            _end_epoch(state, error, keep=stop_after is not None)
            _write_metrics(folder / METRICS, state.records)
        _save(checkpoint, state)
        _write_metrics(folder / METRICS, state.records)
        state.network.load_state_dict(state.best.state_dict())
    return TrainedLstm(regressor, state.best_epoch + 1)


def _new_state(windows: Windows, config: FitConfig, place: torch.device) -> TrainingState:
    """A fresh network; seeds torch's generator."""
    torch.manual_seed(config.training.seed)
    network = EncoderDecoder(windows.controls.shape[2], windows.coefficients.shape[2], config.lstm).to(place).eval()
    optimiser = torch.optim.Adam(
        network.parameters(),
        lr=config.training.learning_rate,
        weight_decay=config.training.weight_decay,
        decoupled_weight_decay=True,
        foreach=False,
    )
    return TrainingState(network, optimiser, copy.deepcopy(network))


def _set_learning_rate(state: TrainingState, epochs: int, config: TrainingConfig) -> None:
    """Along a cosine to zero."""
    for group in state.optimiser.param_groups:
        group["lr"] = config.learning_rate * (1 + math.cos(math.pi * state.epoch / epochs)) / 2


def _batches(windows: Windows, state: TrainingState, config: TrainingConfig, place: torch.device) -> Iterator[Batch]:
    """What is left of the epoch."""
    order = np.random.default_rng([config.seed, state.epoch]).permutation(len(windows))
    for rows in np.array_split(order, _steps_per_epoch(len(windows), config))[state.step :]:
        chosen = windows.controls[rows], windows.coefficients[rows], windows.known[rows]
        yield Batch(*(torch.from_numpy(each).to(place) for each in chosen))


def train_step(state: TrainingState, batch: Batch, weight: Float[Tensor, " shapes"], config: TrainingConfig) -> None:
    """Improve the network on some windows.

    Args:
        weight: what the square of a coefficient's error counts.
    Raises:
        InputError: the loss is no number any more.
    """
    controls, wanted, known = batch
    if config.control_noise > 0:
        controls = controls + config.control_noise * torch.randn(controls.shape).to(controls.device)
    state.network.train()
    said = state.network(controls, wanted, config.teacher_forcing)
    loss = (weight * (said - wanted) ** 2 * known[..., None]).sum() / (known.sum() * len(weight)).clamp(min=1)
    state.optimiser.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(state.network.parameters(), config.clip_gradient, foreach=False)
    state.optimiser.step()
    state.loss_sum += float(loss.detach())
    if not math.isfinite(state.loss_sum):
        raise InputError(f"training: the loss is no number in epoch {state.epoch}; try a lower rate")
    state.step += 1


def _end_epoch(state: TrainingState, error: float, *, keep: bool) -> None:
    """Note how the epoch went, and go on to the next.

    Args:
        error: mean square on the validation clips, square metres.
        keep: take its weights for the best in any case.
    """
    if not math.isfinite(error):
        raise InputError(f"training: the loss is no number after epoch {state.epoch}; try a lower rate")
    if error < state.best_error or keep:
        state.best_error, state.best_epoch = error, state.epoch
        state.best.load_state_dict(state.network.state_dict())
    record = {
        "epoch": state.epoch,
        "training_loss": state.loss_sum / state.step,
        "validation_mse_mm2": 1e6 * error,
        "best_epoch": state.best_epoch,
    }
    state.records.append(record)
    state.epoch, state.step, state.loss_sum = state.epoch + 1, 0, 0.0


def _windows(
    clips: Sequence[Clip],
    layout: ControlLayout,
    std: Float[np.ndarray, " shapes"],
    lstm: LstmConfig,
    linear: LinearRegressor | None,
) -> tuple[Scales, Windows]:
    """All windows of the clips that end in a good frame, and how their controls and coefficients are scaled."""
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
    return scales, Windows(np.concatenate(inputs), np.concatenate(targets), np.concatenate(known))


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


def _networks(state: TrainingState) -> dict[str, torch.nn.Module]:
    return {"network": state.network, "best": state.best}


def _save(path: Path, state: TrainingState) -> None:
    note = {
        "epoch": state.epoch,
        "step": state.step,
        "loss_sum": state.loss_sum,
        "best_error": state.best_error if math.isfinite(state.best_error) else None,
        "best_epoch": state.best_epoch,
        "records": state.records,
    }
    write_checkpoint(path, _KIND, modules=_networks(state), optimisers={"adam": state.optimiser}, note=note)


def _load(path: Path, state: TrainingState) -> None:
    """Go on from a checkpoint."""
    _, note = read_checkpoint(
        path, _KIND, modules=_networks(state), optimisers={"adam": state.optimiser}, command="capture4d fit"
    )
    state.epoch, state.step, state.loss_sum = note["epoch"], note["step"], note["loss_sum"]
    state.best_error = math.inf if note["best_error"] is None else note["best_error"]
    state.best_epoch, state.records = note["best_epoch"], note["records"]


def _write_metrics(path: Path, records: Sequence[dict[str, Any]]) -> None:
    write_json_lines(path, records, sort_keys=True)
