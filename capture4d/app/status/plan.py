"""What stages would do if they were run now: which frames, why, about how long, and on how much disk.

Times are CPU seconds a frame of earlier frames in the same work folder, where there are some; else a guess, which is
said. Nothing is done, nor written.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from capture4d.app.status.staleness import report_changes
from capture4d.app.status.survey import logged_costs
from capture4d.captures.capture import Capture, scan_path
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, read_json_lines
from capture4d.runs.changes import StageChanges
from capture4d.runs.decisions import DECISIONS
from capture4d.runs.frame_lists import counted
from capture4d.runs.stage import read_record

__all__ = ["Plan", "StagePlan", "plan_stages", "renewed"]

FOLDERS = {"extract": "garment", "track": "body", "register": "registration", "report": "report"}
GUESSED_S = {"extract": 0.5, "track": 0.6, "register": 0.5}
"""CPU seconds a frame where none was done: of scans of 200,000 vertices (docs/methods), whose machine was another."""
BEGINNING_S = {"track": 15.0}
"""CPU seconds of what is done once: the first frame's search for the pose."""
REPORT_S = 40.0
"""CPU seconds of a report, whose pictures are as many for every take."""
SEGMENTS = {"track": 240, "register": 120}
"""Frames that are done one after the other; other segments of the take may be done beside them."""
GARMENT_SHARE = 0.7
"""Bytes of an extracted garment over those of its scan, of the demo."""
BODY_BYTES, VERTEX_BYTES, RECORD_BYTES = 120_000, 40, 1_500
"""A frame of tracking; a template vertex in a registered frame, and in vertices.npy; what is said of a frame."""
REPORT_BYTES = 3_000_000
_SAMPLE = 50
"""Files whose mean stands for all."""


@dataclass(frozen=True, slots=True)
class StagePlan:
    """What one stage would do."""

    name: str
    state: Literal["do", "go on", "renew", "nothing", "refuse"]
    """Begin; go on where it was stopped; redo what has changed, or all of it; nothing; refuse, for want of
    --overwrite or of what it is made from."""
    why: tuple[str, ...]
    frames: int
    """Of the take; 0 where the stage does not go by frames."""
    to_do: int
    perhaps: int
    """Frames more, if what they start from comes out otherwise than it was."""
    frame_s: float
    """CPU seconds a frame; of a stage that does not go by frames, of all of it."""
    is_guess: bool
    """Nothing was done yet from which that is known."""
    cpu_s: float
    """CPU seconds of the frames to do; `cpu_most_s`, with those that may have to be done."""
    cpu_most_s: float
    side_by_side: int
    """Processes that it can use."""
    bytes: int
    """That it would take on the disk, beyond what it takes now."""

    @property
    def kept(self) -> int:
        return self.frames - self.to_do - self.perhaps


@dataclass(frozen=True, slots=True)
class Plan:
    """What a command would do."""

    work: Path
    stages: tuple[StagePlan, ...]
    workers: int
    free_bytes: int
    """On the disk of the work folder."""

    @property
    def refuses(self) -> bool:
        return any(stage.state == "refuse" for stage in self.stages)

    @property
    def wall_s(self) -> tuple[float, float]:
        """From when only what is certain is done to when all is that may be."""
        least, most = (
            [getattr(stage, key) / max(1, min(self.workers, stage.side_by_side)) for stage in self.stages]
            for key in ("cpu_s", "cpu_most_s")
        )
        return sum(least), sum(most)

    @property
    def bytes(self) -> int:
        return sum(stage.bytes for stage in self.stages)


def plan_stages(
    capture: Capture,
    work: Path,
    found: Sequence[StageChanges],
    *,
    anew: Collection[str] = (),
    report: bool = False,
    workers: int = 1,
) -> Plan:
    """The plan of stages in a row.

    Args:
        found: what each would do, as it says itself.
        anew: names of those that begin clean, as --overwrite has it.
        report: a report comes after them.
    """
    costs = logged_costs(work)
    stages: list[StagePlan] = []
    refused = False
    for changes in found:
        each = _planned(capture, work, changes, costs, is_anew=changes.name in anew, after=stages)
        missing = _missing(work, changes) if len(found) == 1 else None  # alone, it has to find what it is made from
        if missing is not None:
            each = _refusing(each, missing)
        if refused:
            each = _refusing(each, "a stage before it refuses")
        refused = refused or each.state == "refuse"
        stages.append(each)
    if report:
        stages.append(_planned_report(capture, work, stages, costs, refused))
    return Plan(work, tuple(stages), workers, _free(work))


def renewed(found: Sequence[StageChanges], capture: Capture, work: Path, what: Collection[str]) -> list[StageChanges]:
    """What stages would do if decisions of the whole take were found anew; what comes of it may be as it was.

    Raises:
        InputError: one is no such decision.
    """
    unknown = next((name for name in what if name not in DECISIONS), None)
    if unknown is not None:
        raise InputError(f"--renew: expected {' or '.join(DECISIONS)}, found {unknown[:80]!a}")
    places = {name: [work / place for place in DECISIONS[name] if (work / place).is_file()] for name in what}
    stages: list[StageChanges] = []
    for each in found:
        folder = work / FOLDERS[each.name]
        words = [f"{name} found anew" for name in what if any(path.parent == folder for path in places[name])]
        if words:
            following = tuple(sorted({*capture.frame_ids} - {*each.pending}))
            each = replace(each, inputs=(*each.inputs, *words), following=following, kept=(), state="outdated")
        stages.append(each.after(stages) if each.name == "register" else each)
    return stages


# --- stages ------------------------------------------------------------------------------------------------------


def _planned(
    capture: Capture,
    work: Path,
    changes: StageChanges,
    costs: Mapping[str, tuple[float, float]],
    *,
    is_anew: bool,
    after: Sequence[StagePlan],
) -> StagePlan:
    folder = work / FOLDERS[changes.name]
    to_do, perhaps = (changes.frames, 0) if is_anew else (len(changes.pending), len(changes.following))
    frame_s, is_guess = _frame_s(folder, changes.name, costs)
    begins = to_do == changes.frames
    once = BEGINNING_S.get(changes.name, 0.0) if begins else 0.0
    length = SEGMENTS.get(changes.name)
    side_by_side = changes.frames if length is None else max(1, (to_do + perhaps + length // 2) // length)
    there = min(changes.frames, _count(folder / "frames"))
    state: Literal["do", "go on", "renew", "nothing", "refuse"]
    if changes.settings and not is_anew:
        state = "refuse"
    elif changes.state == "absent":
        state = "do"
    elif is_anew or changes.state == "outdated":
        state = "renew"
    elif changes.state == "unfinished":
        state = "go on"
    else:
        state = "renew" if any(each.to_do or each.perhaps for each in after) and perhaps else "nothing"
    planned = StagePlan(
        changes.name,
        state,
        tuple(_why(changes, is_anew)),
        changes.frames,
        to_do,
        perhaps,
        frame_s,
        is_guess,
        once + frame_s * to_do if to_do else 0.0,
        once + frame_s * (to_do + perhaps) if to_do or perhaps else 0.0,
        side_by_side,
        _more_bytes(capture, folder, changes.name, changes.frames - there),
    )
    return _refusing(planned) if state == "refuse" else planned


def _refusing(plan: StagePlan, *why: str) -> StagePlan:
    return replace(plan, state="refuse", why=(*plan.why, *why), cpu_s=0.0, cpu_most_s=0.0, bytes=0)


def _why(changes: StageChanges, is_anew: bool) -> Iterator[str]:
    if changes.state == "absent":
        yield "never run"
    if changes.settings:
        named = [words for words in changes.settings if not words.startswith("schema ")]  # the format, once more
        words = f"other settings ({', '.join(named)})"
        yield f"begins anew: {words}" if is_anew else f"{words}: needs --overwrite"
    elif is_anew and changes.state != "absent":
        yield "begins anew, as --overwrite says"
    yield from changes.inputs
    if changes.state == "unfinished":
        yield "was stopped"
    if changes.pending and not is_anew and len(changes.pending) < changes.frames:
        yield counted(changes.pending, "to do")
    if changes.following and not is_anew:
        yield counted(changes.following, "to do if what they start from comes out otherwise")
    if not is_anew:
        yield from (f"keeps the {each}" for each in changes.kept)


def _missing(work: Path, changes: StageChanges) -> str | None:
    """What a stage that is run alone does not find."""
    if changes.name != "register":
        return None
    path = work / "garment" / "stage.json"
    if not path.is_file():
        return "the scans' garments are missing: run extract first"
    return None if read_record(path).get("status") == "complete" else "extract is not finished: run it first"


def _planned_report(
    capture: Capture, work: Path, before: Sequence[StagePlan], costs: Mapping[str, tuple[float, float]], refused: bool
) -> StagePlan:
    done = [stage for stage in before if stage.to_do or stage.perhaps]
    why = (
        "a stage before it refuses"
        if refused
        else "what it shows is done again"
        if done
        else _stale_report(capture, work)
    )
    state: Literal["do", "nothing", "refuse"] = "refuse" if refused else "do" if why else "nothing"
    cpu_s = costs["report"][1] if costs.get("report", (0.0, 0.0))[1] else REPORT_S
    spent = cpu_s if state == "do" else 0.0
    there = (work / "report" / "index.html").is_file()
    least = spent if not done or any(stage.to_do for stage in done) else 0.0
    needs = 0 if there or state != "do" else REPORT_BYTES
    return StagePlan(
        "report", state, (why,) if why else (), 0, 0, 0, cpu_s, "report" not in costs, least, spent, 8, needs
    )


def _stale_report(capture: Capture, work: Path) -> str:
    """Why a report has to be drawn; empty if it has not."""
    paths = {folder: work / folder / "stage.json" for folder in ("report", "registration")}
    records = {folder: read_record(path) for folder, path in paths.items() if path.is_file()}
    if records.get("report", {}).get("status") != "complete":
        return "never drawn" if "report" not in records else "was stopped"
    return ", ".join(report_changes(work, capture, records))


# --- costs -------------------------------------------------------------------------------------------------------


def _frame_s(folder: Path, name: str, costs: Mapping[str, tuple[float, float]]) -> tuple[float, bool]:
    """CPU seconds of a frame, and whether they are a guess."""
    times = [record["cpu_s"] for record in _records(folder) if isinstance(record.get("cpu_s"), int | float)]
    if times:
        return float(np.mean(times)), False
    frames = _count(folder / "frames")
    if name in costs and costs[name][1] > 0 and frames:
        return costs[name][1] / frames, False
    return GUESSED_S[name], True


def _records(folder: Path) -> list[dict[str, Any]]:
    """Measures of earlier frames, some of them."""
    try:
        if (folder / "metrics.jsonl").is_file():
            return read_json_lines(folder / "metrics.jsonl")
        return [read_json(path) for path in sorted((folder / "metrics").glob("*.json"))[:_SAMPLE]]
    except InputError:  # what is damaged is made anew
        return []


def _more_bytes(capture: Capture, folder: Path, name: str, frames: int) -> int:
    """What so many frames more take."""
    if not frames:
        return 0
    known = sum(_mean_size(folder / part) for part in ("frames", "refined", "metrics", "times"))
    if known:
        return round(frames * known)
    if name == "extract":
        return round(frames * GARMENT_SHARE * _mean_scan_size(capture))
    if name == "track":
        return frames * (BODY_BYTES + RECORD_BYTES)
    with contextlib.suppress(InputError):
        vertices = len(capture.template.template.vertices)
        return frames * (VERTEX_BYTES * vertices + RECORD_BYTES)
    return 0


def _mean_size(folder: Path) -> float:
    """Of the files of a folder, some of them."""
    try:
        with os.scandir(folder) as entries:
            sizes = [entry.stat().st_size for entry, _ in zip(entries, range(_SAMPLE), strict=False)]
    except OSError:
        return 0.0
    return float(np.mean(sizes)) if sizes else 0.0


def _mean_scan_size(capture: Capture) -> float:
    chosen = capture.frame_ids[:: max(1, len(capture.frame_ids) // _SAMPLE)]
    sizes = []
    for frame_id in chosen:
        with contextlib.suppress(InputError, OSError):
            sizes.append(scan_path(capture, frame_id).stat().st_size)
    return float(np.mean(sizes)) if sizes else 0.0


def _count(folder: Path) -> int:
    try:
        with os.scandir(folder) as entries:
            return sum(entry.name.endswith(".npz") for entry in entries)
    except OSError:
        return 0


def _free(work: Path) -> int:
    place = work.resolve()
    while not place.exists():
        place = place.parent
    return shutil.disk_usage(place).free
