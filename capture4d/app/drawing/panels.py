"""The pictures of the report: scan, registration and errors of one frame, from two sides."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8
from PIL import Image

from capture4d.app.drawing.palette import CLOTH, HEIGHT, LOOP, WIDTH
from capture4d.app.drawing.render import Direction, Drawn, View, frame_view, heat_colours, render, trace
from capture4d.captures.capture import Capture, read_scan
from capture4d.colours.spaces import Colour
from capture4d.errors import InputError
from capture4d.files.atomic import write_bytes
from capture4d.types import Garment, Scan

__all__ = [
    "NO_SCAN",
    "VIEWS",
    "WEBP",
    "Framing",
    "Panel",
    "Scale",
    "colour_bar",
    "data_uri",
    "draw_frame",
    "no_scan",
    "read_panel",
    "readable_scan",
    "round_up",
    "write_panel",
]

VIEWS: tuple[Direction, ...] = ("three_quarter", "back")
WEBP = "data:image/webp;base64,"
NO_SCAN = "no scan"
"""Title of the empty picture of a frame whose scan cannot be read."""


@dataclass(frozen=True, slots=True)
class Framing:
    """A box of one size for all frames, so that pictures can be compared; it follows the garment."""

    size_m: tuple[float, float, float]

    def view(self, vertices: Float32[np.ndarray, "verts 3"], direction: Direction) -> View:
        centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        half = np.array(self.size_m) / 2
        return frame_view(centre - half, centre + half, direction, aspect=WIDTH / HEIGHT)


@dataclass(frozen=True, slots=True)
class Panel:
    """One picture and what it shows."""

    title: str
    uri: str


@dataclass(frozen=True, slots=True)
class Scale:
    """What the colours of errors mean: 0 to `high`, and what is clipped beyond."""

    title: str
    high: float
    unit: str
    clip: str
    """How much of what is drawn lies beyond, in words."""

    @staticmethod
    def covering(title: str, values: Float[np.ndarray, "..."], unit: str) -> Scale:
        """A scale for all of these values but the last per cent; NaN is no value."""
        found = np.asarray(values, float)
        found = found[np.isfinite(found)]
        if not len(found):
            return Scale(title, 1.0, unit, "")
        return Scale.ending(title, round_up(float(np.percentile(found, 99))), found, unit)

    @staticmethod
    def ending(title: str, high: float, values: Float[np.ndarray, "..."], unit: str) -> Scale:
        """A scale from 0 to `high`, of which it is said what of these values it leaves out."""
        found = np.asarray(values, float)
        found = found[np.isfinite(found)]
        beyond = found[found > high]
        clip = f"{100 * len(beyond) / len(found):.2g} % beyond, up to {beyond.max():.3g} {unit}" if len(beyond) else ""
        return Scale(title, high, unit, clip)

    @property
    def end(self) -> str:
        """The number at its end."""
        return f"{self.high:g} {self.unit}"

    @property
    def uri(self) -> str:
        """A strip of its colours."""
        return colour_bar(self.high)


def round_up(value: float) -> float:
    """The next of 1, 2 and 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-3)))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= value * 0.999)


def readable_scan(capture: Capture, frame_id: int) -> Scan | None:
    """The scan of a frame; None if it cannot be read, which is no news: extraction has flagged the frame."""
    try:
        return read_scan(capture, frame_id)
    except InputError:
        return None


def no_scan() -> Panel:
    """What stands for the picture of a scan that cannot be read."""
    return Panel(NO_SCAN, data_uri(np.full((HEIGHT, WIDTH, 3), 236, np.uint8)))


def draw_frame(
    scan: Scan | None,
    garment: Garment,
    vertices: Float32[np.ndarray, "verts 3"],
    framing: Framing,
    *,
    errors_mm: Mapping[str, tuple[np.ndarray, Scale]],
    border_colours: Mapping[str, Colour],
) -> list[Panel]:
    """Pictures of one frame: from each of VIEWS the scan, the registration, and its errors.

    Args:
        scan: None if it cannot be read.
        errors_mm: per-vertex errors by title, each with its colours.
        border_colours: paint of the loops; loops without are drawn orange.
    """
    mesh = garment.template.with_vertices(vertices)
    paints = {"registration": _cloth(garment, border_colours)}
    paints |= {title: heat_colours(values, high=scale.high) for title, (values, scale) in errors_mm.items()}
    drawn = []
    for direction in VIEWS:
        view = framing.view(vertices, direction)
        scanned = no_scan()
        if scan is not None:
            picture = render([Drawn(scan.mesh, scan.colours)], view, width=WIDTH, height=HEIGHT)
            scanned = Panel("scan", data_uri(picture))
        traced = trace([mesh], view, width=WIDTH, height=HEIGHT)
        drawn += [scanned, *(Panel(title, data_uri(traced.painted([colours]))) for title, colours in paints.items())]
    return drawn


def colour_bar(high: float) -> str:
    """A horizontal strip of the heat map's colours from 0 to `high`, as a data URI."""
    return data_uri(np.tile(heat_colours(np.linspace(0, high, 128), high=high), (4, 1, 1)))


def data_uri(picture: UInt8[np.ndarray, "height width 3"]) -> str:
    """A picture inside the page."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "WEBP", quality=84, method=4)
    return WEBP + base64.b64encode(buffer.getvalue()).decode()


def write_panel(path: Path, panel: Panel) -> None:
    """Keep a panel's picture as a file."""
    write_bytes(path, base64.b64decode(panel.uri.removeprefix(WEBP)))


def read_panel(path: Path, title: str) -> Panel:
    """What `write_panel` wrote."""
    return Panel(title, WEBP + base64.b64encode(path.read_bytes()).decode())


def _cloth(garment: Garment, border_colours: Mapping[str, Colour]) -> np.ndarray:
    colours = np.tile(np.array(CLOTH, np.uint8), (len(garment.template.vertices), 1))
    for name, loop in garment.loops.items():
        colours[loop] = border_colours.get(name, LOOP)
    return colours
