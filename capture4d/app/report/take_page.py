"""The page of a registered take, from what was measured and drawn."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from capture4d.app.compare.table import LEARNED, comparison_table
from capture4d.app.drawing.charts import Line, joined_chart
from capture4d.app.drawing.page import Badge, Chart, Column, Film, Table, Tile, render_page
from capture4d.app.drawing.palette import BLUE, GREEN, GREY, ORANGE
from capture4d.app.drawing.panels import Panel, Scale
from capture4d.app.report.flagged import FLAGGED_NOTE, flagged_table, verdict_counts, verdict_runs
from capture4d.app.report.metrics import METRICS, column, region_rows, shown
from capture4d.app.report.moving import exported_page
from capture4d.app.report.stages import Calibration, Comparison, StagePictures, Tracking
from capture4d.captures.capture import Capture
from capture4d.captures.work_folder import VERDICTS, WorkFolder

__all__ = ["Drawings", "Stages", "flat", "metrics_table", "take_page"]

CURVES: tuple[tuple[str, float, tuple[tuple[str, str, str], ...]], ...] = (
    (
        "Fit, mm",
        0.0,
        (
            ("mean", "fit_mean_mm", BLUE),
            ("95 %", "fit_p95_mm", GREY),
            ("99 %", "fit_p99_mm", ORANGE),
            ("scan to template", "scan_fit_mean_mm", GREEN),
        ),
    ),
    (
        "Farther than 2 mm, % of the vertices with scan data",
        0.0,
        (
            ("from the scan", "fit_beyond_percent", BLUE),
            ("from the true surface", "truth_distance_beyond_percent", ORANGE),
        ),
    ),
    ("Painted border, mm", 0.0, (("mean", "boundary_mean_mm", BLUE), ("95 %", "boundary_p95_mm", GREY))),
    (
        "Against the truth, mm",
        0.0,
        (
            ("correspondence", "correspondence_mean_mm", ORANGE),
            ("surface", "truth_distance_mean_mm", BLUE),
            ("border", "border_mean_mm", GREEN),
        ),
    ),
    ("CPU time a frame, s", 0.0, (("registration", "cpu_s", BLUE),)),
    ("Stretch of edges", 1.0, (("99 %", "stretch_p99", BLUE),)),
    ("Creased edges, %", 0.0, (("more than 60 degrees", "creased_percent", ORANGE),)),
    (
        "Faces at fault",
        0.0,
        (("self-intersecting", "self_intersections", ORANGE), ("flipped", "flipped_faces", BLUE)),
    ),
)
"""Charts: title, start of the vertical axis, and curves (name, metric, colour)."""
TILES: Mapping[str, str] = {
    "frames_good_percent": "frames are good",
    "fit_mean_mm": "fit to the scan, mean",
    "fit_p99_mm": "the same, 99 %",
    "fit_max_mm": "the same, farthest vertex",
    "fit_beyond_percent": "of the vertices farther than 2 mm",
    "boundary_mean_mm": "painted border",
    "truth_distance_mean_mm": "distance to the true surface",
    "correspondence_mean_mm": "correspondence error",
    "border_mean_mm": "true border",
    "cpu_s": "CPU a frame, median",
}
FLAGGED_MEASURES = (
    ("cut faces", "self_intersections"),
    ("fit 99 %, mm", "fit_p99_mm"),
    ("border mean, mm", "boundary_mean_mm"),
)
REGION_COLUMNS = (
    ("fit 95 %, mm", "fit_p95_mm"),
    ("farthest, mm", "fit_max_mm"),
    ("beyond 2 mm, %", "fit_beyond_percent"),
    ("faces that cut, %", "cut_percent"),
    ("creased edges, %", "creased_percent"),
    ("least scan data, %", "covered_percent"),
)
REGIONS_NOTE = (
    "Fit is the mean over the frames; every other figure is that of the region's worst frame. Where a region has "
    "little scan data its cloth is hidden, and guessed."
)


@dataclass(frozen=True, slots=True, eq=False)
class Stages:
    """What came before registration, and after."""

    calibration: Calibration | None
    tracking: Tracking | None
    pictures: Sequence[StagePictures]
    comparison: Comparison | None


@dataclass(frozen=True, slots=True, eq=False)
class Drawings:
    """Pictures of the take."""

    frames: Mapping[int, Sequence[Panel]]
    """By position in the take."""
    scales: Sequence[Scale]
    """Of the errors in them."""
    films: Sequence[Film]


def take_page(
    work: WorkFolder,
    capture: Capture,
    records: Sequence[Mapping[str, Any]],
    summary: Mapping[str, float | None],
    drawings: Drawings,
    stages: Stages,
) -> str:
    """The HTML."""
    seconds = (capture.frame_ids[-1] - capture.frame_ids[0] + 1) / capture.fps
    template = work.registered.garment.template
    return render_page(
        "capture4d.app.report",
        "report.html.jinja",
        title=capture.name,
        subtitle=f"{len(records)} frames, {seconds:.1f} s at {capture.fps:g} fps; a template of "
        f"{len(template.vertices):,} vertices registered to every scan.",
        tiles=[Tile(shown(summary[key]), METRICS[key][0], name) for key, name in TILES.items() if key in summary],
        strip=verdict_runs(records),
        verdicts=verdict_counts(records, VERDICTS),
        flagged=flagged_table(records, measures=FLAGGED_MEASURES),
        flagged_note=FLAGGED_NOTE,
        regions=_regions_table(records),
        regions_note=REGIONS_NOTE,
        charts=list(_charts(records)),
        columns=2 + len(drawings.scales),
        films=drawings.films,
        pictures_note="Scan, registered template, and errors, from the front and from behind.",
        scales=drawings.scales,
        frames=[
            {
                "frame_id": records[row]["frame_id"],
                "verdict": Badge(records[row]["verdict"]),
                "caption": _caption(records[row]),
                "panels": panels,
            }
            for row, panels in sorted(drawings.frames.items())
        ],
        calibration=stages.calibration,
        moving=exported_page(work.path),
        comparison=_comparison_part(stages.comparison),
        tracking=_tracking_part(stages.tracking),
        extraction=[{"frame_id": records[each.row]["frame_id"], "panels": each.extraction} for each in stages.pictures],
        tracked=[
            {"frame_id": records[each.row]["frame_id"], "panels": each.tracking}
            for each in stages.pictures
            if each.tracking
        ],
        metrics=metrics_table(summary, METRICS),
        run=list(_run_rows(work, capture, records)),
        settings=list(flat(work.stages["registration"]["config"])),
    )


def metrics_table(summary: Mapping[str, float | None], defined: Mapping[str, tuple[str, str, str]]) -> Table:
    """Every metric with its unit and meaning.

    Args:
        defined: unit, better direction and meaning of each.
    """
    columns = [Column("name"), Column("value", number=True), Column("unit"), Column("what it is")]
    rows = [[key, shown(value), defined[key][0], defined[key][2]] for key, value in summary.items()]
    return Table(columns, rows)


def flat(value: Any, prefix: str = "") -> Sequence[tuple[str, str]]:
    """Nested settings as (dotted name, text)."""
    if not isinstance(value, dict):
        return [(prefix, str(value))]
    return [row for key, entry in value.items() for row in flat(entry, f"{prefix}.{key}" if prefix else key)]


def _regions_table(records: Sequence[Mapping[str, Any]]) -> Table | None:
    """Where on the garment it is good, the most creased and cut regions first."""
    regions = region_rows(records)
    if not regions:
        return None
    order = sorted(
        regions, key=lambda name: -((regions[name]["cut_percent"] or 0) + (regions[name]["creased_percent"] or 0))
    )
    columns = [Column("region"), *(Column(heading, number=True) for heading, _ in REGION_COLUMNS)]
    return Table(columns, [[name, *(_tenths(regions[name][key]) for _, key in REGION_COLUMNS)] for name in order])


def _tenths(value: float | None) -> str:
    """Two digits after the point below one, else one."""
    return "–" if value is None else f"{value:.2f}" if abs(value) < 1 else f"{value:.1f}"


def _tracking_part(tracked: Tracking | None) -> dict[str, Any] | None:
    """Tracking as the page shows it."""
    if tracked is None:
        return None
    return {
        "tiles": tracked.section.tiles,
        "charts": tracked.section.charts,
        "flagged": flagged_table(tracked.records, worst_by="median_mm"),
        "flagged_note": FLAGGED_NOTE,
        "unseen": [f"{limb} ({count} of {len(tracked.records)} frames)" for limb, count in tracked.unseen],
    }


def _comparison_part(compared: Comparison | None) -> dict[str, Any] | None:
    """The comparison of surfaces as the page shows it."""
    if compared is None:
        return None
    against = "the true positions" if compared.against_truth else "the registration"
    return {
        "note": f"On {compared.frames} held-out frames. Normals are measured against the maps of the scans, vertices "
        f"against {against}.",
        "table": comparison_table(compared.rows),
        "learned": LEARNED if any(row["learned"] for row in compared.rows) else "",
        "conclusion": compared.conclusion,
        "pictures": compared.pictures,
        "people": compared.people,
        "people_frame": compared.people_frame,
    }


def _charts(records: Sequence[Mapping[str, Any]]) -> Sequence[Chart]:
    frames = [int(record["frame_id"]) for record in records]
    charts = []
    for title, floor, wanted in CURVES:
        lines = [Line(name, values, colour) for name, key, colour in wanted
                 if np.isfinite(values := column(records, key)).any()]  # fmt: skip
        if lines:
            charts.append(Chart(title, joined_chart(frames, lines, floor=floor)))
    return charts


def _caption(record: Mapping[str, Any]) -> str:
    named = {
        "fit": "fit_mean_mm",
        "99 %": "fit_p99_mm",
        "farthest": "fit_max_mm",
        "border": "boundary_mean_mm",
        "correspondence": "correspondence_mean_mm",
    }
    parts = [f"{name} {shown(record[key])} mm" for name, key in named.items() if record.get(key) is not None]
    return " · ".join([*parts, *record["reasons"]])


def _run_rows(work: WorkFolder, capture: Capture, records: Sequence[Mapping[str, Any]]) -> Sequence[tuple[str, str]]:
    record, garment = work.stages["registration"], work.registered.garment
    cpu = column(records, "cpu_s")
    loops = ", ".join(f"{name} ({len(loop)})" for name, loop in garment.loops.items()) or "none"
    return [
        ("Capture", str(capture.path.resolve())),
        ("Frames", f"{len(records)}, numbers {capture.frame_ids[0]} to {capture.frame_ids[-1]}, {capture.fps:g} fps"),
        ("Template", f"{len(garment.template.vertices):,} vertices, {len(garment.template.faces):,} faces"),
        ("Border loops", loops),
        ("Registered", f"{record.get('started', '')} to {record.get('finished', '')}"),
        ("CPU time", f"{np.nansum(cpu):.1f} s in all, {np.nanmedian(cpu):.2f} s a frame"),
        ("Command", f"capture4d run {capture.path} --output {work.path}"),
        ("Digest", str(record.get("digest", ""))[:16]),
        ("Versions", ", ".join(f"{name} {version(name)}" for name in ("capture4d", "numpy", "scipy", "open3d"))),
        ("Machine", f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"),
    ]
