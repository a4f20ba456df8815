"""What the report says about other stages: calibration of the rig, tracking, extraction, the comparison of surfaces.

Each section is a value for the page's template, or None where the stage was not run.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from capture4d.app.drawing.charts import Line, line_chart
from capture4d.app.drawing.page import Chart, Tile
from capture4d.app.drawing.palette import BLUE, BODY, GREEN, GREY, HEIGHT, ORANGE, WIDTH
from capture4d.app.drawing.panels import VIEWS, Framing, Panel, data_uri, no_scan, read_panel, readable_scan
from capture4d.app.drawing.render import Drawn, render
from capture4d.app.report.calibration import calibration_charts, calibration_tiles
from capture4d.app.report.metrics import column, shown
from capture4d.body.skinning import ShapedBody, pose_frame, with_shape
from capture4d.captures.capture import Capture
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.take_colours import COLOURS, KnownColours, read_colours, take_colours
from capture4d.captures.work_folder import WorkFolder, load_tracking
from capture4d.colours.labels import classify_colours, settle_labels
from capture4d.colours.printed_cloth import label_print
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import read_json, read_json_lines
from capture4d.files.records import load_poses
from capture4d.runs.workers import run_jobs
from capture4d.types import Mesh, PoseSequence, RegisteredSequence

__all__ = [
    "Calibration",
    "Comparison",
    "Section",
    "StagePictures",
    "Tracking",
    "calibration",
    "comparison",
    "comparison_digest",
    "draw_stages",
    "tracking",
]

LABELS = np.array([(196, 192, 186), (84, 132, 214), (250, 206, 60)], np.uint8)
"""Colours of what was cut apart: body, garment, paint."""
LOOPS = ((214, 62, 62), (46, 150, 84), (150, 70, 190), (20, 150, 180), (230, 120, 20), (120, 90, 60))
POINT_M = 0.006


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """Figures and curves of a part of the page."""

    tiles: Sequence[Tile]
    charts: Sequence[Chart]


# --- calibration -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """The rig, and how well it is known if it was calibrated here."""

    section: Section
    note: str


def calibration(capture: Capture, work: Path) -> Calibration | None:
    """The rig of the capture, with the calibration.json beside it, in the work folder or in its rig/."""
    found = [path for folder in (capture.path, work, work / "rig") if (path := folder / "calibration.json").is_file()]
    if found:
        report = read_json(found[0])
        counts = f"{len(report['cameras'])} cameras, {len(report['poses'])} poses, {report['corners']:,} corners"
        section = Section(calibration_tiles(report), calibration_charts(report))
        page = found[0].with_name("calibration.html")
        return Calibration(section, f"{counts}; {report['board']}. Everything is in {page}.")
    rig = capture.rig
    if rig is None:
        return None
    away = np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1)
    sizes = sorted({(int(width), int(height)) for width, height in rig.image_sizes})
    tiles = [
        Tile(f"{len(rig.names)}", "", "cameras"),
        Tile(" ".join(f"{width}x{height}" for width, height in sizes[:2]), "px", "images"),
        Tile(f"{away.min():.2f} to {away.max():.2f}", "m", "from the middle of the rig"),
    ]
    note = "From rig.json; how certain it is, nothing here says. capture4d calibrate writes calibration.json beside it."
    return Calibration(Section(tiles, []), note)


# --- comparison --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Surfaces on the same held-out frames, as `capture4d compare` left them."""

    frames: int
    against_truth: bool
    rows: Sequence[Mapping[str, Any]]
    pictures: Sequence[tuple[int, Sequence[Panel]]]
    people: Sequence[Panel]
    people_frame: int
    conclusion: str


def comparison(work: Path) -> Comparison | None:
    """What WORK/compare holds, if it is finished."""
    folder = work / "compare"
    if comparison_digest(work) is None:
        return None
    found = read_json(folder / "compare.json")

    def panels(group: Mapping[str, Any]) -> list[Panel]:
        return [read_panel(folder / "pictures" / each["file"], each["title"]) for each in group["panels"]]

    return Comparison(
        len(found["frames"]),
        found["against_truth"],
        [{"learned": False} | row for row in found["methods"]],  # earlier versions did not say
        [(frame["frame_id"], panels(frame)) for frame in found["pictures"]],
        panels(found["people"]),
        found["people"]["frame_id"],
        found.get("conclusion", ""),  # which earlier versions did not draw
    )


def comparison_digest(work: Path) -> str | None:
    """Of a finished WORK/compare."""
    path = work / "compare" / "stage.json"
    record = read_json(path) if path.is_file() else {}
    return record["digest"] if record.get("status") == "complete" else None


# --- tracking ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Tracking:
    """The tracked body: measures by frame, and of the take."""

    section: Section
    records: Sequence[Mapping[str, Any]]
    metrics: Mapping[str, float | None]
    unseen: Sequence[tuple[str, int]]
    """Limbs that were not scanned, and in how many frames; most often first."""


def tracking(capture: Capture, work: Path) -> Tracking | None:
    """What tracking says about its frames, beside the truth if the capture has it."""
    folder = work / "body"
    if not (folder / "metrics.jsonl").is_file():
        return None
    records = read_json_lines(folder / "metrics.jsonl")
    truth = capture.path / "truth" / "poses.npz"
    if truth.is_file():
        _measure_joints(folder, load_poses(truth), records)
    for record in records:
        record["median_mm"] = None if record["median_m"] is None else 1e3 * record["median_m"]
        record["explained_percent"] = 100 * record["explained"]
    good = sum(record["verdict"] == "good" for record in records)
    metrics: dict[str, float | None] = {
        "track_good_percent": 100 * good / len(records),
        "track_median_mm": _mean(column(records, "median_mm")),
        "track_cpu_s": float(np.median(column(records, "cpu_s"))),
    }
    if any("joint_mean_mm" in record for record in records):
        metrics["joint_mean_mm"] = _mean(column(records, "joint_mean_mm"))
        metrics["joint_max_mm"] = _mean(column(records, "joint_max_mm"))
    names = {
        "track_good_percent": ("%", "frames are good"),
        "track_median_mm": ("mm", "skin and suit to the body, median"),
        "joint_mean_mm": ("mm", "joints to their true places"),
        "track_cpu_s": ("s", "CPU a frame, median"),
    }
    tiles = [Tile(shown(metrics[key]), unit, name) for key, (unit, name) in names.items() if key in metrics]
    unseen = Counter(limb for record in records for limb in record["unseen"]).most_common()
    return Tracking(Section(tiles, list(_tracking_charts(records))), records, metrics, unseen)


def _measure_joints(folder: Path, truth: PoseSequence, records: Sequence[dict[str, Any]]) -> None:
    """Add how far the joints that were seen are from where they were, to the frames of which the truth is known."""
    body, found = load_tracking(folder)
    if truth.joint_names != found.joint_names:
        return
    rows = {int(frame_id): row for row, frame_id in enumerate(truth.frame_ids)}
    here, there = with_shape(body, found.shape), with_shape(body, truth.shape)
    for row, record in enumerate(records):
        true_row = rows.get(int(record["frame_id"]))
        if true_row is None:
            continue
        with ArrayFile(folder / "refined" / f"{record['frame_id']:06d}.npz") as arrays:
            seen = arrays["seen"]
        if not seen.any():
            continue
        apart = pose_frame(here, found, row).joint_centres() - pose_frame(there, truth, true_row).joint_centres()
        errors = 1e3 * np.linalg.norm(apart, axis=1)[seen]
        record["joint_mean_mm"], record["joint_max_mm"] = float(errors.mean()), float(errors.max())


def _tracking_charts(records: Sequence[Mapping[str, Any]]) -> Sequence[Chart]:
    frames = [int(record["frame_id"]) for record in records]
    wanted = (
        ("Skin and suit to the body, mm", (("median", "median_mm", BLUE),)),
        ("Skin and suit that the body explains, %", (("explained", "explained_percent", GREEN),)),
        ("Joints to their true places, mm", (("mean", "joint_mean_mm", ORANGE), ("worst", "joint_max_mm", GREY))),
        ("CPU time a frame, s", (("tracking", "cpu_s", BLUE),)),
    )
    charts = []
    for title, curves in wanted:
        lines = [Line(name, column(records, key), colour) for name, key, colour in curves]
        if any(np.isfinite(line.values).any() for line in lines):
            charts.append(Chart(title, line_chart(frames, lines)))
    return charts


# --- pictures ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class StagePictures:
    """Panels of one frame."""

    row: int
    extraction: Sequence[Panel]
    tracking: Sequence[Panel]


def draw_stages(work: WorkFolder, capture: Capture, rows: Sequence[int], *, workers: int) -> list[StagePictures]:
    """What was cut out and what was tracked, in the frames at these positions."""
    loops = {int(row): _loop_places(work.registered, row) for row in rows}
    extraction = work.path / "garment" / COLOURS
    colours = read_colours(extraction) if extraction.is_file() else take_colours(capture)
    prepare = partial(_Drawing.open, work.path, capture, colours, loops)
    found = run_jobs(_draw_row, list(rows), prepare=prepare, workers=workers, label="draw stages")
    return sorted(found, key=lambda each: each.row)


@dataclass(frozen=True, slots=True, eq=False)
class _Drawing:
    """What all frames are drawn with."""

    work: Path
    capture: Capture
    colours: KnownColours
    loops: Mapping[int, list[np.ndarray]]
    """Places of the registered template's border loops, by row."""
    tracked: tuple[ShapedBody, PoseSequence] | None

    @staticmethod
    def open(work: Path, capture: Capture, colours: KnownColours, loops: Mapping[int, list[np.ndarray]]) -> _Drawing:
        tracked = None
        if (work / "body" / "poses.npz").is_file():
            body, poses = load_tracking(work / "body")
            tracked = with_shape(body, poses.shape), poses
        return _Drawing(work, capture, colours, loops, tracked)

    def tracked_body(self, frame_id: int) -> Mesh | None:
        if self.tracked is None:
            return None
        shaped, poses = self.tracked
        posed = pose_frame(shaped, poses, poses.row(frame_id))
        return shaped.body.template.with_vertices(posed.vertices().astype(np.float32))


def _loop_places(registered: RegisteredSequence, row: int) -> list[np.ndarray]:
    return [np.array(registered.vertices[row][loop]) for loop in registered.garment.loops.values()]


def _draw_row(drawing: _Drawing, row: int) -> StagePictures:
    capture, colours = drawing.capture, drawing.colours
    frame_id = capture.frame_ids[row]
    scan = readable_scan(capture, frame_id)
    if scan is None:
        return StagePictures(row, [no_scan()], [])
    paints = tuple(dict.fromkeys(colours.boundary.values()))
    found = classify_colours(colours.flat(scan).colours, colours.garment, paints, others=colours.others)
    labels = settle_labels(scan.mesh.faces, found)
    if colours.printed:
        labels = label_print(scan.mesh.faces, labels)
    painted = LABELS[np.minimum(labels, 2)]
    cloth = scan.mesh.vertices[labels > 0] if (labels > 0).any() else scan.mesh.vertices
    garment = drawing.work / "garment" / "frames" / f"{frame_id:06d}.npz"
    borders = _border_dots(garment, frame_id, drawing.loops[row])
    tracked = drawing.tracked_body(frame_id)
    extraction, tracking = [], []
    for direction in VIEWS:
        view = _framing(cloth).view(cloth, direction)
        scanned = render([Drawn(scan.mesh, scan.colours)], view, width=WIDTH, height=HEIGHT)
        cut = render([Drawn(scan.mesh, painted), *borders], view, width=WIDTH, height=HEIGHT)
        extraction += [Panel("scan", data_uri(scanned)), Panel("garment, paint and border points", data_uri(cut))]
        if tracked is not None:
            view = _framing(scan.mesh.vertices).view(scan.mesh.vertices, direction)
            scanned = render([Drawn(scan.mesh, scan.colours)], view, width=WIDTH, height=HEIGHT)
            body = render([Drawn(tracked, BODY)], view, width=WIDTH, height=HEIGHT)
            mixed = (0.45 * scanned + 0.55 * body + 0.5).astype(np.uint8)
            tracking += [Panel("tracked body", data_uri(body)), Panel("in the scan", data_uri(mixed))]
    return StagePictures(row, extraction, tracking)


def _framing(vertices: np.ndarray) -> Framing:
    x, y, z = np.ptp(vertices, axis=0).tolist()
    return Framing((x, y, z))


def _border_dots(path: Path, frame_id: int, loops: Sequence[np.ndarray]) -> list[Drawn]:
    """Border points as small octahedra, in the colour of the loop of the registered template that is nearest."""
    try:
        points = load_garment_scan(path, frame_id).boundary_points
    except InputError:
        return []
    if not len(points):
        return []
    count = max(len(loops), 1)
    distances = [KDTree(loop).query(points)[0] for loop in loops] or [np.zeros(len(points))]
    nearest = np.argmin(distances, axis=0)
    corners = POINT_M * np.vstack([np.eye(3), -np.eye(3)]).astype(np.float32)
    sides = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    drawn = []
    for loop in range(count):
        places = points[nearest == loop].astype(np.float32)
        if len(places):
            faces = np.array(sides, np.int32)[None] + 6 * np.arange(len(places), dtype=np.int32)[:, None, None]
            mesh = Mesh((places[:, None] + corners).reshape(-1, 3), faces.reshape(-1, 3))
            drawn.append(Drawn(mesh, LOOPS[loop % len(LOOPS)]))
    return drawn


def _mean(values: np.ndarray) -> float | None:
    found = values[np.isfinite(values)]
    return float(found.mean()) if len(found) else None
