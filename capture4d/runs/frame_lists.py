"""Frames as people write them: `1,5,10-20`, and with a step, `1-200:5`; and where their files lie."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

from capture4d.errors import InputError

__all__ = ["chosen_frames", "counted", "expanded", "frame_file", "listed"]

_PART = re.compile(r"\s*([0-9]{1,10})\s*(?:-\s*([0-9]{1,10})\s*(?::\s*([0-9]{1,10})\s*)?)?")


def chosen_frames(text: str, frame_ids: Sequence[int]) -> tuple[int, ...]:
    """The frames of a take that a text names, ascending.

    Args:
        text: numbers and ranges with commas between; both ends of a range belong to it, and of a range with a step
            only what lies whole steps from its first. Numbers of a range that the take lacks are passed over.
        frame_ids: of the take.
    Raises:
        InputError: the text is none of this, or names a frame, or a range of frames, that the take does not have.
    """
    known, chosen = sorted(frame_ids), set[int]()
    for part in text.split(","):
        first, last, step = _part(part)
        there = {each for each in known if first <= each <= last and (each - first) % step == 0}
        if not there:
            have = listed(known) if known else "none"
            raise InputError(f"--frames: expected frames that the take has ({have}), found '{part.strip()}'")
        chosen |= there
    return tuple(sorted(chosen))


def expanded(text: str) -> tuple[int, ...]:
    """The frames of a text that `listed` wrote, all of them.

    Raises:
        InputError: it did not.
    """
    parts = [_part(part) for part in text.split(",")] if text else []
    return tuple(sorted(each for first, last, step in parts for each in range(first, last + 1, step)))


def _part(part: str) -> tuple[int, int, int]:
    """First, last and step of a part."""
    found = _PART.fullmatch(part)
    if found is None:
        raise InputError(f"--frames: expected frames such as 1,5,10-20 or 1-200:5, found {part[:80]!a}")
    first, last, step = int(found[1]), int(found[2] or found[1]), int(found[3] or 1)
    if last < first or step < 1:
        raise InputError(f"--frames: expected a range upwards, its step at least 1, found '{part.strip()}'")
    return first, last, step


def listed(frame_ids: Iterable[int], most: int = 8) -> str:
    """Frames as `chosen_frames` reads them, as short as can be.

    Args:
        most: parts at most; dots stand for more of them. 0 for all.
    """
    parts = _runs(sorted(frame_ids))
    shown = parts if not most or len(parts) <= most else [*parts[: most - 1], "..."]
    return ",".join(shown)


def counted(frame_ids: Sequence[int], what: str) -> str:
    """What happened to how many, and which: `frame 12 added`, `5 frames added (201-205)`."""
    if len(frame_ids) == 1:
        return f"frame {frame_ids[0]} {what}"
    return f"{len(frame_ids)} frames {what} ({listed(frame_ids)})"


@lru_cache(maxsize=200_000)
def frame_file(folder: Path, frame_id: int, suffix: str = ".npz", within: str = "frames") -> Path:
    """A frame's file in a stage's folder: `<folder>/<within>/000123<suffix>`.

    Remembered, for stages ask for the files of a long take again and again, and pathlib takes its time.
    """
    return folder.joinpath(within, f"{frame_id:06d}{suffix}")


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


def _runs(frame_ids: Sequence[int]) -> list[str]:
    """Longest stretches of equal steps, those of two frames as single numbers."""
    parts, at = [], 0
    while at < len(frame_ids):
        end, step = at + 1, frame_ids[at + 1] - frame_ids[at] if at + 1 < len(frame_ids) else 1
        while end < len(frame_ids) and frame_ids[end] - frame_ids[end - 1] == step:
            end += 1
        if end - at < 3 and not (step == 1 and end - at == 2):
            end = at + 1
            parts.append(str(frame_ids[at]))
        else:
            parts.append(f"{frame_ids[at]}-{frame_ids[end - 1]}" + (f":{step}" if step > 1 else ""))
        at = end
    return parts
