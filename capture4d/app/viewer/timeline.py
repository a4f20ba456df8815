"""The frames of a folder and what is said of each, as far as they are done; looked up anew while commands write."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from capture4d.app.report.metrics import METRICS
from capture4d.captures.work_folder import load_records
from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.runs.frame_lists import frame_file

__all__ = ["OPEN", "Registered", "Timeline", "curve", "curve_names", "flagged"]

OPEN = "not registered"
"""Verdict of a frame that nothing is registered of."""


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """Frames, ascending, and what is known of them."""

    frame_ids: tuple[int, ...]
    records: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)
    """What was measured of a registered frame; empty of one that nobody measured."""

    def verdict(self, frame_id: int) -> str:
        """good, check, failed; OPEN, or empty where nobody judged."""
        record = self.records.get(frame_id)
        return OPEN if record is None else str(record.get("verdict", ""))

    def said(self, frame_id: int) -> str:
        """Frame, verdict and reasons in a line."""
        reasons = self.records.get(frame_id, {}).get("reasons") or ()
        words = "; ".join(filter(None, [self.verdict(frame_id), *map(str, reasons)]))
        return f"{frame_id}: {words}" if words else str(frame_id)


class Registered:
    """The frames of WORK/registration; what was read of a frame is read again only if its file is another one."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._states: dict[int, int] = {}
        self._records: dict[int, Mapping[str, Any]] = {}

    @property
    def states(self) -> Mapping[int, int]:
        """When each frame's file was written, ns since 1970: another number, another file."""
        return self._states

    @property
    def records(self) -> Mapping[int, Mapping[str, Any]]:
        return self._records

    def look(self) -> bool:
        """Whether anything has changed since the last look."""
        states = _files(self._folder / "frames", ".npz")
        if states == self._states:
            return False
        changed = [each for each, state in states.items() if self._states.get(each) != state]
        records = {each: self._records[each] for each in states if each in self._records}
        together = {}
        if len(changed) > 1:
            with contextlib.suppress(InputError, KeyError, OSError):
                together = {int(each["frame_id"]): each for each in load_records(self._folder)}
        for frame_id in changed:
            records[frame_id] = together.get(frame_id) or self._own(frame_id)
        self._states, self._records = states, dict(sorted(records.items()))
        return True

    def _own(self, frame_id: int) -> Mapping[str, Any]:
        path = frame_file(self._folder, frame_id, ".json", "metrics")
        with contextlib.suppress(InputError, OSError):
            if path.is_file():
                return read_json(path)
        return {}


def _files(folder: Path, suffix: str) -> dict[int, int]:
    """Frames that have a file, and when it was written."""
    found = {}
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            stem, dot, ending = entry.name.rpartition(".")
            if stem.isdecimal() and dot + ending == suffix:
                with contextlib.suppress(OSError):
                    found[int(stem)] = entry.stat().st_mtime_ns
    return dict(sorted(found.items()))


def flagged(timeline: Timeline, verdicts: Sequence[str]) -> list[int]:
    """Frames with one of these verdicts."""
    return [each for each in timeline.frame_ids if timeline.verdict(each) in verdicts]


def curve_names(timeline: Timeline) -> list[str]:
    """Measures that at least one frame has as a number, those that the report explains first."""
    known: dict[str, None] = {}
    for record in timeline.records.values():
        for key, value in record.items():
            if key != "frame_id" and isinstance(value, int | float) and not isinstance(value, bool):
                known.setdefault(key)
    return sorted(known, key=lambda key: ([*METRICS].index(key) if key in METRICS else len(METRICS), key))


def curve(timeline: Timeline, name: str) -> Float64[np.ndarray, " frames"]:
    """A measure over all frames; NaN where it is not known."""
    found = (timeline.records.get(each, {}).get(name) for each in timeline.frame_ids)
    return np.array([np.nan if value is None else float(value) for value in found], np.float64)
