"""A diff of two work folders as text for a terminal, a pipe or a CI log."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from capture4d.app.differences.changes import MetricChange
from capture4d.app.differences.work_diff import WorkDiff
from capture4d.app.report.metrics import shown
from capture4d.runs.frame_lists import frame_ranges

__all__ = ["aligned", "frames_told", "table_lines"]

_MOST_SETTINGS = 30
_MOST_RANGES = 8


def table_lines(found: WorkDiff) -> list[str]:
    """What differs, line by line: the takes, the settings, the metrics, the verdicts."""
    before, after = found.before, found.after
    lines = [f"{before.name}: {before.told}", f"{after.name}: {after.told}", found.takes, *found.notes, ""]
    lines += _settings(found)
    if found.metrics:
        head = ("", before.name, after.name, "", "change", "")
        lines += ["", *aligned([head, *map(_cells, found.metrics)], left=(0, 3, 5))]
        if any(metric.over_all for metric in found.metrics):
            lines.append("* over all frames of each folder; the others over those that both have measured")
        lines += [found.tally] if found.tally else []
    else:
        lines += ["", "No metrics: neither has measured a frame yet."]
    if found.verdicts:
        lines += ["", "Verdicts that changed:"]
        lines += [
            f"  {each.before} to {each.after}: {frames_told(each.frames, found.frame_ids)}" for each in found.verdicts
        ]
    lines += _only_in(found)
    return lines


def _settings(found: WorkDiff) -> list[str]:
    if not found.settings:
        return ["Made with the same settings, from the same inputs."]
    lines = [f"  {change.words}" for change in found.settings[:_MOST_SETTINGS]]
    left = len(found.settings) - len(lines)
    return ["What changed:", *lines, *([f"  and {left} more settings, which are on the page"] if left else [])]


def _cells(metric: MetricChange) -> tuple[str, ...]:
    verdict = "" if metric.verdict in ("same", "unknown") else metric.verdict
    name = f"{metric.key}{' *' if metric.over_all else ''}"
    return name, shown(metric.before), shown(metric.after), metric.unit, metric.change, verdict


def _only_in(found: WorkDiff) -> list[str]:
    sides = ((found.before, found.only_before), (found.after, found.only_after))
    return [f"Only in {side.name}: {frames_told(numbers, side.records)}" for side, numbers in sides if numbers]


def frames_told(numbers: Sequence[int], among: Iterable[int]) -> str:
    """One frame, or ranges such as 12-19, 44; as many ranges as a line holds."""
    return f"{'frame' if len(numbers) == 1 else 'frames'} {frame_ranges(numbers, among=among, most=_MOST_RANGES)}"


def aligned(rows: Sequence[Sequence[str]], *, left: Sequence[int] = (0,)) -> list[str]:
    """Rows of a table with two spaces between columns; those of `left` begin on the left, the others end on the
    right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if place in left else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
