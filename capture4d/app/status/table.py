"""The status of a work folder, and the plan of a run, as text for a terminal, a pipe or a log."""

from __future__ import annotations

from datetime import datetime

from capture4d.app.differences.table import aligned
from capture4d.app.status.plan import Plan, StagePlan
from capture4d.app.status.survey import StageStatus, WorkStatus
from capture4d.runs.frame_lists import frame_ranges
from capture4d.runs.locks import Holder

__all__ = ["duration", "plan_lines", "size", "status_lines"]

_MOST_RANGES = 8
WOULD = {"do": "be done", "go on": "go on", "renew": "be redone", "nothing": "stay", "refuse": "REFUSE"}


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


def plan_lines(plan: Plan) -> list[str]:
    """What would be done, why, about how long it takes, and what it needs of the disk."""
    head = ("stage", "would", "frames to do", "perhaps", "kept", "CPU", "disk")
    lines = [*aligned([head, *map(_plan_row, plan.stages)], left=(0, 1)), ""]
    lines += [f"{stage.name}: {why}" for stage in plan.stages for why in stage.why]
    if any(stage.is_guess and stage.cpu_most_s for stage in plan.stages):
        lines.append("~ is a guess: nothing was done yet from which it is known")
    if plan.refuses:
        return [*lines, "Nothing was done. This command would refuse."]
    least, most = plan.wall_s
    if not most:
        return [*lines, "Nothing was done, and nothing is to do."]
    span = duration(most) if duration(least) == duration(most) else f"{duration(least)} to {duration(most)}"
    processes = "1 process" if plan.workers == 1 else f"{plan.workers} processes"
    lines.append(
        f"About {span} with {processes}; {size(plan.bytes)} more on the disk, where {size(plan.free_bytes)} are free."
    )
    if plan.bytes > plan.free_bytes:
        lines.append("That is more than is free.")
    return [*lines, "Nothing was done."]


def _plan_row(stage: StagePlan) -> tuple[str, ...]:
    by_frames = (str(stage.to_do), str(stage.perhaps or ""), str(stage.kept)) if stage.frames else ("", "", "")
    spans = dict.fromkeys(duration(seconds) for seconds in (stage.cpu_s, stage.cpu_most_s))
    guess = "~" if stage.is_guess else ""
    cpu = f"{guess}{' to '.join(spans)}" if stage.cpu_most_s else ""
    return stage.name, WOULD[stage.state], *by_frames, cpu, size(stage.bytes) if stage.bytes else ""
