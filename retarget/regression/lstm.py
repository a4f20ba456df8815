"""The sequence-to-sequence network: an encoder reads the last controls, a decoder says the last coefficients.

Both are LSTMs of the same depth and size. The decoder starts from the encoder's state and is fed its own last answer,
zeros at first; of its answers the last, that of the present frame, is taken. A window begins with the first frame of a
motion repeated. Nothing outlives a window, so running freely cannot drift.

Letters: B windows, W frames in a window, D controls, K coefficients.
References: DeepWrinkles (ECCV 2018), section 3.3: 4 layers of 256, 3 frames in and 3 out.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from capture4d.errors import InputError
from capture4d.files.reading import one_line
from capture4d.learning.checkpoints import filled
from capture4d.settings import SettingError
from retarget.config import LstmConfig
from retarget.regression.controls import ControlLayout
from retarget.regression.linear import LinearRegressor
from retarget.regression.regressors import History, Scales, read_regressor, write_regressor

__all__ = ["EncoderDecoder", "LstmRegressor", "load_lstm", "save_lstm", "usable_device"]

_KIND = "capture4d lstm regressor"
BATCH = 1024
"""Windows that are answered together."""


class EncoderDecoder(nn.Module):
    """Standardised controls in, whitened coefficients out."""

    def __init__(self, controls: int, shapes: int, config: LstmConfig) -> None:
        super().__init__()
        self.encoder = nn.LSTM(controls, config.size, config.layers, batch_first=True)
        self.decoder = nn.LSTM(shapes, config.size, config.layers, batch_first=True)
        self.head = nn.Linear(config.size, shapes)

    def forward(
        self,
        controls: Float[Tensor, "windows frames controls"],
        truth: Float[Tensor, "windows frames shapes"] | None = None,
        forced: float = 0.0,
    ) -> Float[Tensor, "windows frames shapes"]:
        """One answer a frame.

        Args:
            truth: whitened coefficients, fed to the decoder instead of its own answer ...
            forced: ... with this probability, drawn for each step from torch's generator.
        """
        _, state = self.encoder(controls)
        said = controls.new_zeros(len(controls), 1, self.head.out_features)
        answers = []
        for frame in range(controls.shape[1]):
            hidden, state = self.decoder(said, state)
            said = self.head(hidden)
            answers.append(said)
            if truth is not None and forced > 0 and float(torch.rand(())) < forced:
                said = truth[:, frame : frame + 1]
        return torch.cat(answers, dim=1)


@dataclass(frozen=True, slots=True, eq=False)
class LstmRegressor:
    """A trained network with its scales, and the linear regression it stands on, if any."""

    layout: ControlLayout
    scales: Scales
    config: LstmConfig
    network: EncoderDecoder
    linear: LinearRegressor | None = None

    def stream(self) -> LstmStream:
        return LstmStream(self)

    def predict(self, controls: Float32[np.ndarray, "frames controls"]) -> Float32[np.ndarray, "frames shapes"]:
        if self.layout.config.history:
            stream = self.stream()
            return np.array([stream.push(row) for row in controls], np.float32).reshape(-1, len(self.scales.std))
        windows = frame_windows(self.scales.standardised(controls), self.config.window)
        answers = [self.answer_windows(windows[start : start + BATCH]) for start in range(0, len(windows), BATCH)]
        result = np.concatenate([np.zeros((0, len(self.scales.std)), np.float32), *answers])
        return result if self.linear is None else result + self.linear.predict(controls)

    def answer_windows(
        self, windows: Float32[np.ndarray, "windows frames controls"]
    ) -> Float32[np.ndarray, "windows shapes"]:
        """Coefficients of the last frame of each window."""
        device = self.network.head.weight.device
        with torch.inference_mode():
            said = self.network(torch.from_numpy(windows).to(device))[:, -1]
        return said.numpy(force=True) * self.scales.std


class LstmStream:
    """A motion that is answered frame by frame."""

    def __init__(self, regressor: LstmRegressor) -> None:
        self._regressor = regressor
        self._window: deque[np.ndarray] = deque(maxlen=regressor.config.window)
        self._history = History(regressor.layout.config.history, len(regressor.scales.std))
        self._linear = None if regressor.linear is None else regressor.linear.stream()

    def push(self, controls: Float[np.ndarray, " controls"]) -> Float32[np.ndarray, " shapes"]:
        regressor = self._regressor
        known = regressor.scales.standardised(self._history.extend(controls))
        while len(self._window) < regressor.config.window - 1:
            self._window.append(known)
        self._window.append(known)
        answer = regressor.answer_windows(np.stack(self._window)[None])[0]
        if self._linear is not None:
            answer = answer + self._linear.push(controls)
        self._history.push(answer / regressor.scales.std)
        return answer


def frame_windows(
    rows: Float32[np.ndarray, "frames controls"], window: int
) -> Float32[np.ndarray, "frames window controls"]:
    """For each frame, the frames up to it; before the first, the first."""
    positions = np.maximum(np.arange(len(rows))[:, None] + np.arange(1 - window, 1), 0)
    return rows[positions]


def usable_device(name: str) -> torch.device:
    """
    Raises:
        InputError: torch does not know it, or cannot compute there.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"device: expected one that torch can use, such as cpu, found '{name}' ({error})") from None
    return device


def save_lstm(path: Path, regressor: LstmRegressor, *, model_digest: str) -> None:
    weights = {f"network.{name}": each.numpy(force=True) for name, each in regressor.network.state_dict().items()}
    note = {"lstm": asdict(regressor.config)}
    write_regressor(
        path,
        _KIND,
        weights,
        layout=regressor.layout,
        scales=regressor.scales,
        model_digest=model_digest,
        note=note,
    )


def load_lstm(
    path: Path, *, model_digest: str, linear: LinearRegressor | None = None, device: str = "cpu"
) -> LstmRegressor:
    """
    Args:
        linear: the regression beside it, on which it stands if it was trained over one.
    Raises:
        InputError: the file is damaged, another kind, or belongs to another model.
    """
    file, layout, scales = read_regressor(path, _KIND, model_digest=model_digest)
    try:
        config = LstmConfig(**file.entry("lstm"))
    except TypeError as error:
        raise InputError(f"expected the settings of an LSTM, found others ({one_line(error)})", where=path) from None
    except SettingError as fault:
        raise fault.at(path) from None
    placed = usable_device(device)
    shapes = len(scales.std)
    controls = layout.size + layout.config.history * shapes
    weights = {name: torch.from_numpy(each) for name, each in file.prefixed("network.").items()}
    if config.layers > len(weights) or len(scales.control_mean) != controls:
        found = f"{len(weights)} tensors for {len(scales.control_mean)}"
        raise InputError(
            f"expected an LSTM of {config.layers} layers for {controls} controls, found {found}", where=path
        )
    network = filled(lambda: EncoderDecoder(controls, shapes, config), weights, source=path)
    if config.over_linear and linear is None:
        raise InputError("expected the linear regression it was trained over beside it, found none", where=path)
    return LstmRegressor(layout, scales, config, network.to(placed).eval(), linear if config.over_linear else None)
