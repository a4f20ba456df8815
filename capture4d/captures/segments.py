"""A take cut into segments that need nothing from each other until they are joined.

A segment is followed frame from frame, so its frames are done one after the other; segments are done side by side, on
as many processes and machines as there are. A segment is followed from some frames before its first one on, from a
start that needs no frame before, and has found its way by the time it begins. Those frames are the earlier segment's,
too: there the two are compared, and joined.

Where a take is cut depends on how many frames it has, and on nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

__all__ = ["Segment", "cut"]


@dataclass(frozen=True, slots=True)
class Segment:
    """Some frames of a take, by their positions in it."""

    index: int
    """Among the segments."""
    lead: int
    """Position from which it is followed."""
    start: int
    """Position of its first frame."""
    stop: int
    """Position behind its last frame."""


def cut(frames: int, length: int, overlap: int) -> tuple[Segment, ...]:
    """Cut a take into segments of `length` frames; the last one has half of that to one and a half.

    Args:
        frames: of the take.
        overlap: frames before its first one from which a segment is followed; at most half of `length`.
    """
    count = max(1, (frames + length // 2) // length)
    starts = [length * index for index in range(count)]
    ahead = min(overlap, length // 2)
    return tuple(
        Segment(index, start - ahead if index else start, start, stop)
        for index, (start, stop) in enumerate(pairwise([*starts, frames]))
    )
