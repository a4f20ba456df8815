"""A diff of two work folders as one self-contained page: what changed, metrics, and curves of both over the frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.app.differences.sides import Side
from capture4d.app.differences.table import frames_told
from capture4d.app.differences.work_diff import WorkDiff
from capture4d.app.drawing.charts import Line, joined_chart, line_chart
from capture4d.app.drawing.page import Badge, Chart, Column, Table, Tile, render_page
from capture4d.app.drawing.palette import BLUE, ORANGE
from capture4d.app.report.flagged import verdict_counts, verdict_runs
from capture4d.app.report.limits import KNOWN_METRICS
from capture4d.app.report.metrics import column, shown
from capture4d.captures.work_folder import VERDICTS
from capture4d.files.atomic import write_bytes
from capture4d.files.outputs import new_files

__all__ = ["default_page", "write_page"]

BEFORE, AFTER = ORANGE, BLUE
"""Colours of the first folder's curves and of the second's."""
TILES = (
    ("frames_good_percent", "frames are good"),
    ("fit_mean_mm", "fit to the scan"),
    ("boundary_mean_mm", "painted border"),
    ("correspondence_mean_mm", "correspondence error"),
    ("inside_body_percent", "is inside the body"),
    ("pose_distance_deg", "to the nearest learned pose"),
    ("track_median_mm", "skin and suit to the body"),
    ("cpu_s", "CPU a frame, median"),
)
WORST_BY = ("correspondence_mean_mm", "fit_mean_mm", "inside_body_percent", "track_median_mm")
"""What decides which frames have become worse: the first of these that both have."""
MOST_FRAMES = 12


def write_page(found: WorkDiff, page: Path, *, overwrite: bool = False) -> None:
    """Write the page of a diff.

    Raises:
        InputError: it would take the place of something else.
    """
    with new_files([page], overwrite=overwrite) as workshop:
        write_bytes(workshop / page.name, _page(found).encode())


def default_page(found: WorkDiff) -> Path:
    """Where the page goes if nobody says: beside the second folder's stages, named by the first."""
    name = found.before.name.replace("/", "-").replace("\\", "-")
    return found.after.work.path / "diff" / f"{name}.html"


def _page(found: WorkDiff) -> str:
    before, after = found.before, found.after
    only = ((before, found.only_before), (after, found.only_after))
    return render_page(
        "capture4d.app.differences",
        "diff.html.jinja",
        title=f"{before.name} → {after.name}",
        takes=found.takes,
        same_take=found.same_take,
        notes=[*found.notes, *([found.tally] if found.tally else [])],
        tiles=list(_tiles(found)),
        settings=_settings(found),
        sides=[_side(before, BEFORE), _side(after, AFTER)],
        only=[f"Only in {side.name}: {frames_told(numbers, side.records)}." for side, numbers in only if numbers],
        verdicts=_verdicts(found),
        worst=_worst(found),
        charts=list(_charts(found)),
        metrics=_metrics(found),
        over_all=any(metric.over_all for metric in found.metrics),
        places=[(side.name, str(side.work.path.resolve())) for side in (before, after)],
    )


def _tiles(found: WorkDiff) -> Iterator[tuple[Tile, str, str]]:
    """Both figures, how they differ, and which is better."""
    metrics = {metric.key: metric for metric in found.metrics}
    for key, name in TILES:
        metric = metrics.get(key)
        if metric is not None:
            figures = f"{shown(metric.before)} → {shown(metric.after)}"
            judged = f", {metric.verdict}" if metric.verdict in ("better", "worse") else ""
            change = "" if metric.verdict == "unknown" else f"{metric.change}{judged}"
            yield Tile(figures, metric.unit, name), change, metric.verdict


def _settings(found: WorkDiff) -> Table:
    columns = [Column("stage"), Column("setting or input"), Column(found.before.name), Column(found.after.name)]
    rows = [
        [each.stage, each.name, each.before or "–", each.after or "–", each.words.partition(": ")[2]]
        for each in found.settings
    ]
    return Table([*columns, Column("in words")], rows, stacks=True)


def _side(side: Side, colour: str) -> Mapping[str, Any]:
    records = [record for _, record in sorted(side.records.items()) if "verdict" in record]
    return {
        "name": side.name,
        "told": side.told,
        "colour": colour,
        "strip": verdict_runs(records),
        "counts": verdict_counts(records, VERDICTS),
    }


def _verdicts(found: WorkDiff) -> Table:
    columns = [Column("verdict was"), Column("is"), Column("frames", number=True), Column("which")]
    rows = [
        [Badge(each.before), Badge(each.after), str(len(each.frames)), frames_told(each.frames, found.frame_ids)]
        for each in found.verdicts
    ]
    return Table(columns, rows)


def _worst(found: WorkDiff) -> Table | None:
    """The frames that have become worse by most."""
    metrics = {metric.key: metric for metric in found.metrics}
    key = next((key for key in WORST_BY if key in metrics and metrics[key].delta is not None), None)
    if key is None or not found.frame_ids or metrics[key].over_all:
        return None
    sides = (found.before, found.after)
    values = [column([side.records[number] for number in found.frame_ids], key) for side in sides]
    grown = np.nan_to_num(values[1] - values[0], nan=-np.inf)
    rows = []
    for place in np.argsort(-grown)[:MOST_FRAMES].tolist():
        if grown[place] <= 0:
            break
        number = found.frame_ids[place]
        apart = [] if found.apart_mm is None else [shown(float(found.apart_mm[place]))]
        rows.append(
            [
                str(number),
                *(Badge(str(side.records[number].get("verdict", ""))) for side in sides),
                *(shown(float(figures[place])) for figures in values),
                *apart,
                "; ".join(found.after.records[number].get("reasons", [])),
            ]
        )
    named = f"{key}, {metrics[key].unit}"
    columns = [Column("frame"), Column("was"), Column("is"), Column(named, number=True), Column("now", number=True)]
    if found.apart_mm is not None:
        columns.append(Column("surfaces apart, mm", number=True))
    return Table([*columns, Column("reasons now")], rows) if rows else None


def _charts(found: WorkDiff) -> Iterator[tuple[Chart, str]]:
    """A chart a measure, over the frames of either folder, and what the measure is; a frame that only one folder has
    is a gap in the other's curve."""
    if found.apart_mm is not None:
        line = Line("vertex to vertex, mean", found.apart_mm, BLUE)
        yield Chart("apart, mm", line_chart(list(found.frame_ids), [line])), "one surface to the other"
    numbers = sorted({*found.before.records, *found.after.records})
    metrics = {metric.key: metric for metric in found.metrics}
    for key in (key for key in KNOWN_METRICS if key in metrics):
        lines = [
            Line(side.name, column([side.records.get(number, {}) for number in numbers], key), colour)
            for side, colour in ((found.before, BEFORE), (found.after, AFTER))
        ]
        if any(np.isfinite(line.values).any() for line in lines):
            unit = metrics[key].unit
            svg = joined_chart(numbers, lines, floor=1.0 if key == "stretch_p99" else 0.0)
            yield Chart(f"{key}, {unit}" if unit else key, svg), metrics[key].meaning


def _metrics(found: WorkDiff) -> Table:
    columns = [
        Column("name"),
        Column(found.before.name, number=True),
        Column(found.after.name, number=True),
        Column("unit"),
        Column("change", number=True),
        Column(""),
        Column("what it is"),
    ]
    rows = [
        [
            f"{metric.key}{' *' if metric.over_all else ''}",
            shown(metric.before),
            shown(metric.after),
            metric.unit,
            metric.change,
            Badge(metric.verdict) if metric.verdict in ("better", "worse") else "",
            metric.meaning,
        ]
        for metric in found.metrics
    ]
    return Table(columns, rows)
