"""One of two work folders, finished or not: what it is of, and the measures of its frames by their numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from capture4d.captures.capture import read_capture
from capture4d.captures.work_folder import WorkFolder, load_records
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, read_json_lines
from capture4d.files.json_values import entry, whole
from capture4d.files.reading import reading
from capture4d.runs.made import Ledger

__all__ = ["Side", "read_side", "short_names"]

Kind = Literal["registered", "animated", "not registered"]


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """A work folder as a diff sees it."""

    work: WorkFolder
    name: str
    """Short; tells the two folders apart."""
    take: str
    """Name of the capture; of an animated garment, of its folder."""
    kind: Kind
    finished: bool
    """Its frames are all there; else, those that are."""
    records: Mapping[int, Mapping[str, Any]]
    """Measures and verdict of each frame, tracking's (`track_...`) and those against the truth among them."""
    reported: Mapping[str, float | None]
    """Metrics over all frames as the report has them; empty where there is no report of this state."""
    scans: Mapping[int, str]
    """Digest of the scan of each frame, as extraction or tracking has read it."""

    def input_digest(self, stage: str, name: str) -> str | None:
        """Digest of what a stage was made from."""
        return self.work.stages.get(stage, {}).get("upstream", {}).get(name)

    @property
    def told(self) -> str:
        """The folder in a line."""
        count = f"{len(self.records)} frames"
        if self.kind == "not registered":
            done = ", ".join(str(record["stage"]) for record in self.work.stages.values())
            return f"{self.take}, not registered yet; has {done}"
        return f"{self.take}, {count} {self.kind}{'' if self.finished else ' so far, unfinished'}"


def read_side(work: WorkFolder, name: str) -> Side:
    """Read what a work folder says of itself and of its frames.

    Raises:
        InputError: it is no work folder, or one of its files is damaged.
    """
    if not work.stages:
        found = "no such folder" if not work.path.exists() else "none of its stages there"
        raise InputError(f"expected a work folder, found {found}", where=work.path)
    registration = work.stages.get("registration")
    kind: Kind = "not registered" if registration is None else "animated" if work.is_animated else "registered"
    finished = registration is not None and registration.get("status") == "complete"
    records = {number: dict(record) for number, record in _frames(work.path / "registration", finished).items()}
    reported: Mapping[str, float | None] = {}
    if finished and _report_is_current(work):
        reported = _reported(work.path / "report" / "metrics.json")
        _add(records, _measured_by_report(work.path / "report" / "frames.jsonl"))
    if kind != "animated":
        tracked = work.stages.get("body", {}).get("status") == "complete"
        found = {number: _tracked(record) for number, record in _frames(work.path / "body", tracked).items()}
        if kind == "not registered":
            records = found
        else:
            _add(records, found)
    scans = {**_scans(work.path / "body", "refined"), **_scans(work.path / "garment", "frames")}
    return Side(work, name, _take_name(work), kind, finished, records, reported, scans)


def short_names(first: Path, second: Path) -> tuple[str, str]:
    """The ends of two paths, as long as it takes to tell them apart."""
    one, other = first.resolve().parts, second.resolve().parts
    for count in range(1, max(len(one), len(other)) + 1):
        ends = "/".join(one[-count:]), "/".join(other[-count:])
        if ends[0] != ends[1]:
            return ends
    return f"{one[-1]} (1)", f"{other[-1]} (2)"


def _frames(folder: Path, finished: bool) -> dict[int, dict[str, Any]]:
    """The frames' records by number; of an unfinished stage, those of the frames that are done."""
    if finished:
        return _by_number(folder / "metrics.jsonl", load_records(folder))
    done = "refined" if (folder / "refined").is_dir() else "frames"
    paths = [path for path in sorted((folder / "metrics").glob("*.json")) if _is_done(folder / done, path)]
    return {number: found for path in paths for number, found in _by_number(path, [read_json(path)]).items()}


def _is_done(frames: Path, metrics: Path) -> bool:
    """A frame's measures are written first: it counts once its arrays are there."""
    return (frames / f"{metrics.stem}.npz").is_file()


def _by_number(path: Path, records: Sequence[dict[str, Any]]) -> dict[int, dict[str, Any]]:
    with reading(path, "file of measures"):
        return {whole(entry(record, "frame_id"), "frame_id"): record for record in records}


def _tracked(record: Mapping[str, Any]) -> dict[str, Any]:
    """A frame's record of tracking, under the names of the report."""
    median = record.get("median_m")
    return {
        "track_verdict": record.get("verdict"),
        "track_median_mm": None if median is None else 1e3 * median,
        "track_cpu_s": record.get("cpu_s"),
    }


def _add(records: dict[int, dict[str, Any]], more: Mapping[int, Mapping[str, Any]]) -> None:
    """Add measures to the records of their frames."""
    for number, found in more.items():
        if number in records:
            records[number].update(found)


def _report_is_current(work: WorkFolder) -> bool:
    report, registration = work.stages.get("report", {}), work.stages["registration"]
    made_from = report.get("upstream", {}).get("registration")
    return report.get("status") == "complete" and made_from == registration.get("digest")


def _reported(path: Path) -> dict[str, float | None]:
    found = read_json(path)
    with reading(path, "file of metrics"):
        return {entry(each, "key"): entry(each, "value") for each in entry(found, "metrics")}


def _measured_by_report(path: Path) -> dict[int, dict[str, Any]]:
    """What the report alone has measured; earlier versions kept no record of it."""
    return _by_number(path, read_json_lines(path)) if path.is_file() else {}


def _scans(folder: Path, files: str) -> dict[int, str]:
    """Digests of the scans that a stage's files were made from, by frame."""
    made = Ledger.read(folder).inputs_of(files)
    return {int(Path(place).stem): inputs["scan"] for place, inputs in made.items() if "scan" in inputs}


def _take_name(work: WorkFolder) -> str:
    if work.is_animated:
        return work.path.resolve().name
    try:
        return read_capture(work.capture_path).name
    except InputError:  # the capture may have moved: figures can be compared all the same
        path = work.path / "report" / "metrics.json"
        known = read_json(path).get("capture") if path.is_file() else None
        return known if isinstance(known, str) else work.path.resolve().name
