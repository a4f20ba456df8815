"""The status of a work folder as text for a terminal, a pipe or a log."""

from __future__ import annotations

from datetime import datetime

from capture4d.app.differences.table import aligned
from capture4d.app.status.survey import StageStatus, WorkStatus
from capture4d.captures.frame_ranges import frame_ranges
from capture4d.runs.locks import Holder

__all__ = ["duration", "size", "status_lines"]

_MOST_RANGES = 8


def status_lines(found: WorkStatus) -> list[str]:
    """What is done, what is not, why, and what it cost."""
    lines = [f"{found.path}: {found.take}{'' if found.capture is None else f', from {found.capture}'}"]
    lines += [_holder(holder) for holder in found.running]
    head = ("stage", "state", "frames", "wall", "CPU", "disk", "finished")
    lines += ["", *aligned([head, *map(_row, found.stages)], left=(0, 1, 6)), ""]
    for stage in found.stages:
        lines += [f"{stage.name}: {why}" for why in stage.why]
        lines += [
            f"{stage.name}: {verdict}: {frame_ranges(numbers, most=_MOST_RANGES)} ({len(numbers)})"
            for verdict, numbers in stage.flagged.items()
        ]
    lines += found.notes
    return lines if lines[-1] else lines[:-1]


def _holder(holder: Holder) -> str:
    process = "" if holder.process is None else f" (process {holder.process} on {holder.machine or 'this machine'}"
    since = f", since {_moment(holder.since)})" if process else ""
    return f"running: {holder.command or 'another command'}{process}{since}"


def _row(stage: StageStatus) -> tuple[str, ...]:
    frames = "" if stage.done is None else f"{stage.done}/{'?' if stage.frames is None else stage.frames}"
    return (
        stage.name,
        stage.state,
        frames,
        duration(stage.wall_s),
        duration(stage.cpu_s),
        size(stage.bytes),
        _moment(stage.finished) if stage.finished else "",
    )


def duration(seconds: float | None) -> str:
    """Seconds, minutes or hours, as few digits as tell; a dash where nothing is known."""
    if seconds is None:
        return "–"
    if seconds < 60:
        return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, hours = seconds / 60, seconds / 3600
    return f"{minutes:.0f} min" if minutes < 100 else f"{hours:.1f} h" if hours < 10 else f"{hours:.0f} h"


def size(count: float) -> str:
    """Bytes in the unit that fits."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" or count >= 10 else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def _moment(text: str) -> str:
    """A time of the clock of this place."""
    try:
        return datetime.fromisoformat(text).astimezone().strftime("%Y-%m-%d %H:%M")
    except ValueError:
        return text
