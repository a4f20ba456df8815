"""Line charts as SVG text: no plotting library, no script, sharp at every size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

__all__ = ["Line", "joined_chart", "line_chart", "nice_ticks"]

WIDTH, HEIGHT = 560, 220
LEFT, RIGHT, TOP, BOTTOM = 44, 12, 12, 26


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """One curve of a chart."""

    name: str
    values: np.ndarray
    """One per frame; NaN leaves a gap."""
    colour: str


def line_chart(frames: Sequence[int], lines: Sequence[Line], *, floor: float = 0.0) -> str:
    """An SVG of curves over frame numbers, with a legend.

    Args:
        floor: the vertical axis starts there, or lower if a value does.
    """
    finite = np.concatenate([line.values[np.isfinite(line.values)] for line in lines])
    low = min(floor, float(finite.min())) if len(finite) else floor
    high = float(finite.max()) if len(finite) else floor + 1
    ticks = nice_ticks(low, high if high > low else low + 1)
    low, high = min(low, ticks[0]), max(high, ticks[-1])
    first, last = frames[0], max(frames[-1], frames[0] + 1)

    def x(frame: float) -> float:
        return LEFT + (frame - first) / (last - first) * (WIDTH - LEFT - RIGHT)

    def y(value: float) -> float:
        return HEIGHT - BOTTOM - (value - low) / (high - low) * (HEIGHT - TOP - BOTTOM)

    names = escape(", ".join(line.name for line in lines))
    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{names}">']
    for tick in ticks:
        parts.append(f'<path class="grid" d="M{LEFT} {y(tick):.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text class="tick" x="{LEFT - 6}" y="{y(tick) + 3.5:.1f}" text-anchor="end">{tick:g}</text>')
    parts += [
        f'<text class="tick" x="{x(tick):.1f}" y="{HEIGHT - 8}" text-anchor="middle">{tick:.0f}</text>'
        for tick in nice_ticks(first, last, count=7)
        if tick == int(tick) and first <= tick <= last
    ]
    for line in lines:
        path = _path([x(frame) for frame in frames], [y(value) for value in line.values.tolist()])
        parts.append(f'<path class="curve" d="{path}" stroke="{line.colour}"/>')
    parts.append("</svg>")
    legend = "".join(f'<li><i style="background:{line.colour}"></i>{escape(line.name)}</li>' for line in lines)
    return f'{"".join(parts)}<ul class="legend">{legend}</ul>'


def joined_chart(frames: Sequence[int], lines: Sequence[Line], *, floor: float = 0.0) -> str:
    """The same without the frames that have no value, so that measures taken on every n-th frame join up."""
    kept = np.flatnonzero(np.any([np.isfinite(line.values) for line in lines], axis=0))
    shorter = [Line(line.name, line.values[kept], line.colour) for line in lines]
    return line_chart([frames[row] for row in kept.tolist()], shorter, floor=floor)


def nice_ticks(low: float, high: float, *, count: int = 5) -> list[float]:
    """Round numbers, about `count` of them, of which all but the last lie below `high`."""
    step = 10 ** math.floor(math.log10((high - low) / count))
    step *= next(factor for factor in (1, 2, 5, 10) if factor * step * count >= (high - low) * 0.999)
    start, stop = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(index * step, 12) for index in range(start, stop + 1)]


def _path(xs: Sequence[float], ys: Sequence[float]) -> str:
    """A polyline that is interrupted where y is NaN; a lone point becomes a dot."""
    parts, open_run = [], False
    for index, (x, y) in enumerate(zip(xs, ys, strict=True)):
        if math.isnan(y):
            open_run = False
            continue
        alone = not open_run and (index + 1 == len(ys) or math.isnan(ys[index + 1]))
        parts.append(f"{'L' if open_run else 'M'}{x:.1f} {y:.1f}{'h.1' if alone else ''}")
        open_run = True
    return "".join(parts)
