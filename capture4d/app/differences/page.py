"""A diff of two work folders as one self-contained page: what changed, metrics, and curves of both over the frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from capture4d.app.differences.sides import Side
from capture4d.app.differences.work_diff import WorkDiff
from capture4d.app.drawing.charts import Line, line_chart
from capture4d.app.drawing.palette import BLUE, ORANGE
from capture4d.app.report.limits import KNOWN_METRICS
from capture4d.app.report.metrics import column, frame_ranges, shown
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
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("capture4d.app.differences", "."), autoescape=True, undefined=jinja2.StrictUndefined
    )
    before, after = found.before, found.after
    return environment.get_template("diff.html.jinja").render(
        version=version("capture4d"),
        diff=found,
        sides=[_side(before, BEFORE), _side(after, AFTER)],
        tiles=_tiles(found),
        metrics=[
            {
                "metric": metric,
                "before": shown(metric.before),
                "after": shown(metric.after),
                "verdict": metric.verdict if metric.verdict in ("better", "worse") else "",
            }
            for metric in found.metrics
        ],
        over_all=any(metric.over_all for metric in found.metrics),
        verdicts=[
            {"before": each.before, "after": each.after, "count": len(each.frames), "frames": frame_ranges(each.frames)}
            for each in found.verdicts
        ],
        only=[
            (side.name, frame_ranges(numbers))
            for side, numbers in ((before, found.only_before), (after, found.only_after))
            if numbers
        ],
        charts=list(_charts(found)),
        worst=_worst(found),
    )


def _side(side: Side, colour: str) -> Mapping[str, Any]:
    verdicts = [str(side.records[number].get("verdict", "unknown")) for number in sorted(side.records)]
    return {
        "name": side.name,
        "told": side.told,
        "path": str(side.work.path.resolve()),
        "colour": colour,
        "strip": [(verdict, len(list(group))) for verdict, group in groupby(verdicts)],
        "counts": [(verdict, verdicts.count(verdict)) for verdict in dict.fromkeys(verdicts)],
    }


def _tiles(found: WorkDiff) -> list[Mapping[str, str]]:
    metrics = {metric.key: metric for metric in found.metrics}
    return [
        {
            "name": name,
            "before": shown(metrics[key].before),
            "after": shown(metrics[key].after),
            "unit": metrics[key].unit,
            "change": "" if metrics[key].verdict == "unknown" else metrics[key].change,
            "verdict": metrics[key].verdict,
        }
        for key, name in TILES
        if key in metrics
    ]


def _charts(found: WorkDiff) -> Sequence[Mapping[str, str]]:
    """A chart a measure, over the frames of either folder; a frame that only one has is a gap in the other's curve."""
    numbers = sorted({*found.before.records, *found.after.records})
    units = {metric.key: (metric.unit, metric.meaning) for metric in found.metrics}
    charts = []
    for key in KNOWN_METRICS:
        if key not in units:
            continue
        lines = [
            Line(side.name, column([side.records.get(number, {}) for number in numbers], key), colour)
            for side, colour in ((found.before, BEFORE), (found.after, AFTER))
        ]
        measured = np.any([np.isfinite(line.values) for line in lines], axis=0)
        if not measured.any():
            continue
        kept = np.flatnonzero(measured)
        shorter = [Line(line.name, line.values[kept], line.colour) for line in lines]
        unit, meaning = units[key]
        floor = 1.0 if key == "stretch_p99" else 0.0
        svg = line_chart([numbers[row] for row in kept], shorter, floor=floor)
        charts.append({"key": key, "unit": unit, "meaning": meaning, "svg": svg})
    if found.apart_mm is not None:
        svg = line_chart(list(found.frame_ids), [Line("vertex to vertex, mean", found.apart_mm, BLUE)])
        apart = {"key": "apart", "unit": "mm", "meaning": "one surface to the other, vertex to vertex", "svg": svg}
        charts.insert(0, apart)
    return charts


def _worst(found: WorkDiff) -> Mapping[str, Any] | None:
    """The frames that have become worse by most."""
    metrics = {metric.key: metric for metric in found.metrics}
    key = next((key for key in WORST_BY if key in metrics and metrics[key].delta is not None), None)
    if key is None or not found.frame_ids or metrics[key].over_all:
        return None
    values = [column([side.records[number] for number in found.frame_ids], key) for side in (found.before, found.after)]
    grown = np.nan_to_num(values[1] - values[0], nan=-np.inf)
    order = [int(place) for place in np.argsort(-grown)[:MOST_FRAMES] if grown[place] > 0]
    rows = [
        {
            "frame_id": found.frame_ids[place],
            "verdicts": [
                str(side.records[found.frame_ids[place]].get("verdict", "")) for side in (found.before, found.after)
            ],
            "before": shown(float(values[0][place])),
            "after": shown(float(values[1][place])),
            "apart": None if found.apart_mm is None else shown(float(found.apart_mm[place])),
            "reasons": "; ".join(found.after.records[found.frame_ids[place]].get("reasons", [])),
        }
        for place in order
    ]
    return {"key": key, "unit": metrics[key].unit, "rows": rows} if rows else None
