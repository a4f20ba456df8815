"""What has changed since a stage was run, in words, and what that costs.

A stage's folder answers for itself: what it would do again, and why, is found without doing anything, and the stage
says it before it begins. `capture4d.pipeline.changes` asks all stages of a take.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from capture4d.runs.frame_lists import counted

__all__ = [
    "StageChanges",
    "description_changes",
    "frame_changes",
    "input_changes",
    "say",
    "setting_changes",
]


@dataclass(frozen=True, slots=True)
class StageChanges:
    """A stage's folder against the take as it is now, and the settings it would be run with."""

    name: str
    """As in "register"."""
    folder: Path
    state: Literal["absent", "unfinished", "outdated", "current"]
    """Never run; stopped, so that the same command goes on; finished, but not from what is there now; finished."""
    settings: tuple[str, ...] = ()
    """Settings that differ, as in "relax 0.4 to 0.5". If there are any the stage refuses to go on without
    --overwrite, and then makes every frame anew."""
    inputs: tuple[str, ...] = ()
    """What else has changed, as in "5 frames added (21-25)", "border hem renamed to waist"."""
    frames: int = 0
    """Of the take."""
    pending: tuple[int, ...] = ()
    """Frames that are to be done, for certain."""
    following: tuple[int, ...] = ()
    """Frames that are done again if what they start from comes out otherwise than it was."""
    kept: tuple[str, ...] = ()
    """What was decided for the whole take and stays, as in "shape, found from frames 1-20"."""

    def after(self, earlier: Sequence[StageChanges]) -> StageChanges:
        """The same, of a stage that is made from others: what these do again may have to be done again here."""
        frames = set[int]()
        for each in earlier:
            frames |= {*each.pending, *each.following}
        following = tuple(sorted({*self.following, *frames} - {*self.pending}))
        state = "outdated" if self.state == "current" and following else self.state
        return replace(self, following=following, state=state)


def say(text: str) -> None:
    """Tell the user, beside what a command prints."""
    print(f"capture4d: {text}", file=sys.stderr, flush=True)


# --- in words ----------------------------------------------------------------------------------------------------


def setting_changes(now: Mapping[str, Any], before: Mapping[str, Any]) -> list[str]:
    """Settings that differ, by their own name, as in "relax 0.4 to 0.5"; with what they belong to where two are named
    alike."""
    found = list(_differences(now, before))
    names = [path[-1] for path, _, _ in found]
    return [
        f"{path[-1] if names.count(path[-1]) == 1 else '.'.join(path)} {_shown(old)} to {_shown(new)}"
        for path, old, new in found
    ]


def _differences(
    now: Mapping[str, Any], before: Mapping[str, Any], names: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    """Each value that differs: its names from the outside in, what it was, what it is."""
    for key in {**now, **before}:
        new, old = now.get(key), before.get(key)
        if isinstance(new, Mapping) and isinstance(old, Mapping):
            yield from _differences(new, old, (*names, key))
        elif new != old:
            yield (*names, key), old, new


def description_changes(now: Mapping[str, Any], before: Mapping[str, Any]) -> list[str]:
    """What differs in what a stage read of capture.json."""
    words = []
    for key in now:
        if key not in before or now[key] == before[key]:
            continue
        new, old = now[key], before[key]
        if key == "boundary_colours" and isinstance(new, Mapping) and isinstance(old, Mapping):
            words += _border_changes(new, old)
        else:
            words.append(f"{key.replace('_', ' ')} {_shown(old)} to {_shown(new)}")
    return words


def _border_changes(now: Mapping[str, str], before: Mapping[str, str]) -> Iterator[str]:
    gone = [name for name in before if name not in now]
    new = [name for name in now if name not in before]
    for name in list(gone):
        same = next((each for each in new if now[each] == before[name]), None)
        if same is not None:
            yield f"border {name} renamed to {same}"
            gone.remove(name)
            new.remove(same)
    for name in gone:
        yield f"border {name} removed"
    for name in new:
        yield f"border {name} added"
    for name in now:
        if name in before and now[name] != before[name]:
            yield f"colour of border {name} {before[name]} to {now[name]}"


def input_changes(now: Mapping[str, str], before: Mapping[str, str]) -> list[str]:
    """Inputs that a whole stage has, by digest: which are others than before."""
    words = [f"{name} changed" for name in now if name in before and now[name] != before[name]]
    words += [f"{name} added" for name in now if name not in before]
    return words + [f"{name} removed" for name in before if name not in now]


def frame_changes(now: Sequence[int], before: Sequence[int]) -> list[str]:
    """Frames that came and went."""
    added, removed = sorted(set(now) - set(before)), sorted(set(before) - set(now))
    words = [counted(added, "added")] if added else []
    return words + ([counted(removed, "removed")] if removed else [])


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 40 else f"{text[:36]}..."
