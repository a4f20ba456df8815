"""The report of a work folder: WORK/report/index.html, self-contained, and WORK/report/metrics.json.

frames.jsonl beside them keeps what is measured here of each frame, against the truth, if there is one.
docs/reference/report.md defines every metric. Those against truth appear where the capture has one.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.app.drawing.film import checks, make_film, rows_around, tiled
from capture4d.app.drawing.page import Film
from capture4d.app.drawing.palette import HEIGHT, WIDTH
from capture4d.app.drawing.panels import VIEWS, Framing, Panel, Scale, draw_frame, readable_scan
from capture4d.app.drawing.render import Drawn, heat_colours, render, trace
from capture4d.app.report.metrics import METRICS, own_measures, summarise, truth_measures
from capture4d.app.report.moving import exported_page, shows_it
from capture4d.app.report.stages import calibration, comparison, comparison_digest, draw_stages, tracking
from capture4d.app.report.take_page import Drawings, Stages, take_page
from capture4d.captures.capture import Capture, read_capture
from capture4d.captures.evaluation import correspondence_errors, material_points
from capture4d.captures.truth import TruthModel, read_truth_model, read_truth_vertices
from capture4d.captures.work_folder import VERDICTS, WorkFolder
from capture4d.errors import InputError
from capture4d.files.atomic import write_bytes, write_json, write_json_lines
from capture4d.runs.made import digest_of
from capture4d.runs.stage import StageResult, complete_record, open_stage, read_record, result_of
from capture4d.runs.workers import run_jobs, shared
from capture4d.settings import Count, Whole, settings

__all__ = ["ReportConfig", "is_current", "run", "shown_from", "spread"]

SCHEMA = 4
FILM_WIDTH = 360
"""Of one of the four pictures in a film, pixels."""
FIT, CORRESPONDENCE = "fit error", "correspondence error"
"""Titles of what is drawn as errors."""


@settings
class ReportConfig:
    """What the report shows."""

    pictures: Count = 6
    """Frames drawn, spread over the take; the worst flagged frame comes on top."""
    film_frames: Whole = 48
    """Consecutive frames in the film at most, around the frame with the most faces that cut others; 0 for no film."""
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
    upstream = shown_from(work.path, opened, registered)
    current = {"schema": SCHEMA, "config": asdict(config), "upstream": upstream}
    if not overwrite and is_current(folder, current) and shows_it(folder, exported_page(work.path)):
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
    drawings = _draw(scene, _drawn_rows(records, config.pictures), workers)
    if config.film_frames:
        drawings = replace(drawings, films=[_film(scene, records, drawings.scales[0], config.film_frames, workers)])
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
    joints = () if tracked is None else tracked.records
    write_json_lines(folder / "frames.jsonl", own_measures(records, work.records, joints))
    page = take_page(work, scene.capture, records, summary, drawings, stages)
    write_bytes(folder / "index.html", page.encode())
    # the report holds times, which differ between equal runs; nothing is made from it
    return stage.finish([], output=folder / "index.html")


def shown_from(work: Path, capture: Capture, registered: Mapping[str, Any]) -> dict[str, str]:
    """Digests of what a report shows, by name.

    Args:
        registered: stage.json of the registration.
    """
    said = [capture.name, capture.entries("fps", "units", "garment_colour", "boundary_colours")]
    compared = comparison_digest(work)
    return {
        "registration": registered["digest"],
        "settings of the registration": digest_of(registered["config"]),
        "capture.json": digest_of(said),
        **({} if compared is None else {"compare": compared}),
    }


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


def _draw(scene: _Scene, rows: list[int], workers: int) -> Drawings:
    registered = scene.work.registered
    errors = [_errors_mm(scene, row) for row in rows]
    titles = [title for title in (FIT, CORRESPONDENCE) if any(title in each for each in errors)]
    scales = [
        Scale.covering(title, np.concatenate([each[title] for each in errors if title in each]), "mm")
        for title in titles
    ]
    x, y, z = np.max([np.ptp(vertices, axis=0) for vertices in registered.vertices], axis=0).tolist()
    jobs = [_DrawJob(row, Framing((x, y, z)), scales) for row in rows]
    drawn = dict(run_jobs(_draw_row, jobs, prepare=shared(scene), workers=workers, label="draw"))
    return Drawings(drawn, scales, [])


def _errors_mm(scene: _Scene, row: int) -> dict[str, np.ndarray]:
    """What is drawn as errors, by title: (V,) millimetres, NaN where there is no scan data."""
    registered, model = scene.work.registered, scene.truth
    errors = {FIT: 1e3 * registered.residual_m[row].astype(float)}
    if model is not None:
        with contextlib.suppress(InputError):  # the frame was flagged when it was measured
            fine = read_truth_vertices(scene.capture, int(registered.frame_ids[row]), model=model)
            places = material_points(fine, model.fine.faces, model.template_faces, model.template_barycentric)
            errors[CORRESPONDENCE] = 1e3 * correspondence_errors(np.asarray(registered.vertices[row]), places)
    return errors


@dataclass(frozen=True, slots=True, eq=False)
class _DrawJob:
    row: int
    framing: Framing
    scales: Sequence[Scale]


def _draw_row(scene: _Scene, job: _DrawJob) -> tuple[int, list[Panel]]:
    row, registered, capture = job.row, scene.work.registered, scene.capture
    errors = _errors_mm(scene, row)
    return row, draw_frame(
        readable_scan(capture, int(registered.frame_ids[row])),
        registered.garment,
        np.array(registered.vertices[row]),
        job.framing,
        errors_mm={scale.title: (errors[scale.title], scale) for scale in job.scales if scale.title in errors},
        border_colours=capture.boundary_colours,
    )


def _film(scene: _Scene, records: Sequence[Mapping[str, Any]], scale: Scale, count: int, workers: int) -> Film:
    """Consecutive frames: scan, registration under checks that stay with the cloth, and its fit."""
    registered, capture = scene.work.registered, scene.capture
    worst = max(range(len(records)), key=lambda row: records[row].get("self_intersections") or 0)
    rows = rows_around(len(records), count, worst)
    x, y, z = np.max([np.ptp(registered.vertices[row], axis=0) for row in rows], axis=0).tolist()
    jobs = [_DrawJob(row, Framing((x, y, z)), [scale]) for row in rows]
    drawn = dict(run_jobs(_film_row, jobs, prepare=shared(scene), workers=workers, label="film"))
    ids = [int(records[row]["frame_id"]) for row in rows]
    step = (ids[-1] - ids[0]) / max(len(ids) - 1, 1) / capture.fps
    captions = [
        "; ".join([f"Frame {records[row]['frame_id']}, {records[row]['verdict']}", *records[row]["reasons"]])
        for row in rows
    ]
    return make_film(
        f"Frames {ids[0]} to {ids[-1]}, one by one",
        [drawn[row] for row in rows],
        captions,
        seconds=step,
        note="Above: the scan, and the registration under checks that stay with the cloth. Below: the same from "
        f"behind, and the fit error up to {scale.end}. The slider stops at a frame.",
    )


def _film_row(scene: _Scene, job: _DrawJob) -> tuple[int, np.ndarray]:
    row, registered, (scale,) = job.row, scene.work.registered, job.scales
    vertices, template = np.array(registered.vertices[row]), registered.garment.template
    views = [job.framing.view(vertices, direction) for direction in VIEWS]
    width, height = FILM_WIDTH, FILM_WIDTH * HEIGHT // WIDTH
    scan = readable_scan(scene.capture, int(registered.frame_ids[row]))
    drawn = [] if scan is None else [Drawn(scan.mesh, scan.colours)]
    front, back = (trace([template.with_vertices(vertices)], view, width=width, height=height) for view in views)
    scanned = render(drawn, views[0], width=width, height=height)
    heat = heat_colours(1e3 * registered.residual_m[row].astype(float), high=scale.high)
    cloth = checks(template)
    return row, tiled([[scanned, front.painted([cloth])], [back.painted([cloth]), front.painted([heat])]])


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
    """`count` positions among `total`, evenly, from the first to the last."""
    return sorted({round(float(row)) for row in np.linspace(0, total - 1, min(total, count))})


def is_current(folder: Path, current: Mapping[str, Any]) -> bool:
    """Whether the folder holds a finished report that was made from just this."""
    if not all((folder / name).is_file() for name in ("stage.json", "index.html", "metrics.json")):
        return False
    record = read_record(folder / "stage.json")
    return record.get("status") == "complete" and all(record.get(key) == value for key, value in current.items())
