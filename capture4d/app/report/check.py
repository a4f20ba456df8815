"""The verdict of `capture4d check`: a status, JSON for machines, a table for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from capture4d.preflight.check import Checked
from capture4d.preflight.findings import Verdict

__all__ = ["as_json", "print_table", "status"]

LEARNED = (
    "No garment_colour is given: extract and track will learn the colours from the scans. "
    "Garment and borders are not looked at here without --garment-colour and --border-colour."
)


SHOWN = 5
"""Files that no stage takes are counted, and so many of them named."""

Status = Literal["clean", "warnings", "errors"]


def status(verdict: Verdict) -> Status:
    """The worst that was found."""
    if not verdict.findings:
        return "clean"
    return "errors" if any(finding.severity == "error" for finding in verdict.findings) else "warnings"


def as_json(checked: Checked) -> dict[str, Any]:
    """The verdict for machines; docs/reference/findings.md describes it."""
    return {
        "format": 1,
        "capture": str(checked.take.path),
        "status": status(checked.verdict),
        "frames": len(checked.take.files),
        "frames_checked": checked.frames,
        "colours": "learned" if _learns(checked) else "given",
        "findings": [
            {
                "code": finding.code,
                "severity": finding.severity,
                "found": finding.found,
                "advice": finding.advice,
                "score": round(finding.score, 3),
                "frames": list(finding.frames),
            }
            for finding in checked.verdict.findings
        ],
        "scores": {code: round(score, 3) for code, score in checked.verdict.scores.items()},
        "unlisted": list(checked.take.facts.unlisted),
        "fixed": None if checked.fixed is None else str(checked.fixed),
    }


def _learns(checked: Checked) -> bool:
    """The take does not say which colour its garment has."""
    return checked.take.facts.paints.garment is None


def print_table(checked: Checked) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    looked = f"{checked.frames} of {len(checked.take.files)} frames"
    if checked.verdict.findings:
        table = Table("", "finding", "what was found", "what to do", title=f"{checked.take.path} ({looked} looked at)")
        for finding in checked.verdict.findings:
            frames = f"\nframes {_ranges(finding.frames)}" if finding.frames else ""
            table.add_row(finding.severity, finding.code, finding.found + frames, finding.advice)
        console.print(table)
    else:
        console.print(f"{checked.take.path}: clean ({looked} looked at)", highlight=False, soft_wrap=True)
    unlisted = checked.take.facts.unlisted
    if unlisted:
        shown = ", ".join(unlisted[:SHOWN]) + (", ..." if len(unlisted) > SHOWN else "")
        line = f"Beside the frames, taken by no stage: {len(unlisted)} files, {shown}"
        console.print(line, highlight=False, soft_wrap=True, markup=False)
    if _learns(checked):
        console.print(LEARNED, highlight=False, soft_wrap=True)


def _ranges(numbers: Sequence[int], most: int = 6) -> str:
    """'3-5, 9, ...'"""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    shown = [str(a) if a == b else f"{a}-{b}" for a, b in runs[:most]]
    return ", ".join(shown + ["..."] * (len(runs) > most))
