"""Lists of frames as people read them: "12-19, 44, 60-61". Standard library alone, for the command line loads it."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

__all__ = ["frame_ranges"]


def frame_ranges(ids: Iterable[int], *, among: Iterable[int] | None = None, most: int | None = None) -> str:
    """Frames in order, those that follow each other as ranges; empty if there are none.

    Args:
        ids: frame numbers, in any order, perhaps more than once.
        among: all frames of the take: those follow each other that are neighbours there, so that a take of every
            second frame has ranges, too. Whole numbers if None.
        most: ranges to name, the longest ones; the rest are counted, as in "12-19, 60-61 and 7 more". All if None.
    """
    chosen = sorted(set(ids))
    if not chosen:
        return ""
    places = {frame_id: place for place, frame_id in enumerate(sorted(set(among)))} if among is not None else {}
    runs = [[chosen[0]]]
    for before, frame_id in pairwise(chosen):
        if places.get(frame_id, frame_id) - places.get(before, before) == 1:
            runs[-1].append(frame_id)
        else:
            runs.append([frame_id])
    named = runs if most is None else sorted(sorted(runs, key=len, reverse=True)[:most])
    said = ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in named)
    left = len(chosen) - sum(map(len, named))
    return f"{said} and {left} more" if left else said
