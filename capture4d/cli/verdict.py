"""How a command says what came of its frames: how many are good, what fits how well, and where to look."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from capture4d.runs.frame_lists import frame_ranges

__all__ = ["MOST_RANGES", "flagged_line", "say_flagged", "say_verdict", "say_work", "verdict_line"]

MOST_RANGES = 12
"""Of frames that are named on the screen; the page and metrics.jsonl name all."""
FIGURES: Mapping[str, tuple[str, str]] = {
    "fit_mean_mm": ("fit", "mm"),
    "boundary_mean_mm": ("border", "mm"),
    "inside_body_percent": ("inside the body", "%"),
}
"""What is said of a take in a few words, mean over its frames, as in metrics.json."""


def verdict_line(stage: str, records: Sequence[Mapping[str, Any]]) -> str:
    """Such as "register: 33 of 36 frames good, 2 to check, 1 failed; fit 0.21 mm, border 1.13 mm".

    Args:
        records: of its frames, as in metrics.jsonl.
    """
    bad = "lost" if stage == "track" else "failed"
    count = {verdict: sum(record["verdict"] == verdict for record in records) for verdict in ("good", "check", bad)}
    counts = f"{count['good']} of {len(records)} frames good, {count['check']} to check, {count[bad]} {bad}"
    figures = []
    for key, (name, unit) in FIGURES.items():
        found = [value for record in records if (value := record.get(key)) is not None and math.isfinite(value)]
        if found:
            figures.append(f"{name} {sum(found) / len(found):.2f} {unit}")
    return f"{stage}: {counts}{'; ' if figures else ''}{', '.join(figures)}"


def flagged_line(what: str, reasons: Mapping[int, str], *, among: Sequence[int] | None = None) -> str:
    """Such as "to check: 13-14, 20; frame 13: fit_mean_mm 1.30 > 1 mm".

    Args:
        reasons: why, by frame.
        among: all frames of the take.
    """
    first = min(reasons)
    return f"{what}: {frame_ranges(reasons, among=among, most=MOST_RANGES)}; frame {first}: {reasons[first]}"


def say_flagged(what: str, reasons: Mapping[int, str], *, among: Sequence[int] | None = None) -> None:
    """The same on stderr, if there are any."""
    if reasons:
        print(f"capture4d: {flagged_line(what, reasons, among=among)}", file=sys.stderr)


def say_work(work: Path) -> None:
    """What came of the frames of a work folder: of those that were tracked, and of those that were registered."""
    for folder, stage in (("body", "track"), ("registration", "register")):
        say_verdict(work / folder, stage)


def say_verdict(folder: Path, stage: str) -> None:
    """What came of the frames of a stage, and which are worth a look; nothing where it wrote no metrics.jsonl."""
    from capture4d.captures.work_folder import load_records

    if not (folder / "metrics.jsonl").is_file():
        return
    records = load_records(folder)
    print(verdict_line(stage, records))
    doubtful = {each["frame_id"]: "; ".join(each["reasons"]) for each in records if each["verdict"] == "check"}
    if doubtful:
        print(flagged_line("to check", doubtful, among=[each["frame_id"] for each in records]))
