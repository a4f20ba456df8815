"""The report of an animated garment: WORK/report/index.html and metrics.json, as for a registered take."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from capture4d.app.drawing.charts import Line, joined_chart
from capture4d.app.drawing.film import make_film, rows_around, tiled
from capture4d.app.drawing.page import Badge, Chart, Film, Tile, render_page
from capture4d.app.drawing.palette import BLUE, CLOTH, GREEN, GREY, HEIGHT, ORANGE, SKIN, WIDTH
from capture4d.app.drawing.panels import VIEWS, Framing, Panel, data_uri
from capture4d.app.drawing.render import Drawn, View, render
from capture4d.app.report.flagged import FLAGGED_NOTE, flagged_table, verdict_counts, verdict_runs
from capture4d.app.report.metrics import column, shown
from capture4d.app.report.moving import exported_page, shows_it
from capture4d.app.report.take import is_current, spread
from capture4d.app.report.take_page import flat, metrics_table
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.captures.work_folder import ANIMATE, VERDICTS, WorkFolder
from capture4d.files.atomic import write_bytes, write_json
from capture4d.motions.sources import acknowledgement
from capture4d.runs.stage import StageResult, open_stage, require_complete, result_of
from capture4d.runs.workers import run_jobs, shared

__all__ = ["ANIMATION_METRICS", "run"]

SCHEMA = 2
PICTURES, FILM_FRAMES = 8, 48

ANIMATION_METRICS: Mapping[str, tuple[str, str, str]] = {
    "frames_good_percent": ("%", "higher", "frames with the verdict good"),
    "frames_check": ("", "lower", "frames with the verdict check"),
    "frames_failed": ("", "lower", "frames with the verdict failed"),
    "pose_distance_deg": ("deg", "lower", "to the nearest pose that the garment was learned from"),
    "unlike_percent": ("%", "lower", "frames whose pose is unlike any that was learned"),
    "inside_before_percent": ("%", "lower", "garment vertices inside the body before they were taken out"),
    "depth_before_mm": ("mm", "lower", "the deepest of a frame before"),
    "inside_body_percent": ("%", "lower", "garment vertices inside the body"),
    "depth_mm": ("mm", "lower", "the deepest of a frame"),
    "removal_moved_mm": ("mm", "lower", "how far taking them out has moved the others, mean"),
    "overlap_percent": ("%", "lower", "garment vertices over skin that is inside another limb"),
    "stretch_p99": ("", "lower", "edge length over that of the cloth on this person, 99th percentile of a frame"),
    "stretch_p99_worst": ("", "lower", "the same of the worst frame"),
    "flipped_faces": ("", "lower", "faces turned against the body, per frame"),
}
"""Unit, better direction and meaning. Unless it says otherwise, it is the mean over the frames."""


def run(work: WorkFolder, *, workers: int = 1, overwrite: bool = False) -> StageResult:
    """Write the report, unless it is there and the animation has not changed; its page is the result's path.

    Raises:
        InputError: the animation is unfinished.
    """
    folder = work.path / "report"
    command = f"capture4d animate MODEL --poses FILE --output {work.path}"
    digest = require_complete(work.path / "registration", ANIMATE, command)
    current = {"schema": SCHEMA, "config": {}, "upstream": {"registration": digest}}
    if not overwrite and is_current(folder, current) and shows_it(folder, exported_page(work.path)):
        return result_of(folder, folder / "index.html")
    stale = (folder / "stage.json").exists()
    stage = open_stage(folder, name="report", schema=SCHEMA, config={}, upstream=current["upstream"], overwrite=stale)
    records = work.records
    summary = summarise(records)
    rows = spread(len(records), PICTURES)
    sequence = work.registered
    x, y, z = np.max([np.ptp(sequence.vertices[row], axis=0) for row in rows], axis=0).tolist()
    draw = partial(_draw_row, framing=Framing((1.3 * x, 1.15 * y, 1.3 * z)))
    pictures = dict(run_jobs(draw, rows, prepare=shared(work), workers=workers, label="draw"))
    film = _film(work, records, workers)
    metrics = [
        {"key": key, "value": value, "unit": ANIMATION_METRICS[key][0], "better": ANIMATION_METRICS[key][1]}
        for key, value in summary.items()
    ]
    write_json(
        folder / "metrics.json", {"metrics": metrics, "capture": work.path.resolve().name, "frames": len(records)}
    )
    write_bytes(folder / "index.html", _page(work, records, summary, pictures, film).encode())
    return stage.finish([], output=folder / "index.html")


def summarise(records: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The metrics from the frames' records."""
    count = {verdict: sum(record["verdict"] == verdict for record in records) for verdict in VERDICTS}
    unlike = column(records, "pose_distance_deg") > column(records, "unlike_deg")
    special = {
        "frames_good_percent": 100 * count["good"] / len(records),
        "frames_check": float(count["check"]),
        "frames_failed": float(count["failed"]),
        "stretch_p99_worst": float(np.max(column(records, "stretch_p99"))),
        "unlike_percent": 100 * float(unlike.mean()),
    }
    return {key: special.get(key, float(np.mean(column(records, key)))) for key in ANIMATION_METRICS
            if key in special or key in records[0]}  # fmt: skip


def _film(work: WorkFolder, records: Sequence[Mapping[str, Any]], workers: int) -> Film:
    """Consecutive frames around the one with most of the garment inside the body before it was taken out."""
    worst = max(range(len(records)), key=lambda row: records[row].get("inside_before_percent") or 0.0)
    rows, sequence = rows_around(len(records), FILM_FRAMES, worst), work.registered
    x, y, z = np.max([np.ptp(sequence.vertices[row], axis=0) for row in rows], axis=0).tolist()
    draw = partial(_film_row, framing=Framing((1.3 * x, 1.15 * y, 1.3 * z)))
    drawn = dict(run_jobs(draw, list(rows), prepare=shared(work), workers=workers, label="film"))
    chosen = [records[row] for row in rows]
    return make_film(
        f"Frames {chosen[0]['frame_id']} to {chosen[-1]['frame_id']}, one by one",
        [drawn[row] for row in rows],
        ["; ".join([f"Frame {each['frame_id']}, {each['verdict']}", *each["reasons"]]) for each in chosen],
        seconds=1.0 / work.require_posed_body()[1].fps,
        note="The garment on the body, from the front and from behind. The slider stops at a frame.",
    )


def _film_row(work: WorkFolder, row: int, *, framing: Framing) -> tuple[int, np.ndarray]:
    drawn, views = _posed(work, row, framing)
    return row, tiled([[render(drawn, view, width=WIDTH, height=HEIGHT) for view in views]])


def _draw_row(work: WorkFolder, row: int, *, framing: Framing) -> tuple[int, list[Panel]]:
    """The garment on the body, from both sides."""
    drawn, views = _posed(work, row, framing)
    return row, [
        Panel(direction.replace("_", " "), data_uri(render(drawn, view, width=WIDTH, height=HEIGHT)))
        for direction, view in zip(VIEWS, views, strict=True)
    ]


def _posed(work: WorkFolder, row: int, framing: Framing) -> tuple[list[Drawn], list[View]]:
    sequence, (body, poses) = work.registered, work.require_posed_body()
    vertices = np.array(sequence.vertices[row])
    posed = pose_frame(with_shape(body, poses.shape), poses, row).vertices().astype(np.float32)
    drawn = [
        Drawn(sequence.garment.template.with_vertices(vertices), CLOTH),
        Drawn(body.template.with_vertices(posed), SKIN),
    ]
    return drawn, [framing.view(vertices, direction) for direction in VIEWS]


def _page(
    work: WorkFolder,
    records: Sequence[Mapping[str, Any]],
    summary: Mapping[str, float],
    pictures: Mapping[int, Sequence[Panel]],
    film: Film,
) -> str:
    stage, poses = work.stages["registration"], work.require_posed_body()[1]
    template = work.registered.garment.template
    return render_page(
        "capture4d.app.report",
        "report.html.jinja",
        title=work.path.resolve().name,
        subtitle=f"{len(records)} frames, {len(records) / poses.fps:.1f} s at {poses.fps:g} fps; a learned garment of "
        f"{len(template.vertices):,} vertices on a body of {_shape(poses.shape)}. "
        f"{acknowledgement(Path(stage['sources']['poses'])) or ''}",
        tiles=[
            Tile(shown(summary[key]), ANIMATION_METRICS[key][0], name)
            for key, name in (
                ("frames_good_percent", "frames are good"),
                ("inside_before_percent", "was inside the body"),
                ("inside_body_percent", "is inside the body"),
                ("stretch_p99_worst", "stretch of the worst frame"),
                ("flipped_faces", "faces turned against the body, per frame"),
                ("pose_distance_deg", "to the nearest learned pose"),
            )
        ],
        strip=verdict_runs(records),
        verdicts=verdict_counts(records, VERDICTS),
        flagged=flagged_table(
            records, measures=(("pose distance, deg", "pose_distance_deg"), ("inside, %", "inside_body_percent"))
        ),
        flagged_note=FLAGGED_NOTE,
        regions=None,
        regions_note="",
        charts=_charts(records),
        columns=4,
        calibration=None,
        moving=exported_page(work.path),
        comparison=None,
        tracking=None,
        extraction=[],
        tracked=[],
        scales=[],
        films=[film],
        pictures_note="The garment on the body, from the front and from behind.",
        frames=[
            {
                "frame_id": records[row]["frame_id"],
                "verdict": Badge(records[row]["verdict"]),
                "caption": "; ".join(records[row]["reasons"]),
                "panels": panels,
            }
            for row, panels in sorted(pictures.items())
        ],
        metrics=metrics_table(summary, ANIMATION_METRICS),
        run=[
            ("Model", stage["sources"]["model"]),
            ("Motion", stage["sources"]["poses"]),
            ("Animated", f"{stage.get('started', '')} to {stage.get('finished', '')}"),
            ("Digest", str(stage.get("digest", ""))[:16]),
            ("Versions", ", ".join(f"{name} {version(name)}" for name in ("capture4d", "numpy", "torch"))),
            ("Machine", f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"),
        ],
        settings=list(flat(stage["config"])),
    )


def _charts(records: Sequence[Mapping[str, Any]]) -> Sequence[Chart]:
    frames = [int(record["frame_id"]) for record in records]
    inside = (("before", "inside_before_percent", GREY), ("after", "inside_body_percent", BLUE))
    distance = (("pose", "pose_distance_deg", ORANGE), ("limit", "unlike_deg", GREY))
    wanted = (
        ("Inside the body, % of the vertices", inside),
        ("Distance to the nearest learned pose, deg", distance),
        ("How far the rest was moved, mm", (("mean", "removal_moved_mm", GREEN),)),
        ("Stretch of edges", (("99 %", "stretch_p99", BLUE),)),
    )
    charts = []
    for title, curves in wanted:
        lines = [Line(name, column(records, key), tint) for name, key, tint in curves]
        charts.append(Chart(title, joined_chart(frames, lines)))
    return charts


def _shape(beta: Float32[np.ndarray, " betas"]) -> str:
    """The first coefficients of a person, in words."""
    return f"shape {', '.join(f'{value:.2g}' for value in beta[:4])}" if beta.any() else "mean shape"
