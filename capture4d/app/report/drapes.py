"""A set of drapes to look at: what pruning costs, where cloth is stretched or crushed, and where it cuts itself.

References: the plots of joint angles before and after pruning, of area distortion and of self-intersections by face are
those of Jin et al., A Pixel-Based Framework for Data-Driven Clothing (SCA 2020), appendix.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from capture4d.app.drawing.charts import Line, line_chart
from capture4d.app.drawing.page import Chart, Column, Table, Tile, render_page
from capture4d.app.drawing.palette import BLUE, GREY, HEIGHT, WIDTH
from capture4d.app.drawing.panels import Panel, data_uri
from capture4d.app.drawing.render import Direction, Drawn, frame_view, heat_colours, render
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import read_json, write_bytes
from capture4d.files.records import load_garment
from capture4d.geometry.mesh import face_areas
from capture4d.types import Garment, Mesh

__all__ = ["DrapeSet", "angle_charts", "by_face", "read_set", "write_page"]

AXES = ("bend", "side", "turn")
"""What a joint's angles about the world's x, z and y axes are called; poses are drawn in this order."""
BINS = 12
AREA_SCALE, CUT_SCALE = 0.4, 0.08
"""Where the colours of area distortion and of self-intersections end, as in the paper's figures."""
SMALLER, NEITHER, LARGER = np.array([[47, 98, 201], [244, 240, 232], [201, 82, 32]], float)
VIEWS: tuple[Direction, ...] = ("front", "back")


@dataclass(frozen=True, slots=True, eq=False)
class DrapeSet:
    """What the files of a set hold. N drapes, V vertices, F faces."""

    about: Mapping[str, Any]
    """drapes.json."""
    garment: Garment
    rotations: np.ndarray
    """(N, J, 3, 3)."""
    vertices: np.ndarray
    """(N, V, 3)."""
    kept: np.ndarray
    """(N,) bool."""
    quality: Mapping[str, np.ndarray]
    """(N,) of each measure."""
    reasons: Sequence[str]
    cuts: np.ndarray
    """(N, F) bool: faces that cut another."""


def read_set(folder: Path) -> DrapeSet:
    """Read a finished set.

    Raises:
        InputError: a file is missing or damaged; names it.
    """
    about, garment = read_json(folder / "drapes.json"), load_garment(folder / "garment.npz")
    columns: dict[str, list[np.ndarray]] = {}
    for path in sorted((folder / "shards").glob("*.npz")):
        with ArrayFile(path) as arrays:
            for name in ("rotations", "vertices", "kept", "quality", "reasons", "cuts"):
                columns.setdefault(name, []).append(arrays[name])
    whole = {name: np.concatenate(parts) for name, parts in columns.items()}
    return DrapeSet(
        about,
        garment,
        whole["rotations"],
        whole["vertices"],
        whole["kept"],
        dict(zip(about["quality"], whole["quality"].T, strict=True)),
        whole["reasons"].tolist(),
        np.unpackbits(whole["cuts"], axis=1, count=len(garment.template.faces)).astype(bool),
    )


def write_page(folder: Path) -> Path:
    """Write report.html into the folder of a set; its path."""
    page = folder / "report.html"
    write_bytes(page, _page(read_set(folder)).encode())
    return page


def _page(drapes: DrapeSet) -> str:
    about = drapes.about
    style = ", ".join(f"{name} {value:g}" for name, value in about["style"].items())
    distortion, cut = by_face(drapes)
    mesh = drapes.garment.template
    return render_page(
        "capture4d.app.report",
        "drapes.html.jinja",
        title=f"Drapes of {'' if about['garment'] == 'trousers' else 'a '}{about['garment']}",
        subtitle=f"{len(drapes.kept):,} poses, {len(mesh.vertices):,} vertices; {style}",
        tiles=_tiles(drapes),
        pruned=_pruned(drapes),
        charts=angle_charts(drapes),
        areas=_pictures(mesh, _signed_colours(distortion / AREA_SCALE)),
        cuts=_pictures(mesh, heat_colours(cut, high=CUT_SCALE)),
    )


def _tiles(drapes: DrapeSet) -> list[Tile]:
    kept = 100 * float(drapes.kept.mean())
    quality = drapes.quality
    return [
        Tile(f"{kept:.0f}", "%", "of the drapes are kept"),
        Tile(f"{np.median(quality['stretch_p99']):.2f}", "", "edge over its length, 99 %, median"),
        Tile(f"{np.mean(quality['inside_percent']):.2f}", "%", "of the vertices are inside the body"),
        Tile(f"{np.median(quality['cut_percent']):.1f}", "%", "of the faces cut others, median"),
        Tile(f"{np.mean(quality['frames']):.0f}", "frames", "of 1/60 s until at rest"),
    ]


def _pruned(drapes: DrapeSet) -> Table:
    """How many drapes each rule prunes; one may break several."""
    rules = {"area": "area", "stretched": "stretch", "inside the body": "inside the body",
             "cut others": "cuts itself", "not at rest": "not at rest"}  # fmt: skip
    counts = Counter(rule for reason in drapes.reasons for sign, rule in rules.items() if sign in reason)
    rows = [[rule, str(counts[rule]), f"{100 * counts[rule] / len(drapes.kept):.1f}"] for rule in rules.values()]
    return Table([Column("rule"), Column("drapes", number=True), Column("%", number=True)], rows)


def angle_charts(drapes: DrapeSet) -> list[Chart]:
    """Histograms of the angles of every joint that poses turn, of all that were draped and of those that are kept."""
    names = list(drapes.about["joint_names"])
    charts = []
    for joint in drapes.about["moved_joints"]:
        angles = Rotation.from_matrix(drapes.rotations[:, names.index(joint)]).as_euler("xzy", degrees=True)
        for axis, values in zip(AXES, angles.T, strict=True):
            if np.ptp(values) < 1:
                continue
            edges = np.linspace(np.floor(values.min()), np.ceil(values.max()), BINS + 1)
            centres = np.round((edges[1:] + edges[:-1]) / 2).astype(int).tolist()
            lines = [
                Line(name, 100 * np.histogram(chosen, edges)[0] / max(len(chosen), 1), colour)
                for name, chosen, colour in (("all, %", values, GREY), ("kept, %", values[drapes.kept], BLUE))
            ]
            charts.append(Chart(f"{joint}, {axis}, degrees", line_chart(centres, lines)))
    return charts


def by_face(drapes: DrapeSet) -> tuple[np.ndarray, np.ndarray]:
    """Of the kept drapes, (F,) mean of a face's area over that on the pattern, less 1, and (F,) share in which it cuts
    another; NaN if none is kept."""
    mesh = drapes.garment.template
    assert mesh.uv is not None
    kept = np.flatnonzero(drapes.kept)
    if not len(kept):
        nothing = np.full(len(mesh.faces), np.nan)
        return nothing, nothing
    first, second = mesh.uv[:, 1] - mesh.uv[:, 0], mesh.uv[:, 2] - mesh.uv[:, 0]
    rest = 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    total = np.zeros(len(mesh.faces))
    for row in kept:
        total += face_areas(drapes.vertices[row].astype(np.float64), mesh.faces)
    return total / len(kept) / rest - 1, drapes.cuts[kept].mean(axis=0)


def _signed_colours(values: np.ndarray) -> np.ndarray:
    """(N, 3) blue at -1, pale at 0, orange at 1."""
    values = np.clip(np.nan_to_num(values), -1, 1)[:, None]
    towards = np.where(values < 0, SMALLER, LARGER)
    return (NEITHER + np.abs(values) * (towards - NEITHER) + 0.5).astype(np.uint8)


def _pictures(mesh: Mesh, colours: np.ndarray) -> list[Panel]:
    """The garment as it was put on, from front and back, each face in its own colour, (F, 3)."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    apart = Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))
    panels = []
    for direction in VIEWS:
        view = frame_view(corners.min(axis=0), corners.max(axis=0), direction, aspect=WIDTH / HEIGHT)
        picture = render([Drawn(apart, np.repeat(colours, 3, axis=0))], view, width=WIDTH, height=HEIGHT)
        panels.append(Panel(direction, data_uri(picture)))
    return panels
