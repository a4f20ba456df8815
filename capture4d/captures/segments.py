"""A take cut into segments that need nothing from each other until they are joined.

A segment is followed frame from frame, so its frames are done one after the other; segments are done side by side, on
as many processes and machines as there are. A segment is followed from some frames before its first one on, from a
start that needs no frame before, and has found its way by the time it begins. Those frames are the earlier segment's,
too: there the two are compared, and joined.

Where a take is cut depends on its frames alone: on how many there are and, where it is told, on how easily one can
begin in each; never on who does the work.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

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


def cut(
    frames: int, length: int, overlap: int, *, unease: Float[np.ndarray, " frames"] | None = None
) -> tuple[Segment, ...]:
    """Cut a take into segments of about `length` frames; all but the last one have half of that to one and a half.

    Args:
        frames: of the take.
        overlap: frames before its first one from which a segment is followed; at most half of `length`.
        unease: of each frame, how unsafe it is to begin there. Segments are then followed from the easiest frame within
            a quarter of the length of where they would be otherwise, the nearest of equal ones; None: from there.
    """
    count = max(1, (frames + length // 2) // length)
    ahead, reach = min(overlap, length // 2), length // 4
    starts = [length * index for index in range(count)]
    if unease is not None:
        away = np.arange(-reach, reach + 1)
        away = away[np.argsort(np.abs(away), kind="stable")]
        starts[1:] = [int(start + away[np.argmin(unease[start - ahead + away])]) for start in starts[1:]]
    return tuple(
        Segment(index, start - ahead if index else start, start, stop)
        for index, (start, stop) in enumerate(pairwise([*starts, frames]))
    )
