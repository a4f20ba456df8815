"""Which frames of a take are learned from, and which are held out: one rule for every network of the wing."""

from __future__ import annotations

from capture4d.errors import InputError

__all__ = ["split_rows"]


def split_rows(count: int, *, held_out: float, gap: int, name: str) -> tuple[range, range]:
    """The start of a take for training, and its end, some frames later, held out; as positions.

    A tenth of a short take is gap enough, but at least two frames are: high maps share the scans of their neighbours.

    Args:
        held_out: share of the frames.
        gap: frames between the two that belong to neither.
        name: of the take, for the message.
    Raises:
        InputError: there are not two frames left to train on.
    """
    tail = max(round(held_out * count), 1) if held_out > 0 else 0
    gap = min(gap, max(count // 10, 2)) if tail else 0
    left = count - tail - gap
    if left < 2:
        raise InputError(f"{name}: expected at least 2 frames to train on, found {left}")
    return range(left), range(count - tail, count)
