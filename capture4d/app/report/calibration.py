"""A calibration for people to read: a short table on the terminal, and a self-contained HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table as TerminalTable

from capture4d.app.drawing.charts import Line, line_chart
from capture4d.app.drawing.page import Chart, Column, Table, Tile, render_page
from capture4d.app.drawing.palette import BLUE, GREY, ORANGE
from capture4d.calibration.check import CameraCheck
from capture4d.files.atomic import write_bytes

__all__ = [
    "calibration_charts",
    "calibration_page",
    "calibration_tiles",
    "print_calibration",
    "print_check",
    "write_page",
]

_COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("poses", "poses", "d"),
    ("corners", "corners", "d"),
    ("median_px", "median px", ".3f"),
    ("rms_px", "rms px", ".3f"),
    ("coverage_percent", "coverage %", ".0f"),
    ("tilt_most_deg", "tilt to deg", ".0f"),
    ("centre_sigma_mm", "± place mm", ".3f"),
    ("rotation_sigma_deg", "± turn deg", ".4f"),
    ("focal_sigma_px", "± focal px", ".2f"),
)
"""Of a camera: entry in calibration.json, heading, format."""
_HELD_OUT: tuple[tuple[str, str, str], ...] = (
    ("cameras", "cameras", "d"),
    ("median_px", "median px", ".3f"),
    ("rms_px", "rms px", ".3f"),
    ("corner_median_mm", "corners, median mm", ".3f"),
    ("corner_rms_mm", "corners, rms mm", ".3f"),
    ("scale_ppm", "scale, ppm", ".0f"),
)
"""The same of a pose held out; nothing was triangulated where the last three are None."""
_ON_TERMINAL = ("poses", "median_px", "coverage_percent", "centre_sigma_mm", "rotation_sigma_deg")
_MOVEMENT = ("verdict", "score", "shift px", "translation mm", "rotation deg")


def print_calibration(report: Mapping[str, Any]) -> None:
    """The table of cameras, the figures of the whole, and what to film next."""
    columns = [column for column in _COLUMNS if column[0] in _ON_TERMINAL]
    table = TerminalTable("camera", *(heading for _, heading, _ in columns))
    for column in table.columns[1:]:
        column.justify = "right"
    for row in report["cameras"]:
        table.add_row(row["name"], *(format(row[key], shape) for key, _, shape in columns))
    console = Console()
    console.print(table)
    for name, value in _summary(report):
        console.print(f"{name}: {value}", highlight=False)
    for line in report["advice"]:
        console.print(f"- {line}", highlight=False)


def print_check(checks: Sequence[CameraCheck]) -> None:
    """One line a camera; what has moved stands out."""
    table = TerminalTable("camera", *_MOVEMENT)
    for check in checks:
        if check.verdict == "unseen":
            table.add_row(check.name, "unseen", *[""] * 4, style="dim")
            continue
        table.add_row(
            check.name,
            check.verdict,
            f"{check.score:.2f}",
            f"{check.shift_px:.3f}",
            f"{check.translation_mm:.2f} ± {check.translation_sigma_mm:.2f}",
            f"{check.rotation_deg:.4f} ± {check.rotation_sigma_deg:.4f}",
            style="bold red" if check.verdict == "moved" else "",
        )
    Console().print(table)


def write_page(path: Path, report: Mapping[str, Any]) -> Path:
    """Write the page beside the rig; its path."""
    write_bytes(path, calibration_page(report).encode())
    return path


def calibration_page(report: Mapping[str, Any]) -> str:
    """The HTML of a calibration.json."""
    names = [row["name"] for row in report["cameras"]]
    counts = f"{len(names)} cameras, {len(report['poses'])} poses, {report['corners']:,} corners"
    return render_page(
        "capture4d.app.report",
        "calibration.html.jinja",
        title="Rig calibration",
        subtitle=f"{counts}; {report['board']}",
        tiles=calibration_tiles(report),
        advice=report["advice"],
        headings=[heading for _, heading, _ in _COLUMNS],
        cameras=[
            {
                "name": row["name"],
                "values": [format(row[key], shape) for key, _, shape in _COLUMNS],
                "coverage": row["coverage"],
            }
            for row in report["cameras"]
        ],
        charts=calibration_charts(report),
        names=names,
        shared=report["shared_poses"],
        most_shared=max(1, max(max(row) for row in report["shared_poses"])),
        hold_out=_held_out(report["hold_out"]),
        summary=_summary(report),
    )


def _held_out(poses: Sequence[Mapping[str, Any]]) -> Table:
    """How the rig sees poses that it was not calibrated with."""
    columns = [Column("pose"), *(Column(heading, number=True) for _, heading, _ in _HELD_OUT)]
    return Table(columns, [
        [row["name"], *("" if row[key] is None else format(row[key], shape) for key, _, shape in _HELD_OUT)]
        for row in poses
    ])  # fmt: skip


def calibration_tiles(report: Mapping[str, Any]) -> list[Tile]:
    """The figures that matter most."""
    sigmas = [row["centre_sigma_mm"] for row in report["cameras"]]
    tiles = [
        Tile(f"{report['residual_median_px']:.3f}", "px", "residual, median"),
        Tile(f"{np.median(sigmas):.3f}", "mm", "uncertainty of a camera's place, median"),
        Tile(f"{max(sigmas):.3f}", "mm", "the same, worst camera"),
        Tile(f"{min(row['coverage_percent'] for row in report['cameras']):.0f}", "%", "least coverage of an image"),
    ]
    held = [row["corner_rms_mm"] for row in report["hold_out"] if row["corner_rms_mm"] is not None]
    if held:
        tiles.append(Tile(f"{np.median(held):.3f}", "mm", "corners triangulated at poses held out"))
    return tiles


def calibration_charts(report: Mapping[str, Any]) -> list[Chart]:
    """Curves over the poses, by their numbers if that is what they are called."""
    names = [row["name"] for row in report["poses"]]
    numbered = all(name.isdecimal() for name in names)
    poses = [int(name) for name in names] if numbered else list(range(len(names)))
    residuals = [
        Line("median", np.array([row["median_px"] for row in report["poses"]]), BLUE),
        Line("root mean square", np.array([row["rms_px"] for row in report["poses"]]), GREY),
    ]
    charts = [Chart("Residual by pose, px", line_chart(poses, residuals))]
    by_name = {row["name"]: row["corner_rms_mm"] for row in report["volume"]}
    values = [by_name.get(row["name"]) for row in report["poses"]]
    errors = np.array([np.nan if value is None else value for value in values])
    if np.isfinite(errors).any():
        lines = [Line("triangulated corners to the board, root mean square", errors, ORANGE)]
        charts.append(Chart("The board as measured, by pose, mm", line_chart(poses, lines)))
    return charts


def _summary(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [
        ("residual", f"{report['residual_median_px']:.3f} px median, {report['residual_rms_px']:.3f} px rms"),
        ("detector", f"{report['noise_px']:.3f} px standard deviation of a coordinate"),
    ]
    held = [row for row in report["hold_out"] if row["corner_rms_mm"] is not None]
    if held:
        pixels, corners = (float(np.median([row[key] for row in held])) for key in ("median_px", "corner_rms_mm"))
        rows.append(("held out", f"{len(held)} poses, {pixels:.3f} px median, corners within {corners:.3f} mm rms"))
    measured = [row for row in report["volume"] if row["corner_rms_mm"] is not None]
    if measured:
        corners = float(np.median([row["corner_rms_mm"] for row in measured]))
        worst = max(measured, key=lambda row: row["corner_rms_mm"])
        scale = max(abs(row["scale_ppm"]) for row in measured)
        within = (
            f"corners triangulated within {corners:.3f} mm rms, {worst['corner_rms_mm']:.3f} at pose {worst['name']}"
        )
        rows.append(("volume", f"{len(measured)} poses, {within}; scale within {scale:.0f} ppm"))
    if report["flatness"]:
        flat = report["flatness"]
        bent = f"out of plane by {flat['out_of_plane_rms_mm']:.3f} mm rms, {flat['out_of_plane_max_mm']:.3f} at most"
        rows.append(("board", f"{bent}; a free board moves cameras by {flat['centre_change_max_mm']:.3f} mm at most"))
    return rows
