"""Pairs of maps in memory, in the order of the take: what the networks learn from."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from types import EllipsisType

import numpy as np
import torch
from jaxtyping import Bool, Float16, Int, Int32
from torch import Tensor
from torch.nn import functional

from capture4d.errors import InputError
from wrinkles.frame_split import split_rows
from wrinkles.normal_maps.config import AugmentationConfig

__all__ = ["Batch", "PairTake", "augmented", "batches", "consecutive_pairs", "fitted", "halved", "split"]


@dataclass(frozen=True, slots=True, eq=False)
class PairTake:
    """Maps of one take, garment coordinates, channels first. Half precision errs by 0.03 deg and halves the memory."""

    name: str
    frame_ids: Int32[np.ndarray, " frames"]
    low: Float16[Tensor, "frames 3 size size"]
    """Zero where the map shows nothing."""
    high: Float16[Tensor, "frames 3 size size"]
    """Zero where unknown."""
    valid: Bool[Tensor, "frames 1 size size"]

    def consecutive(self) -> Int[np.ndarray, " pairs"]:
        """Positions of the frames that follow directly on the one before, and know something in both."""
        if len(self.frame_ids) < 2:
            return np.zeros(0, np.int64)
        steps = np.diff(self.frame_ids)
        known = self.valid.flatten(1).any(dim=1).numpy()
        return 1 + np.flatnonzero((steps == steps.min()) & known[1:] & known[:-1])

    def without(self, frame_ids: Collection[int]) -> PairTake:
        """All frames but these."""
        kept = ~np.isin(self.frame_ids, list(frame_ids))
        at = torch.from_numpy(kept)
        return PairTake(self.name, self.frame_ids[kept], self.low[at], self.high[at], self.valid[at])

    def part(self, positions: range) -> PairTake:
        """Some frames in a row."""
        at = slice(positions.start, positions.stop)
        return PairTake(self.name, self.frame_ids[at], self.low[at], self.high[at], self.valid[at])


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Frames, and the true maps of the frames before them; float32."""

    low: Tensor
    high: Tensor
    valid: Tensor
    previous: Tensor
    """The high map of the frame before, known where `previous_valid`."""
    previous_valid: Tensor


def split(take: PairTake, *, held_out: float, gap: int) -> tuple[PairTake, PairTake]:
    """The frames to learn from and those held out, as `split_rows` has them."""
    learned, held = split_rows(len(take.frame_ids), held_out=held_out, gap=gap, name=take.name)
    return take.part(learned), take.part(held)


def fitted(take: PairTake, size: int) -> PairTake:
    """The take at this many texels a side.

    Raises:
        InputError: the maps are not that, nor twice that, nor four times, ...
    """
    found = take.low.shape[-1]
    while take.low.shape[-1] > size:
        take = halved(take)
    if take.low.shape[-1] != size:
        raise InputError(f"{take.name}: {unfit(size, found)}")
    return take


def unfit(size: int, found: int) -> str | None:
    """What is wrong with maps of `found` texels for a network of `size`; None: halved often enough, they are of it."""
    times, rest = divmod(found, size)
    if not rest and times & (times - 1) == 0 and times:
        return None
    return f"expected maps of {size} texels times a power of two, found {found}"


def halved(take: PairTake) -> PairTake:
    """Half the resolution: means of known texels, known where half of them are."""
    valid = take.valid.float()
    coarse_valid = functional.avg_pool2d(valid, 2)
    shown = (take.low != 0).any(dim=1, keepdim=True).float()
    low = _pooled(take.low, shown)
    high = _pooled(take.high, valid)
    kept = coarse_valid >= 0.5
    return replace(take, low=low, high=high * kept, valid=kept)


def _pooled(image: Tensor, known: Tensor) -> Tensor:
    mean = functional.avg_pool2d(image.float() * known, 2)
    return functional.normalize(mean, dim=1, eps=1e-6).half()


def consecutive_pairs(takes: Sequence[PairTake]) -> list[tuple[int, int]]:
    """Takes and positions in them of all frames that follow on another.

    Raises:
        InputError: there are none.
    """
    pairs = [(index, int(at)) for index, take in enumerate(takes) for at in take.consecutive()]
    if not pairs:
        raise InputError(f"{', '.join(take.name for take in takes)}: expected consecutive frames with known texels, "
                         "found none")  # fmt: skip
    return pairs


def batches(takes: Sequence[PairTake], *, size: int, seed: int, start: int, crop: int | None = None) -> Iterator[Batch]:
    """Random consecutive pairs without end, each once an epoch; batch `start` is the first.

    The same seed gives the same batches, wherever one starts.

    Args:
        crop: side of a square of each map, around a texel that is known; None: the whole map.
    """
    pairs = consecutive_pairs(takes)
    position = start * size
    while True:
        numbers = range(position, position + size)
        chosen = [pairs[_shuffled(len(pairs), seed, number // len(pairs))[number % len(pairs)]] for number in numbers]
        places = [
            _square(takes[index].valid[at, 0], crop, np.random.default_rng([seed, number, crop])) if crop else ...
            for number, (index, at) in zip(numbers, chosen, strict=True)
        ]
        position += size

        def stack(name: str, back: int = 0, chosen: list = chosen, places: list = places) -> Tensor:
            parts = [getattr(takes[index], name)[at - back] for index, at in chosen]
            return torch.stack([part[place] for part, place in zip(parts, places, strict=True)])

        yield Batch(
            stack("low").float(), stack("high").float(), stack("valid"), stack("high", 1).float(), stack("valid", 1)
        )


def _square(
    valid: Bool[Tensor, "size size"], side: int, random: np.random.Generator
) -> tuple[EllipsisType, slice, slice]:
    """A square of a map that holds one of its known texels, each as often as any other; it stays within the map."""
    known = torch.nonzero(valid)
    texel = known[random.integers(len(known))].numpy()
    first = np.clip(texel - random.integers(side, size=2), 0, len(valid) - side)
    return ..., slice(int(first[0]), int(first[0]) + side), slice(int(first[1]), int(first[1]) + side)


def _shuffled(count: int, seed: int, epoch: int) -> np.ndarray:
    return np.random.default_rng([seed, epoch]).permutation(count)


def augmented(batch: Batch, config: AugmentationConfig) -> Batch:
    """Vectors turned about the vertical, all maps of a sample alike; noise on the input.

    Draws from torch's generator.
    """
    if config.turn_deg > 0:
        from kornia.geometry.conversions import axis_angle_to_rotation_matrix

        angle = torch.deg2rad(config.turn_deg * torch.randn(len(batch.low)))
        turn = axis_angle_to_rotation_matrix(angle[:, None] * torch.tensor([0.0, 1.0, 0.0]))
        low, high, previous = (
            torch.einsum("bij,bjhw->bihw", turn, image) for image in (batch.low, batch.high, batch.previous)
        )
        batch = replace(batch, low=low, high=high, previous=previous)
    if config.noise > 0:
        from kornia.augmentation import RandomGaussianNoise

        shown = (batch.low != 0).any(dim=1, keepdim=True)
        batch = replace(batch, low=RandomGaussianNoise(std=config.noise, p=1.0)(batch.low) * shown)
    return batch
