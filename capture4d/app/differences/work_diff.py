"""Two work folders side by side: what they were made with and from, how good they are, and which frames differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from capture4d.app.differences.changes import MetricChange, SettingChange, metric_changes, setting_changes
from capture4d.app.differences.sides import Side, read_side, short_names
from capture4d.app.report.limits import parse_numbers, unknown_metric
from capture4d.captures.work_folder import WorkFolder
from capture4d.errors import InputError
from capture4d.runs.frame_lists import counted

__all__ = ["VerdictChange", "WorkDiff", "as_json", "broken_limits", "diff_works", "parse_worse_limits"]

FAIL_IF_WORSE = "--fail-if-worse"
_AT_ONCE = 64
"""Frames whose vertices are held at once."""


@dataclass(frozen=True, slots=True)
class VerdictChange:
    """Frames whose verdict went from one word to another."""

    before: str
    after: str
    frames: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class WorkDiff:
    """What differs between two work folders; the second is what the first has become."""

    before: Side
    after: Side
    takes: str
    """Whether they are of one take, in a sentence."""
    same_take: bool
    """As far as can be told; else frames of one number are not the same moment."""
    notes: tuple[str, ...]
    """What has to be known to read the figures."""
    settings: tuple[SettingChange, ...]
    metrics: tuple[MetricChange, ...]
    verdicts: tuple[VerdictChange, ...]
    frame_ids: tuple[int, ...]
    """Frames that both have."""
    apart_mm: Float64[np.ndarray, " frames"] | None
    """Distance from vertex to vertex, mean of each of these frames; None where the surfaces are not of one template."""

    @property
    def tally(self) -> str:
        """How many metrics are better and worse, in a sentence; empty where none can be compared."""
        told = [metric.verdict for metric in self.metrics]
        counts = {verdict: told.count(verdict) for verdict in ("better", "worse", "same")}
        if not any(counts.values()):
            return ""
        parts = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
        return f"Of {sum(counts.values())} metrics: {parts}."

    @property
    def only_before(self) -> tuple[int, ...]:
        return tuple(sorted(set(self.before.records) - set(self.after.records)))

    @property
    def only_after(self) -> tuple[int, ...]:
        return tuple(sorted(set(self.after.records) - set(self.before.records)))


def diff_works(first: WorkFolder, second: WorkFolder) -> WorkDiff:
    """Compare two work folders, finished or not, of scans or animated; frames are matched by number.

    Raises:
        InputError: one is no work folder, or a file of it is damaged.
    """
    names = short_names(first.path, second.path)
    before, after = read_side(first, names[0]), read_side(second, names[1])
    frame_ids = tuple(sorted(set(before.records) & set(after.records)))
    same_take, takes = _takes(before, after)
    return WorkDiff(
        before,
        after,
        takes,
        same_take,
        tuple(_notes(before, after, frame_ids)),
        tuple(setting_changes(before, after)),
        tuple(metric_changes(before, after)),
        tuple(_verdict_changes(before, after, frame_ids)),
        frame_ids,
        _apart_mm(before, after, frame_ids),
    )


def _takes(before: Side, after: Side) -> tuple[bool, str]:
    """Scans that both have read decide; of folders of earlier versions, what they say they were made from."""
    if "animated" in (before.kind, after.kind):
        return _motions(before, after)
    both = sorted(set(before.scans) & set(after.scans))
    other = [number for number in both if before.scans[number] != after.scans[number]]
    digests = [side.input_digest("garment", "capture") for side in (before, after)]
    if (both and not other) or (digests[0] is not None and digests[0] == digests[1]):
        return True, f"One take, {after.take}."
    if len(other) < len(both):
        return True, f"One take, {after.take}; {counted(other, 'replaced')}."
    if before.take != after.take:
        return False, f"Different takes, {before.take} and {after.take}: frames of one number are not one moment."
    if not both:
        return True, f"One take by its name, {after.take}; no scan was read in both."
    return False, f"Two takes of one name, {after.take}: no scan of one is a scan of the other."


def _motions(before: Side, after: Side) -> tuple[bool, str]:
    if before.kind != after.kind:
        return False, f"{before.name} is {before.kind}, {after.name} is {after.kind}: little can be compared."
    if before.input_digest("registration", "poses") != after.input_digest("registration", "poses"):
        return False, "Different motions: frames of one number are not one moment."
    models = [side.input_digest("registration", "model") for side in (before, after)]
    return True, f"One motion, {'one learned garment' if models[0] == models[1] else 'two learned garments'}."


def _notes(before: Side, after: Side, frame_ids: Sequence[int]) -> list[str]:
    notes = []
    digests = [side.work.stages.get("registration", {}).get("digest") for side in (before, after)]
    if digests[0] is not None and digests[0] == digests[1]:
        notes.append("The registered frames are the same, bit for bit.")
    counts = len(before.records), len(after.records)
    if counts != (len(frame_ids), len(frame_ids)):
        both = f"{len(frame_ids)} frames are in both" if frame_ids else "No frame is in both"
        basis = "means are over these" if frame_ids else "means are over all of each"
        notes.append(f"{both}, of {counts[0]} in {before.name} and {counts[1]} in {after.name}; {basis}.")
    silent = [side for side in (before, after) if side.kind == "registered" and side.finished and not side.reported]
    said = "has no report of its present state: nothing in it is measured against a truth."
    return notes + [f"{side.name} {said}" for side in silent]


def _verdict_changes(before: Side, after: Side, frame_ids: Sequence[int]) -> list[VerdictChange]:
    moved: dict[tuple[str, str], list[int]] = {}
    for number in frame_ids:
        verdicts = tuple(str(side.records[number].get("verdict")) for side in (before, after))
        if verdicts[0] != verdicts[1]:
            moved.setdefault((verdicts[0], verdicts[1]), []).append(number)
    return [VerdictChange(*verdicts, tuple(numbers)) for verdicts, numbers in sorted(moved.items())]


def _apart_mm(before: Side, after: Side, frame_ids: Sequence[int]) -> np.ndarray | None:
    """How far the surfaces of the frames lie apart; None unless both are finished and of the same faces."""
    if not (before.finished and after.finished and frame_ids):
        return None
    one, other = before.work.registered, after.work.registered
    if not np.array_equal(one.garment.template.faces, other.garment.template.faces):
        return None
    rows = [[_row(sequence.frame_ids, number) for number in frame_ids] for sequence in (one, other)]
    apart = np.empty(len(frame_ids))
    for start in range(0, len(frame_ids), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        difference = one.vertices[rows[0][part]].astype(np.float64) - other.vertices[rows[1][part]]
        apart[part] = 1e3 * np.linalg.norm(difference, axis=2).mean(axis=1)
    return apart


def _row(frame_ids: np.ndarray, number: int) -> int:
    row = int(np.searchsorted(frame_ids, number))
    if row == len(frame_ids) or frame_ids[row] != number:
        raise InputError(f"expected frame {number} among the registered ones, as in metrics.jsonl; found none")
    return row


# --- limits ------------------------------------------------------------------------------------------------------


def parse_worse_limits(texts: Sequence[str]) -> list[tuple[str, float]]:
    """`["fit_mean_mm=5"]` as metrics and percent.

    Raises:
        InputError: a text is nothing of the kind, or names no metric.
    """
    expected = "METRIC=PERCENT such as fit_mean_mm=5"
    limits = parse_numbers(texts, FAIL_IF_WORSE, expected)
    for text, (_, percent) in zip(texts, limits, strict=True):
        if percent < 0:
            raise InputError(f"{FAIL_IF_WORSE}: expected {expected}, found '{text}'")
    return limits


def broken_limits(found: WorkDiff, limits: Sequence[tuple[str, float]]) -> list[str]:
    """One line for each metric that has become worse by more than its percentage; what was not measured in both has.

    Raises:
        InputError: neither folder has such a metric.
    """
    metrics = {metric.key: metric for metric in found.metrics}
    broken = []
    for key, percent in limits:
        if key not in metrics:
            raise unknown_metric(FAIL_IF_WORSE, key, metrics, where=" in either folder")
        metric = metrics[key]
        if not metric.worse_percent <= percent:
            broken.append(_said(metric, percent))
    return broken


def _said(metric: MetricChange, percent: float) -> str:
    if metric.before is None or metric.after is None:
        return f"{metric.key} was not measured in both, which breaks the limit of {percent:g} %"
    grown = f", {metric.worse_percent:.3g} %" if np.isfinite(metric.worse_percent) else ""
    return (
        f"{metric.key} was {metric.before:.6g}, now {metric.after:.6g}: worse{grown}, more than {percent:g} % allowed"
    )


# --- for machines ------------------------------------------------------------------------------------------------


def as_json(found: WorkDiff) -> dict[str, Any]:
    """The diff for machines; docs/how-to/runs.md describes it."""
    return {
        "format": 1,
        "before": _side_json(found.before),
        "after": _side_json(found.after),
        "same_take": found.same_take,
        "takes": found.takes,
        "notes": list(found.notes),
        "settings": [
            {"stage": each.stage, "kind": each.kind, "name": each.name, "before": each.before, "after": each.after}
            for each in found.settings
        ],
        "metrics": [_metric_json(metric) for metric in found.metrics],
        "verdicts": [
            {"before": each.before, "after": each.after, "frames": list(each.frames)} for each in found.verdicts
        ],
        "frames_in_both": len(found.frame_ids),
    }


def _side_json(side: Side) -> Mapping[str, Any]:
    return {
        "work": str(side.work.path),
        "take": side.take,
        "kind": side.kind,
        "finished": side.finished,
        "frames": len(side.records),
    }


def _metric_json(metric: MetricChange) -> Mapping[str, Any]:
    worse = metric.worse_percent
    return {
        "key": metric.key,
        "unit": metric.unit,
        "better": metric.better,
        "before": metric.before,
        "after": metric.after,
        "verdict": metric.verdict,
        "worse_percent": worse if np.isfinite(worse) else None,
    }
