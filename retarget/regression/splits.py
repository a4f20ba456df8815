"""Which frames are learned from, which decide, and which are kept for the end: by takes, never by neighbours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from capture4d.errors import InputError
from retarget.config import SplitConfig

__all__ = ["ROLES", "Piece", "Role", "split_takes"]

Role = Literal["training", "validation", "held out"]
ROLES: tuple[Role, ...] = ("training", "validation", "held out")


@dataclass(frozen=True, slots=True)
class Piece:
    """Consecutive frames of one take, as positions in it, and what they are for."""

    take: int
    frames: range
    role: Role


def split_takes(names: Sequence[str], lengths: Sequence[int], fps: float, config: SplitConfig) -> tuple[Piece, ...]:
    """Give every take a role. The only take left to learn from is cut, with a gap, and its end validates.

    Args:
        names: of the takes.
        lengths: frames of each.
    Raises:
        InputError: a take is named that is not there, or none is left to learn from.
    """
    for name in (*config.validation, *config.held_out):
        if name not in names:
            raise InputError(f"split: expected a take among {', '.join(names)}, found '{name}'")
    held_out = [take for take, name in enumerate(names) if name in config.held_out]
    named = [take for take, name in enumerate(names) if name in config.validation and take not in held_out]
    rest = [take for take in range(len(names)) if take not in held_out and take not in named]
    if not rest:
        raise InputError(f"split: expected a take to learn from, found {len(names)} that are all set aside")
    roles: dict[int, Role] = dict.fromkeys(held_out, "held out")
    roles.update(dict.fromkeys(named, "validation"))
    if not named and config.validation_share > 0:
        if len(rest) == 1:
            return (*_pieces(roles, lengths), *_cut(rest[0], lengths[rest[0]], fps, config))
        chosen = _some_takes(rest, lengths, config)
        roles.update(dict.fromkeys(chosen, "validation"))
        rest = [take for take in rest if take not in chosen]
    roles.update(dict.fromkeys(rest, "training"))
    return _pieces(roles, lengths)


def _pieces(roles: Mapping[int, Role], lengths: Sequence[int]) -> tuple[Piece, ...]:
    return tuple(Piece(take, range(lengths[take]), role) for take, role in sorted(roles.items()))


def _some_takes(takes: Sequence[int], lengths: Sequence[int], config: SplitConfig) -> list[int]:
    """Random takes until they have the share of the frames; at least one, and not all."""
    total, chosen, frames = sum(lengths[take] for take in takes), [], 0
    for position in np.random.default_rng(config.seed).permutation(len(takes)).tolist():
        if chosen and (frames >= config.validation_share * total or len(chosen) == len(takes) - 1):
            break
        chosen.append(takes[position])
        frames += lengths[takes[position]]
    return chosen


def _cut(take: int, length: int, fps: float, config: SplitConfig) -> tuple[Piece, ...]:
    """The end of a take validates; the gap before it belongs to nobody."""
    start = length - max(1, round(config.validation_share * length))
    end = max(0, start - max(1, round(config.gap_s * fps)))
    if end < 2:
        return (Piece(take, range(length), "training"),)
    return Piece(take, range(end), "training"), Piece(take, range(start, length), "validation")
