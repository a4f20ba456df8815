"""The report of a work folder: WORK/report/index.html, self-contained, and WORK/report/metrics.json.

docs/reference/report.md defines every metric. Those against truth appear where the capture has one.
"""

from __future__ import annotations

import contextlib
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from capture4d.app.drawing.charts import Line, line_chart
from capture4d.app.drawing.palette import BLUE, GREEN, GREY, ORANGE
from capture4d.app.drawing.panels import Framing, Panel, colour_bar, draw_frame, readable_scan
from capture4d.app.report.metrics import METRICS, column, shown, summarise, truth_measures
from capture4d.app.report.stages import (
    Calibration,
    Comparison,
    StagePictures,
    Tracking,
    calibration,
    comparison,
    comparison_digest,
    draw_stages,
    tracking,
)
from capture4d.captures.capture import Capture, read_capture
from capture4d.captures.evaluation import correspondence_errors, material_points
from capture4d.captures.truth import TruthModel, read_truth_model, read_truth_vertices
from capture4d.captures.work_folder import VERDICTS, WorkFolder
from capture4d.errors import InputError
from capture4d.files.atomic import write_bytes, write_json
from capture4d.runs.made import digest_of
from capture4d.runs.stage import StageResult, complete_record, open_stage, read_record, result_of
from capture4d.runs.workers import run_jobs, shared
from capture4d.settings import Count, settings

__all__ = ["MAX_FLAGGED_ROWS", "ReportConfig", "flat", "is_current", "joined_chart", "run", "spread"]

SCHEMA = 3
MAX_FLAGGED_ROWS = 60
CURVES: tuple[tuple[str, float, tuple[tuple[str, str, str], ...]], ...] = (
    (
        "Fit, mm",
        0.0,
        (
            ("mean", "fit_mean_mm", BLUE),
            ("95 %", "fit_p95_mm", GREY),
            ("scan to template", "scan_fit_mean_mm", GREEN),
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
    (
        "Faces at fault",
        0.0,
        (("self-intersecting", "self_intersections", ORANGE), ("flipped", "flipped_faces", BLUE)),
    ),
)
"""Charts: title, start of the vertical axis, and curves (name, metric, colour)."""


@dataclass(frozen=True, slots=True, eq=False)
class Stages:
    """What came before registration, and after."""

    calibration: Calibration | None
    tracking: Tracking | None
    pictures: Sequence[StagePictures]
    comparison: Comparison | None


@settings
class ReportConfig:
    """What the report shows."""

    pictures: Count = 6
    """Frames drawn, spread over the take; the worst flagged frame comes on top."""
    stage_pictures: Count = 3
    """Frames whose extraction and tracking are drawn."""
    truth_frames: Count = 240
    """Frames measured against the truth at most, spread over the take."""


DEFAULT = ReportConfig()


def run(
    work: WorkFolder,
    config: ReportConfig = DEFAULT,
    *,
    capture: Capture | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Write the report, unless it is there and what it shows has not changed; its page is the result's path.

    Args:
        work: with a finished registration/.
        capture: the capture, if it has moved since.
    Raises:
        InputError: the registration is unfinished, or the capture is not where it was.
    """
    folder = work.path / "report"
    place = work.capture_path if capture is None else capture.path
    command = f"capture4d register {place} --output {work.path}"
    registered = complete_record(work.path / "registration", "register", command)
    opened = capture or read_capture(place)
    said = [opened.name, opened.entries("fps", "units", "garment_colour", "boundary_colours")]
    upstream = {
        "registration": registered["digest"],
        "settings of the registration": digest_of(registered["config"]),
        "capture.json": digest_of(said),
    }
    compared = comparison_digest(work.path)
    if compared is not None:
        upstream["compare"] = compared
    current = {"schema": SCHEMA, "config": asdict(config), "upstream": upstream}
    if not overwrite and is_current(folder, current):
        return result_of(folder, folder / "index.html")
    stale = (folder / "stage.json").exists()
    stage = open_stage(folder, name="report", schema=SCHEMA, config=config, upstream=upstream, overwrite=stale)
    frame_ids = tuple(work.registered.frame_ids.tolist())  # those that were asked for
    scene = _Scene(work, replace(opened, frame_ids=frame_ids))
    records = [dict(record) for record in work.records]
    _measure_truth(scene, records, config, workers)
    tracked = tracking(scene.capture, work.path)
    summary = summarise(records)
    if tracked is not None:
        summary |= tracked.metrics
    heat = {"fit error": summary.get("fit_p95_mm"), "correspondence error": summary.get("correspondence_p95_mm")}
    scales = {title: _round_up(value) for title, value in heat.items() if value is not None}
    rows = _draw(scene, _drawn_rows(records, config.pictures), scales, workers)
    stages = Stages(
        calibration(scene.capture, work.path),
        tracked,
        draw_stages(work, scene.capture, spread(len(records), config.stage_pictures), workers=workers),
        comparison(work.path),
    )
    write_json(
        folder / "metrics.json",
        {
            "metrics": [
                {"key": key, "value": value, "unit": METRICS[key][0], "better": METRICS[key][1]}
                for key, value in summary.items()
            ],
            "capture": scene.capture.name,
            "frames": len(records),
        },
    )
    page = _page(scene, records, summary, scales, rows, stages)
    write_bytes(folder / "index.html", page.encode())
    # the report holds times, which differ between equal runs; nothing is made from it
    return stage.finish([], output=folder / "index.html")


# --- frames ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Scene:
    """What pictures and measures are made of; a process reads each part once."""

    work: WorkFolder
    capture: Capture

    def __getstate__(self) -> dict[str, Any]:
        return {"work": self.work, "capture": self.capture}

    @cached_property
    def truth(self) -> TruthModel | None:
        return read_truth_model(self.capture)


def _measure_truth(scene: _Scene, records: list[dict[str, Any]], config: ReportConfig, workers: int) -> None:
    """Add the measures against truth to the records of the frames that have them."""
    if scene.truth is None:
        return
    rows = spread(len(records), config.truth_frames)
    for row, measures in run_jobs(
        _measure_row, rows, prepare=shared(scene), workers=workers, label="measure against truth"
    ):
        if isinstance(measures, str):
            flagged = records[row]
            verdict = "check" if flagged["verdict"] == "good" else flagged["verdict"]
            flagged |= {"verdict": verdict, "reasons": [*flagged["reasons"], f"no truth: {measures}"]}
        else:
            records[row].update(measures)


def _measure_row(scene: _Scene, row: int) -> tuple[int, dict[str, float] | str]:
    """The measures of a frame, or why there are none."""
    registered, model = scene.work.registered, scene.truth
    assert model is not None
    try:
        vertices = read_truth_vertices(scene.capture, int(registered.frame_ids[row]), model=model)
    except InputError as error:
        return row, str(error)
    return row, truth_measures(registered, row, model, vertices)


def _draw(scene: _Scene, rows: list[int], scales: Mapping[str, float], workers: int) -> dict[int, list[list[Panel]]]:
    registered = scene.work.registered
    x, y, z = np.max([np.ptp(vertices, axis=0) for vertices in registered.vertices], axis=0).tolist()
    jobs = [_DrawJob(row, Framing((x, y, z)), scales) for row in rows]
    return dict(run_jobs(_draw_row, jobs, prepare=shared(scene), workers=workers, label="draw"))


@dataclass(frozen=True, slots=True, eq=False)
class _DrawJob:
    row: int
    framing: Framing
    scales: Mapping[str, float]


def _draw_row(scene: _Scene, job: _DrawJob) -> tuple[int, list[list[Panel]]]:
    row, registered, model, capture = job.row, scene.work.registered, scene.truth, scene.capture
    frame_id, vertices = int(registered.frame_ids[row]), np.array(registered.vertices[row])
    errors = {}
    if "fit error" in job.scales:
        errors["fit error"] = (1e3 * registered.residual_m[row].astype(float), job.scales["fit error"])
    if model is not None and "correspondence error" in job.scales:
        with contextlib.suppress(InputError):  # the frame was flagged when it was measured
            fine = read_truth_vertices(capture, frame_id, model=model)
            places = material_points(fine, model.fine.faces, model.template_faces, model.template_barycentric)
            values = 1e3 * correspondence_errors(vertices, places)
            errors["correspondence error"] = (values, job.scales["correspondence error"])
    return row, draw_frame(
        readable_scan(capture, frame_id),
        registered.garment,
        vertices,
        job.framing,
        errors_mm=errors,
        border_colours=dict(capture.boundary_colours),
    )


def _drawn_rows(records: Sequence[Mapping[str, Any]], count: int) -> list[int]:
    """Rows spread over the take, and the flagged frame that fits worst."""
    rows = set(spread(len(records), count))
    flagged = [row for row, record in enumerate(records) if record["verdict"] != "good"]
    if flagged:
        rows.add(
            max(flagged, key=lambda row: (VERDICTS.index(records[row]["verdict"]), records[row].get("fit_p95_mm") or 0))
        )
    return sorted(rows)


def spread(total: int, count: int) -> list[int]:
    return sorted({round(float(row)) for row in np.linspace(0, total - 1, min(total, count))})


# --- page --------------------------------------------------------------------------------------------------------


def _page(
    scene: _Scene,
    records: Sequence[Mapping[str, Any]],
    summary: Mapping[str, float | None],
    scales: Mapping[str, float],
    pictures: Mapping[int, list[list[Panel]]],
    stages: Stages,
) -> str:
    work, capture = scene.work, scene.capture
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("capture4d.app.report", "."), autoescape=True, undefined=jinja2.StrictUndefined
    )
    flagged = [record for record in records if record["verdict"] != "good"]
    counts = {verdict: sum(record["verdict"] == verdict for record in records) for verdict in VERDICTS}
    seconds = (capture.frame_ids[-1] - capture.frame_ids[0] + 1) / capture.fps
    template = work.registered.garment.template
    return environment.get_template("report.html.jinja").render(
        title=capture.name,
        subtitle=f"{len(records)} frames, {seconds:.1f} s at {capture.fps:g} fps; a template of "
        f"{len(template.vertices):,} vertices registered to every scan.",
        version=version("capture4d"),
        tiles=list(_tiles(summary)),
        strip=[(verdict, len(list(group))) for verdict, group in groupby(record["verdict"] for record in records)],
        verdicts=[(verdict, count) for verdict, count in counts.items() if count],
        flagged_columns=("fit mean, mm", "border mean, mm"),
        pictures_note="Scan, registered template, and errors, from the front and from behind.",
        flagged=[
            {
                "frame_id": record["frame_id"],
                "verdict": record["verdict"],
                "reasons": "; ".join(record["reasons"]),
                "shown": [shown(record.get("fit_mean_mm")), shown(record.get("boundary_mean_mm"))],
            }
            for record in flagged[:MAX_FLAGGED_ROWS]
        ],
        flagged_left_out=max(0, len(flagged) - MAX_FLAGGED_ROWS),
        charts=list(_charts(records)),
        columns=2 + len(scales),
        calibration=stages.calibration,
        comparison=stages.comparison,
        tracking=_tracking_part(stages.tracking),
        extraction=[{"frame_id": records[each.row]["frame_id"], "panels": each.extraction} for each in stages.pictures],
        tracked=[
            {"frame_id": records[each.row]["frame_id"], "panels": each.tracking}
            for each in stages.pictures
            if each.tracking
        ],
        scales=[{"title": title, "high": f"{high:g}", "uri": colour_bar(high)} for title, high in scales.items()],
        frames=[
            {
                "frame_id": records[row]["frame_id"],
                "verdict": records[row]["verdict"],
                "caption": _caption(records[row]),
                "rows": panels,
            }
            for row, panels in sorted(pictures.items())
        ],
        metrics=[
            {"key": key, "shown": shown(value), "unit": METRICS[key][0], "meaning": METRICS[key][2]}
            for key, value in summary.items()
        ],
        run=list(_run_rows(work, capture, records)),
        settings=list(flat(work.stages["registration"]["config"])),
    )


def _tracking_part(tracked: Tracking | None) -> dict[str, Any] | None:
    """Tracking as the page shows it."""
    if tracked is None:
        return None
    flagged = tracked.flagged()
    return {
        "tiles": tracked.section.tiles,
        "charts": tracked.section.charts,
        "flagged": [
            {"frame_id": each["frame_id"], "verdict": each["verdict"], "reasons": "; ".join(each["reasons"])}
            for each in flagged[:MAX_FLAGGED_ROWS]
        ],
        "left_out": max(0, len(flagged) - MAX_FLAGGED_ROWS),
        "unseen": [f"{limb} ({count} of {len(tracked.records)} frames)" for limb, count in tracked.unseen],
    }


def _tiles(summary: Mapping[str, float | None]) -> Sequence[dict[str, str]]:
    names = {
        "frames_good_percent": "frames are good",
        "fit_mean_mm": "fit to the scan",
        "boundary_mean_mm": "painted border",
        "truth_distance_mean_mm": "distance to the true surface",
        "correspondence_mean_mm": "correspondence error",
        "border_mean_mm": "true border",
        "cpu_s": "CPU a frame, median",
    }
    return [
        {"name": name, "value": shown(summary[key]), "unit": METRICS[key][0]}
        for key, name in names.items()
        if key in summary
    ]


def _charts(records: Sequence[Mapping[str, Any]]) -> Sequence[dict[str, str]]:
    frames = [int(record["frame_id"]) for record in records]
    charts = []
    for title, floor, wanted in CURVES:
        lines = [Line(name, column(records, key), colour) for name, key, colour in wanted if _any(records, key)]
        if lines:
            charts.append({"title": title, "svg": joined_chart(frames, lines, floor)})
    return charts


def joined_chart(frames: list[int], lines: list[Line], floor: float) -> str:
    """Frames without any value are left out, so that measures taken on every n-th frame join up."""
    kept = np.flatnonzero(np.any([np.isfinite(line.values) for line in lines], axis=0))
    shorter = [Line(line.name, line.values[kept], line.colour) for line in lines]
    return line_chart([frames[row] for row in kept], shorter, floor=floor)


def _caption(record: Mapping[str, Any]) -> str:
    named = {"fit": "fit_mean_mm", "border": "boundary_mean_mm", "correspondence": "correspondence_mean_mm"}
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


# --- small things ------------------------------------------------------------------------------------------------


def is_current(folder: Path, current: Mapping[str, Any]) -> bool:
    if not all((folder / name).is_file() for name in ("stage.json", "index.html", "metrics.json")):
        return False
    record = read_record(folder / "stage.json")
    return record.get("status") == "complete" and all(record.get(key) == value for key, value in current.items())


def _any(records: Sequence[Mapping[str, Any]], key: str) -> bool:
    return bool(np.isfinite(column(records, key)).any())


def _round_up(value: float) -> float:
    """The next of 1, 2 and 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-3)))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= value * 0.999)


def flat(value: Any, prefix: str = "") -> Sequence[tuple[str, str]]:
    if not isinstance(value, dict):
        return [(prefix, str(value))]
    return [row for key, entry in value.items() for row in flat(entry, f"{prefix}.{key}" if prefix else key)]
