"""A work folder from outside: what is done, what is running, stale or damaged, which frames are flagged, what it cost.

Everything is read while another command may be writing: files are whole or absent, and what vanishes meanwhile does
not count.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from capture4d.app.status.staleness import linked, made_from, report_changes, take_changes
from capture4d.captures.capture import read_capture
from capture4d.captures.work_folder import ANIMATE, REGISTER, load_records
from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.runs.changes import StageChanges
from capture4d.runs.frame_lists import counted
from capture4d.runs.growing import frames_of
from capture4d.runs.locks import Holder, holders
from capture4d.runs.made import Ledger
from capture4d.runs.stage import read_record

__all__ = ["StageStatus", "WorkStatus", "as_json", "logged_costs", "survey"]

State = Literal["done", "running", "stopped", "stale", "damaged"]
CHAIN = {"garment": "extract", "body": "track", "registration": "register", "report": "report"}
"""Folders of the stages of `run`, in their order; others come after them."""
BESIDE = ("retarget", "compare", "wrinkles/pairs", "wrinkles/generated", "wrinkles/offsets", "texture")
"""Folders of what is made from these."""
GRADED = ("track", REGISTER, ANIMATE)
"""Stages that give each frame a verdict."""
FRAMES = {"garment": "frames", "body": "refined"}
"""Folder of the files that say how far a stage is, where it is not "frames"."""
LOG = "log.jsonl"
"""Of the commands that wrote to the folder; may be absent."""


@dataclass(frozen=True, slots=True)
class StageStatus:
    """A stage's folder."""

    name: str
    """As in "register"."""
    folder: str
    """In the work folder."""
    state: State
    """Done; running now; stopped, so that the same command goes on; done, but not from what is there now; damaged."""
    why: tuple[str, ...] = ()
    """What has changed, is missing, or is damaged, in words."""
    done: int | None = None
    """Frames that are done; None where a stage does not go by frames."""
    frames: int | None = None
    """Of the take, where that is known."""
    flagged: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """Frames that are not good, by verdict."""
    started: str = ""
    finished: str = ""
    """ISO 8601, UTC; empty where it is not known."""
    wall_s: float | None = None
    """All runs together where the folder's log tells them, else from the first start to the end."""
    cpu_s: float | None = None
    bytes: int = 0
    """On the disk."""


@dataclass(frozen=True, slots=True)
class WorkStatus:
    """A work folder."""

    path: Path
    take: str
    """Name of the capture; of an animation, of its folder."""
    capture: Path | None
    """Where the capture lies; None where there is none, or it is not where it was."""
    stages: tuple[StageStatus, ...]
    running: tuple[Holder, ...]
    """Commands that are writing to it now."""
    notes: tuple[str, ...]
    """What keeps the survey from being complete."""

    @property
    def is_damaged(self) -> bool:
        return any(stage.state == "damaged" for stage in self.stages)


def survey(path: Path) -> WorkStatus:
    """Look through a work folder; nothing in it is changed.

    Raises:
        InputError: it is none.
    """
    if not path.is_dir():
        raise InputError(f"expected a work folder, found {'a file' if path.exists() else 'no such folder'}", where=path)
    running = tuple(holders(path))
    records, damaged = _records(path)
    if not any(folder in (*CHAIN, *BESIDE) for folder in (*records, *damaged)):
        if running:
            raise InputError(f"'{running[0].command or 'another command'}' is just beginning there", where=path)
        raise InputError(f"expected a work folder, found {_what_is_there(path)}", where=path)
    place, take, changes, notes = _take(path, records)
    costs = logged_costs(path)
    stages: dict[str, StageStatus] = {}
    for folder in sorted(records, key=lambda folder: ([*CHAIN].index(folder) if folder in CHAIN else 9, folder)):
        is_held = any((path / folder).is_relative_to(holder.place.parent) for holder in running)
        found = _stage(path, folder, records, changes.get(folder), costs, is_held=is_held)
        before = [stages[each] for each in made_from(records[folder], path) if each in stages]
        words = tuple(f"{each.folder} is {each.state}" for each in before if each.state in ("stale", "damaged"))
        if words and found.state == "done":
            found = replace(found, state="stale", why=(*found.why, *words))
        stages[folder] = found
    broken = [
        StageStatus(CHAIN.get(folder, folder), folder, "damaged", (said,), bytes=_bytes(path / folder))
        for folder, said in damaged.items()
    ]
    return WorkStatus(path, take, place, (*broken, *stages.values()), running, tuple(notes))


def _what_is_there(path: Path) -> str:
    if (path / "capture.json").is_file():
        return "a capture folder"
    if (path / "stage.json").is_file():
        return f"the folder of one stage; its work folder is {path.resolve().parent}"
    return "none of its stages there"


# --- stages ------------------------------------------------------------------------------------------------------


def _records(work: Path) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """The stage.json of each folder that has one, and what is wrong with those that cannot be read."""
    records, damaged = {}, {}
    for path in sorted((*work.glob("*/stage.json"), *work.glob("wrinkles/*/stage.json"))):
        folder = path.parent.relative_to(work).as_posix()
        try:
            records[folder] = read_record(path)
        except InputError as error:
            damaged[folder] = error.reason
    return records, damaged


def _take(
    work: Path, records: Mapping[str, Mapping[str, Any]]
) -> tuple[Path | None, str, dict[str, StageChanges | list[str]], list[str]]:
    """Where the capture lies, what the take is called, what has changed since its stages were run, and what cannot be
    told."""
    if records.get("registration", {}).get("stage", REGISTER) != REGISTER or not {*records} & {"garment", "body"}:
        return None, work.resolve().name, {}, []
    recorded = (records.get(folder, {}).get("sources", {}).get("capture") for folder in ("garment", "body"))
    places = [Path(place) for place in recorded if place is not None]
    for place in (*places, work / "capture"):
        if (place / "capture.json").is_file():
            break
    else:
        where = places[0] if places else work / "capture"
        return (
            None,
            work.resolve().name,
            {},
            [f"The capture is not at {where}: whether its scans have changed nobody knows."],
        )
    try:
        capture = read_capture(place)
    except InputError as error:
        return place, work.resolve().name, {}, [f"The capture cannot be read: {error}"]
    done = [folder for folder in ("garment", "body", "registration") if folder in records]
    changes: dict[str, StageChanges | list[str]] = dict(zip(done, take_changes(capture, work, records), strict=True))
    if "report" in records:
        changes["report"] = report_changes(work, capture, records)
    return place, capture.name, changes, []


def _stage(
    work: Path,
    folder: str,
    records: Mapping[str, Mapping[str, Any]],
    changes: StageChanges | list[str] | None,
    costs: Mapping[str, tuple[float, float]],
    *,
    is_held: bool,
) -> StageStatus:
    record, place = records[folder], work / folder
    name, complete = str(record["stage"]), record.get("status") == "complete"
    state: State = "done" if complete else "running" if is_held else "stopped"
    why: tuple[str, ...] = ()
    try:
        measures = _measures(place, name, complete)
        flagged = {**_without_garment(place, name), **_flagged(measures)}
    except InputError as error:
        state, why, measures, flagged = "damaged", (str(error),), [], {}
    if isinstance(changes, list):
        why, state = (*why, *changes), "stale" if changes and name == "report" and state == "done" else state
    elif changes is not None:
        why = (*why, *_words(changes))
        state = "stale" if state == "done" and changes.state == "outdated" else state
    elif complete and (apart := linked(record, records, work)):
        state, why = ("stale" if state == "done" else state), (*why, *apart)
    done, frames = _counts(place, FRAMES.get(folder, "frames"), record, changes)
    wall_s, cpu_s = costs.get(name, (_wall(record), _cpu(measures)))
    return StageStatus(
        name, folder, state, why, done, frames, flagged,
        str(record.get("started", "")), str(record.get("finished", "")), wall_s, cpu_s, _bytes(place),
    )  # fmt: skip


def _words(changes: StageChanges) -> Iterator[str]:
    """What has changed, and what that costs."""
    if changes.settings:  # a stage is asked with its own: only the format of its output can be another
        yield f"made by another version of capture4d ({', '.join(changes.settings[:3])})"
    else:
        yield from changes.inputs
    if changes.state != "current" and changes.pending:
        yield counted(changes.pending, "to do")
    if changes.state != "current" and changes.following:
        yield counted(changes.following, "to do if what they start from comes out otherwise")


def _counts(
    place: Path, files: str, record: Mapping[str, Any], changes: StageChanges | list[str] | None
) -> tuple[int | None, int | None]:
    """Frames that are done, and those of the take."""
    done = _count(place / files)
    if done is None:
        return None, None
    made_for = frames_of(record)
    of_the_take = changes.frames if isinstance(changes, StageChanges) else None if made_for is None else len(made_for)
    complete = record.get("status") == "complete"
    return done, of_the_take if of_the_take is not None else done if complete else None


def _count(folder: Path) -> int | None:
    try:
        with os.scandir(folder) as entries:
            return sum(entry.name.endswith((".npz", ".png")) and not entry.name.startswith(".") for entry in entries)
    except OSError:
        return None


# --- measures ----------------------------------------------------------------------------------------------------


def _measures(place: Path, name: str, complete: bool) -> list[dict[str, Any]]:
    """The frames' records, of a stage that keeps some."""
    if name not in GRADED:
        return []
    if complete:
        return load_records(place)
    found = []
    for path in sorted((place / "metrics").glob("*.json")):
        with contextlib.suppress(FileNotFoundError):
            found.append(read_json(path))
    return found


def _flagged(measures: Sequence[Mapping[str, Any]]) -> dict[str, tuple[int, ...]]:
    flagged: dict[str, list[int]] = {}
    for record in measures:
        verdict, number = record.get("verdict"), record.get("frame_id")
        if isinstance(verdict, str) and isinstance(number, int) and verdict != "good":
            flagged.setdefault(verdict, []).append(number)
    return {verdict: tuple(sorted(numbers)) for verdict, numbers in sorted(flagged.items())}


def _without_garment(place: Path, name: str) -> dict[str, tuple[int, ...]]:
    if name != "extract":
        return {}
    said = Ledger.read(place).said_of("frames")
    numbers = sorted(int(Path(file).stem) for file, each in said.items() if each.get("reason"))
    return {"no garment": tuple(numbers)} if numbers else {}


def _cpu(measures: Sequence[Mapping[str, Any]]) -> float | None:
    times = [record["cpu_s"] for record in measures if isinstance(record.get("cpu_s"), int | float)]
    return sum(times) if times else None


def _wall(record: Mapping[str, Any]) -> float | None:
    """From the first start to the end, or until now."""
    try:
        begun = datetime.fromisoformat(record["started"])
        ended = datetime.fromisoformat(record["finished"]) if "finished" in record else datetime.now(UTC)
        return max(0.0, (ended - begun).total_seconds())
    except (KeyError, TypeError, ValueError):
        return None


def logged_costs(work: Path) -> dict[str, tuple[float, float]]:
    """Wall and CPU seconds of each stage, all its runs together, as the folder's log tells them."""
    costs: dict[str, tuple[float, float]] = {}
    with contextlib.suppress(OSError), (work / LOG).open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            try:
                said = json.loads(line)
                if said["event"] == "stage ends":
                    wall, cpu = costs.get(said["stage"], (0.0, 0.0))
                    costs[said["stage"]] = (wall + float(said["wall_s"]), cpu + float(said["cpu_s"]))
            except (ValueError, KeyError, TypeError):  # a line that a kill cut off
                continue
    return costs


def _bytes(folder: Path) -> int:
    """What the files of a folder take, without following links."""
    total, folders = 0, [os.fspath(folder)]
    while folders:
        with contextlib.suppress(OSError), os.scandir(folders.pop()) as entries:
            for entry in entries:
                with contextlib.suppress(OSError):
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(entry.path)
                    else:
                        total += entry.stat(follow_symlinks=False).st_size
    return total


# --- for machines ------------------------------------------------------------------------------------------------


def as_json(found: WorkStatus) -> dict[str, Any]:
    """The status for machines; docs/how-to/runs.md describes it."""
    return {
        "format": 1,
        "work": str(found.path),
        "take": found.take,
        "capture": None if found.capture is None else str(found.capture),
        "running": [
            {"command": each.command, "process": each.process, "machine": each.machine, "since": each.since}
            for each in found.running
        ],
        "stages": [
            {
                "stage": each.name,
                "folder": each.folder,
                "state": each.state,
                "why": list(each.why),
                "done": each.done,
                "frames": each.frames,
                "flagged": {verdict: list(numbers) for verdict, numbers in each.flagged.items()},
                "started": each.started or None,
                "finished": each.finished or None,
                "wall_s": each.wall_s,
                "cpu_s": each.cpu_s,
                "bytes": each.bytes,
            }
            for each in found.stages
        ],
        "notes": list(found.notes),
    }
