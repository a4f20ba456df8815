"""A network learns one pair by heart; a run that was interrupted goes on as if it had not been."""

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from capture4d.errors import InputError
from wrinkles.normal_maps.config import (
    AugmentationConfig,
    LossConfig,
    NetworkConfig,
    ScheduleConfig,
    TemporalLoss,
    WrinkleConfig,
)
from wrinkles.normal_maps.inference import answer
from wrinkles.normal_maps.losses import data_loss, gan_loss, temporal_loss
from wrinkles.normal_maps.networks import UNet
from wrinkles.normal_maps.pairs import PairTake, augmented, batches, fitted, halved, split
from wrinkles.normal_maps.training import TrainingState, learning_rate, load_state, new_state, save_state, train_step

CONFIG = WrinkleConfig(
    texels=32,
    network=NetworkConfig(filters=8, layers=5, output="residual", dropout=0.5),
    schedule=ScheduleConfig(steps=100, batch=2, learning_rate=2e-3),
    augmentation=AugmentationConfig(turn_deg=5, noise=0.01),
)


def take(frames: int = 6, size: int = 32, frame_ids: list[int] | None = None) -> PairTake:
    """Maps whose high normals lean by a wave that the low ones tell by their own lean."""
    rng = np.random.default_rng(0)
    row = np.arange(size) / size
    wave = np.sin(2 * np.pi * (4 * row[None, :, None] + np.arange(frames)[:, None, None] / 12))
    lean = 0.2 * rng.standard_normal((frames, 1, 1))
    low = np.stack(np.broadcast_arrays(lean, 0 * wave, np.ones((frames, size, size))), axis=1)
    high = low + np.stack(np.broadcast_arrays(np.zeros((1, 1, 1)), 0.4 * wave, np.zeros((frames, size, size))), axis=1)
    valid = torch.ones(frames, 1, size, size, dtype=torch.bool)
    valid[:, :, :4, :4] = False
    unit = [normalize(torch.from_numpy(image).float(), dim=1) for image in (low, high)]
    ids = np.array(frame_ids or range(1, frames + 1), np.int32)
    return PairTake("take", ids, unit[0].half(), (unit[1] * valid).half(), valid)


def test_an_overfitted_pair_is_learned_by_heart():
    config = replace(
        CONFIG, augmentation=AugmentationConfig(), network=replace(CONFIG.network, dropout=0.0),
        loss=LossConfig(gan=0.1, temporal=0.0), schedule=replace(CONFIG.schedule, batch=1),
    )  # fmt: skip
    state, one = new_state(config), take(2)
    losses = []
    for batch, _ in zip(batches([one], size=1, seed=0, start=0), range(100), strict=False):
        losses.append(train_step(state, batch, config)["data"])
    assert losses[-1] < 0.15 * losses[0]


@pytest.mark.parametrize("kind", ["printed", "l1", "l2"])
def test_a_step_follows_the_gradient_of_the_loss_as_written(kind: TemporalLoss):
    """1 * GAN + 100 * L1 to the frame's own map + 50 * temporal to that of the frame before, over known texels."""
    config = replace(
        CONFIG, augmentation=AugmentationConfig(), network=replace(CONFIG.network, dropout=0.0),
        loss=LossConfig(temporal_kind=kind),
    )  # fmt: skip
    state, known = new_state(config), take()
    known.valid[2:, :, 20:24] = False
    batch = next(batches([known], size=2, seed=0, start=0))
    unknown = ~batch.valid.expand_as(batch.high)
    shown: list[torch.Tensor] = []
    state.discriminator.register_forward_pre_hook(lambda _, arguments: shown.append(arguments[1].detach()))
    twin = copy.deepcopy(state.generator).train()
    losses = train_step(state, batch, config)
    assert len(shown) == 3  # the true map and the made one, and again the made one
    assert all((each[unknown] == 0).all() for each in shown)

    made = twin(batch.low)
    both = batch.valid & batch.previous_valid
    data, temporal = data_loss(made, batch.high, batch.valid), temporal_loss(made, batch.previous, both, kind)
    assert losses["data"] == pytest.approx(data.item(), rel=1e-4)
    assert losses["temporal"] == pytest.approx(temporal.item(), rel=1e-4)
    assert temporal_loss(made, batch.high, both, kind).item() != pytest.approx(temporal.item(), rel=0.01)
    logits = state.discriminator(batch.low, made * batch.valid)  # it has made its step, and stands
    (gan_loss(logits, real=True) + 100 * data + 50 * temporal).backward()
    for mine, own in zip(state.generator.parameters(), twin.parameters(), strict=True):
        assert mine.grad is not None
        assert own.grad is not None
        torch.testing.assert_close(mine.grad, own.grad, rtol=1e-3, atol=1e-5 * float(own.grad.abs().max()) + 1e-7)


def test_a_resumed_run_is_the_same_run_bit_for_bit(tmp_path: Path):
    def go_on(state: TrainingState, steps: int) -> TrainingState:
        stream = batches([take()], size=2, seed=CONFIG.seed, start=state.step)
        for batch, _ in zip(stream, range(steps), strict=False):
            train_step(state, batch, CONFIG)
        return state

    save_state(tmp_path / "whole", go_on(new_state(CONFIG), 8), [])
    unlogged = [{"data": 0.1, "gan": 0.2}, {"data": 1 / 3, "gan": float("nan")}]
    save_state(tmp_path / "stopped", go_on(new_state(CONFIG), 5), unlogged)
    torch.manual_seed(99)
    resumed = new_state(replace(CONFIG, seed=7))
    assert repr(load_state(tmp_path / "stopped", resumed)) == repr(unlogged)
    assert resumed.step == 5
    save_state(tmp_path / "again", go_on(resumed, 3), [])
    assert (tmp_path / "again").read_bytes() == (tmp_path / "whole").read_bytes()


def test_weights_of_another_architecture_are_refused(tmp_path: Path):
    path = tmp_path / "x"
    save_state(path, new_state(CONFIG), [])
    other = new_state(replace(CONFIG, network=replace(CONFIG.network, filters=4)))
    with pytest.raises(InputError, match=r"x: weights of another architecture: '.*', expected .*, found"):
        load_state(path, other)
    deeper = new_state(replace(CONFIG, texels=64, network=replace(CONFIG.network, layers=6)))
    with pytest.raises(InputError, match="another architecture"):
        load_state(path, deeper)
    with pytest.raises(InputError, match="at most 5 for maps of 32"):
        new_state(replace(CONFIG, network=replace(CONFIG.network, layers=6)))


def test_batches_are_the_same_from_wherever_one_starts_and_epochs_are_complete():
    one = take(7)
    stream = batches([one], size=2, seed=3, start=0)
    first = [next(stream) for _ in range(6)]
    later = next(batches([one], size=2, seed=3, start=4))
    torch.testing.assert_close(first[4].low, later.low)
    lows = torch.cat([batch.low for batch in first[:3]]).flatten(1)
    assert len(torch.unique(lows, dim=0)) == 6  # 6 consecutive pairs of 7 frames, each once


def test_squares_are_the_same_place_of_every_map_and_reach_everywhere():
    one = take(7)
    rows, columns = np.mgrid[:32, :32].astype(np.float16) / 32
    where = torch.from_numpy(np.stack([rows, columns, np.ones_like(rows)]))
    marked = replace(one, low=where.expand(7, 3, 32, 32), high=where.expand(7, 3, 32, 32))
    stream = batches([marked], size=2, seed=3, start=0, crop=8)
    starts = []
    for batch, _ in zip(stream, range(60), strict=False):
        assert batch.low.shape == batch.previous.shape == (2, 3, 8, 8)
        assert batch.valid.shape == batch.previous_valid.shape == (2, 1, 8, 8)
        torch.testing.assert_close(batch.low, batch.high)
        torch.testing.assert_close(batch.low, batch.previous)
        assert batch.valid.flatten(1).any(dim=1).all()
        starts += (32 * batch.low[:, :2, 0, 0]).tolist()
    assert np.ptp(starts, axis=0).min() >= 20
    later = next(batches([marked], size=2, seed=3, start=4, crop=8))
    again = next(stream for stream in [batches([marked], size=2, seed=3, start=0, crop=8)])
    for _ in range(4):
        next(again)
    torch.testing.assert_close(next(again).low, later.low)


def test_squares_must_fit_the_maps_and_the_network():
    for crop, layers, said in (
        (64, 5, "crop: expected at most the 32 texels of the maps, found 64"),
        (24, 5, "network.layers: expected at most 3 for squares of 24 texels, found 5"),
    ):
        with pytest.raises(InputError, match=said):
            new_state(replace(CONFIG, crop=crop, network=replace(CONFIG.network, layers=layers)))


def by_squares(paint: Callable[[torch.Tensor], torch.Tensor], image: torch.Tensor, side: int) -> torch.Tensor:
    """What a network of squares makes of an image."""
    network = UNet(NetworkConfig(filters=2, layers=2, output="absolute"))
    network.paint = paint
    return answer(network, image, image, crop=side)


@pytest.mark.parametrize(("size", "side"), [(32, 32), (32, 8), (30, 8), (40, 16)])
def test_squares_cover_a_map_and_fade_into_one_another(size: int, side: int):
    image = torch.rand(1, 3, size, size, generator=torch.Generator().manual_seed(0)) + 0.1
    torch.testing.assert_close(by_squares(lambda tile: 2 * tile, image, side), 2 * image)
    seen = []

    def numbered(tile: torch.Tensor) -> torch.Tensor:
        assert tile.shape[-2:] == (side, side)
        seen.append(tile)
        return torch.full_like(tile, float(len(seen)))

    made = by_squares(numbered, image, side)[0, 0]
    if side < size:  # neighbours differ by whole numbers; the map goes from one to the other in steps
        assert made[0].diff().abs().max() < 0.9
    half = image.clone()
    half[..., : size // 2, :] = 0
    before = len(seen)
    made = by_squares(numbered, half, side)
    if side < size // 2:
        assert not made[..., : size // 2 - side, :].any()
        assert len(seen) - before < before


def test_the_frame_before_is_the_frame_before():
    one = take(6, frame_ids=[1, 2, 3, 8, 9, 10])
    assert one.consecutive().tolist() == [1, 2, 4, 5]
    batch = next(batches([one], size=4, seed=0, start=0))
    for low, previous in zip(batch.high, batch.previous, strict=True):
        at = [torch.equal(low, each.float()) for each in one.high].index(True)
        assert torch.equal(previous, one.high[at - 1].float())


def test_a_take_without_neighbours_is_refused():
    one = take(4)
    blank = replace(one, valid=torch.zeros_like(one.valid))
    with pytest.raises(InputError, match="take: expected consecutive frames"):
        next(batches([blank], size=1, seed=0, start=0))


def test_the_end_of_a_take_is_held_out_behind_a_gap():
    train, held = split(take(40), held_out=0.1, gap=10)
    assert held.frame_ids.tolist() == [37, 38, 39, 40]
    assert train.frame_ids.tolist() == list(range(1, 33))
    with pytest.raises(InputError, match="at least 2 frames"):
        split(take(2), held_out=0.5, gap=0)


def test_turned_pairs_keep_their_angles():
    torch.manual_seed(0)
    batch = next(batches([take()], size=3, seed=0, start=0))
    turned = augmented(batch, AugmentationConfig(turn_deg=30))
    assert not torch.allclose(turned.low, batch.low)
    torch.testing.assert_close((turned.low * turned.high).sum(1), (batch.low * batch.high).sum(1))
    torch.testing.assert_close(turned.low[:, 1], batch.low[:, 1])
    assert augmented(batch, AugmentationConfig()) is batch


def test_halved_maps_are_means_of_what_is_known():
    one = take(2)
    half = halved(one)
    assert half.low.shape == (2, 3, 16, 16)
    assert not half.valid[:, :, :2, :2].any()
    assert half.valid[:, :, 2:].all()
    expected = normalize(one.high[0, :, 8:10, 8:10].float().mean(dim=(1, 2)), dim=0)
    torch.testing.assert_close(half.high[0, :, 4, 4].float(), expected, atol=2e-3, rtol=0)
    assert fitted(one, 8).low.shape[-1] == 8
    with pytest.raises(InputError, match="24 texels"):
        fitted(one, 24)


def test_the_learning_rate_falls_to_zero():
    schedule = ScheduleConfig(steps=100, learning_rate=1.0, decay_from=0.5)
    assert [learning_rate(step, schedule) for step in (0, 50, 75, 100)] == [1.0, 1.0, 0.5, 0.0]
