"""The loop: killed and continued to the same bits, and the paper's networks counted without making them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from capture4d.errors import InputError
from retarget.mixture.config import PRESETS, NetworkConfig
from retarget.mixture.training import Examples, Trainer, made_network, said_by

CONFIG = NetworkConfig(hidden=16, epochs=12, learning_rate=3e-3)


def examples(seed: int = 0) -> Examples:
    rng = np.random.default_rng(seed)
    inputs = rng.normal(size=(40, 3)).astype(np.float32)
    wanted = np.column_stack([inputs[:, 0] * inputs[:, 1], inputs[:, 2]]).astype(np.float32)
    return Examples(inputs[:32], wanted[:32], inputs[32:], wanted[32:])


def weights(network: torch.nn.Module) -> list[np.ndarray]:
    return [each.numpy(force=True) for each in network.state_dict().values()]


@pytest.mark.parametrize("coupled", [False, True])
def test_what_was_killed_goes_on_to_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, coupled: bool):
    config = replace(CONFIG, coupled=coupled)
    whole = Trainer(tmp_path / "a", 5, 0)("net", examples(), config)

    class Killed(Exception):
        pass

    import retarget.mixture.training as module

    begun = []

    def step(said: torch.Tensor, wanted: torch.Tensor, config: NetworkConfig) -> torch.Tensor:
        begun.append(1)
        if len(begun) == 75:  # in the eighth epoch, three after the checkpoint
            raise Killed
        return real(said, wanted, config)

    real = module._loss  # pyright: ignore[reportPrivateUsage]
    monkeypatch.setattr(module, "_loss", step)
    with pytest.raises(Killed):
        Trainer(tmp_path / "b", 5, 0)("net", examples(), config)
    monkeypatch.setattr(module, "_loss", real)
    torch.manual_seed(99)
    again = Trainer(tmp_path / "b", 5, 0)("net", examples(), config)
    for one, other in zip(weights(whole.network), weights(again.network), strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.history == whole.history
    assert len(again.history) == 12


def test_it_learns_and_keeps_the_best_epoch(tmp_path: Path):
    shown = examples()
    found = Trainer(tmp_path, 50, 0)("net", shown, replace(CONFIG, epochs=200, dropout=0.0))
    errors = [row["validation"] for row in found.history]
    off = ((said_by(found.network, shown.checked_inputs) - shown.checked_wanted) ** 2).sum(axis=1).mean()
    assert off == pytest.approx(min(errors), rel=1e-5)
    assert off < 0.3 * (shown.checked_wanted**2).sum(axis=1).mean()


def test_it_stops_when_nothing_gets_better(tmp_path: Path):
    noise = np.random.default_rng(3).normal(size=(40, 2)).astype(np.float32)
    shown = replace(examples(), wanted=noise[:32], checked_wanted=noise[32:])
    found = Trainer(tmp_path, 50, 0)("net", shown, replace(CONFIG, epochs=400, patience=5, learning_rate=0.02))
    errors = [row["validation"] for row in found.history]
    assert len(errors) == int(np.argmin(errors)) + 1 + 5 < 400


def test_nothing_to_learn_from_is_said(tmp_path: Path):
    empty = examples().inputs[:0]
    with pytest.raises(InputError, match="net: expected drapes to learn from, found none"):
        Trainer(tmp_path, 5, 0)("net", Examples(empty, empty, empty, empty), CONFIG)


def test_the_papers_networks_have_as_many_parameters_as_printed():
    """For trousers of 4,718 vertices in SMPL's 72, 10 and 4 numbers; 330.1 million in all."""
    paper, outputs = PRESETS["paper"], 3 * 4718
    with torch.device("meta"):
        counts = [
            sum(parameter.numel() for parameter in made_network(inputs, outputs, config).parameters())
            for inputs, config in (
                (72 + 10 + 4, paper.network), (72, paper.mixture.high), (10 + 4, paper.canonical.network)
            )
        ]  # fmt: skip
    assert counts == [15_646_538, 15_632_202, 1_844_298]
    assert round((counts[0] + 20 * counts[1] + counts[2]) / 1e6, 1) == 330.1
