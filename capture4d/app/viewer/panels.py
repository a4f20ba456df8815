"""Texts and curves beside the picture: what is said of a frame, the strip of verdicts, the legend of the colours."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from capture4d.app.drawing.panels import colour_bar
from capture4d.app.drawing.render import BEYOND
from capture4d.app.viewer.figures import FIGURES
from capture4d.app.viewer.presenter import Choice
from capture4d.app.viewer.timeline import OPEN, Timeline, curve, flagged
from capture4d.colours.spaces import format_colour

__all__ = ["VERDICT_COLOURS", "curve_rows", "frame_line", "frame_options", "frames_with", "legend", "verdict_strip"]

VERDICT_COLOURS = {"failed": "#c8383a", "check": "#e0a020", OPEN: "#d6d8dc", "": "#9aa3ad", "good": "#3c9a5f"}
"""The worst first."""
ALL, FLAGGED = "all", "to look at"
SHOWN_FRAMES = 200
"""Frames that a list names at once: browsers do not like longer ones."""
MOST_POINTS = 1000
"""Of a curve that is sent."""
_BINS = 240


def frame_line(names: Sequence[str], timelines: Sequence[Timeline], frame_id: int) -> str:
    """Markdown: frame, verdict and reasons, a line for each take."""
    lines = []
    for name, timeline in zip(names, timelines, strict=True):
        if frame_id not in timeline.frame_ids:
            said = "no such frame"
        else:
            said = timeline.said(frame_id).partition(": ")[2] or "not judged"
        lines.append((f"{name}: " if len(names) > 1 else f"frame {frame_id}: ") + said)
    return "  \n".join(_plain(line) for line in lines)


def _plain(text: str) -> str:
    """Text that Markdown leaves as it is."""
    return "".join(f"\\{sign}" if sign in "\\`*_{}[]<>()#+!|~" else sign for sign in text)


def verdict_strip(timelines: Sequence[Timeline], frame_ids: Sequence[int]) -> str:
    """HTML: a bar of all frames for each take, in the colours of the worst verdict that falls onto each piece."""
    bins = min(_BINS, len(frame_ids))
    worst = [*VERDICT_COLOURS]
    rows = []
    for line, timeline in enumerate(timelines):
        ranks = [len(worst)] * bins
        there = {*timeline.frame_ids}
        for at, frame_id in enumerate(frame_ids):
            if frame_id in there:
                rank = worst.index(verdict) if (verdict := timeline.verdict(frame_id)) in worst else worst.index("")
                place = at * bins // len(frame_ids)
                ranks[place] = min(ranks[place], rank)
        rows += [
            f'<rect x="{at}" y="{10 * line}" width="1.05" height="8" fill="{VERDICT_COLOURS[worst[rank]]}"/>'
            for at, rank in enumerate(ranks)
            if rank < len(worst)
        ]
    height = 10 * len(timelines)
    box = f'viewBox="0 0 {bins} {height}" preserveAspectRatio="none"'
    counts = [f"{len(flagged(each, [verdict]))} {verdict}" for each in timelines[:1] for verdict in ("good", "check",
              "failed", OPEN) if flagged(each, [verdict])]  # fmt: skip
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {box} style="width:100%;height:{height + 2}px">{"".join(rows)}</svg>'
        f'<div style="font-size:12px;color:#555">{html.escape(", ".join(counts))}</div>'
    )


def frames_with(timeline: Timeline, wanted: str) -> list[int]:
    """Frames of a list: ALL, FLAGGED, or a verdict."""
    if wanted == ALL:
        return [*timeline.frame_ids]
    return flagged(timeline, ["check", "failed", "lost"] if wanted == FLAGGED else [wanted])


def frame_options(timeline: Timeline, frames: Sequence[int], near: int) -> list[str]:
    """Lines of a list, such as `12: check; ...`, those around a frame where there are too many."""
    row = int(np.searchsorted(frames, near))
    start = max(0, min(row - SHOWN_FRAMES // 2, len(frames) - SHOWN_FRAMES))
    lines = []
    for frame_id in frames[start : start + SHOWN_FRAMES]:
        said = timeline.said(frame_id)
        lines.append(said if len(said) <= 60 else f"{said[:59]}…")
    return lines


def legend(choice: Choice) -> str:
    """HTML: what the colours stand for; empty where they stand for nothing."""
    figure = FIGURES.get(choice.paint)
    if figure is None:
        return ""
    beyond = format_colour(BEYOND)
    return (
        f'<div style="font-size:12px"><img alt="" src="{colour_bar(1.0)}" style="width:100%;height:10px"><br>'
        f'{figure.low:g} <span style="float:right">{choice.high:g} {html.escape(figure.unit)}</span>'
        f'<div style="text-align:center"><span style="color:{beyond}">■</span> beyond '
        '<span style="color:#a8acb2">■</span> not known</div></div>'
    )


def curve_rows(timelines: Sequence[Timeline], frame_ids: Sequence[int], name: str) -> list[Float64[np.ndarray, " all"]]:
    """Frames, and a measure of each take in them, the largest of several where there are too many for a screen."""
    ids = np.array(frame_ids, np.float64)
    rows = []
    for timeline in timelines:
        known = dict(zip(timeline.frame_ids, curve(timeline, name), strict=True))
        rows.append(np.array([known.get(each, np.nan) for each in frame_ids], np.float64))
    if len(ids) <= MOST_POINTS:
        return [ids, *rows]
    parts = np.array_split(np.arange(len(ids)), MOST_POINTS)
    tops = [np.array([np.nan if np.isnan(row[part]).all() else np.nanmax(row[part]) for part in parts]) for row in rows]
    return [np.array([ids[part[0]] for part in parts]), *tops]
