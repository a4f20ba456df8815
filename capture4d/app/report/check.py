"""The verdict of `capture4d check`: a status, JSON for machines, a table and a page for people."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from capture4d.app.drawing.page import Badge, Column, Table, render_page
from capture4d.files.atomic import write_bytes
from capture4d.preflight.check import Checked
from capture4d.preflight.findings import Verdict
from capture4d.runs.frame_lists import frame_ranges

__all__ = ["as_json", "print_table", "status", "write_page"]

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


def write_page(path: Path, checked: Checked) -> Path:
    """Write the verdict as a self-contained HTML page; its path."""
    columns = [Column("severity"), Column("finding"), Column("frames"), Column("what was found"), Column("what to do")]
    rows = [
        [Badge(each.severity), each.code, frame_ranges(each.frames), each.found, each.advice]
        for each in checked.verdict.findings
    ]
    scores = sorted(checked.verdict.scores.items(), key=lambda item: -item[1])
    page = render_page(
        "capture4d.app.report",
        "check.html.jinja",
        title=checked.take.path.resolve().name,
        subtitle=str(checked.take.path),
        status=Badge(status(checked.verdict)),
        looked=f"{checked.frames} of {len(checked.take.files)} frames looked at",
        notes=[LEARNED] if _learns(checked) else [],
        findings=Table(columns, rows, stacks=True),
        scores=Table(
            [Column("finding"), Column("measured over limit", number=True)],
            [[code, f"{score:.2f}"] for code, score in scores],
        ),
    )
    write_bytes(path, page.encode())
    return path


def _learns(checked: Checked) -> bool:
    """The take does not say which colour its garment has."""
    return checked.take.facts.paints.garment is None


def _counted(verdict: Verdict) -> str:
    """Such as "2 errors, 1 warning"."""
    grades = [finding.severity for finding in verdict.findings]
    counts = {grade: grades.count(grade) for grade in ("error", "warning")}
    return ", ".join(f"{count} {grade}{'s' if count > 1 else ''}" for grade, count in counts.items() if count)


def print_table(checked: Checked) -> None:
    from rich.console import Console
    from rich.table import Table as TerminalTable

    console = Console()
    looked = f"{checked.frames} of {len(checked.take.files)} frames"
    if checked.verdict.findings:
        table = TerminalTable(
            "", "finding", "what was found", "what to do", title=f"{checked.take.path} ({looked} looked at)"
        )
        for finding in checked.verdict.findings:
            frames = f"\nframes {frame_ranges(finding.frames, most=6)}" if finding.frames else ""
            table.add_row(finding.severity, finding.code, finding.found + frames, finding.advice)
        console.print(table)
        console.print(f"check: {looked} looked at; {_counted(checked.verdict)}", highlight=False, soft_wrap=True)
    else:
        console.print(f"{checked.take.path}: clean ({looked} looked at)", highlight=False, soft_wrap=True)
    unlisted = checked.take.facts.unlisted
    if unlisted:
        shown = ", ".join(unlisted[:SHOWN]) + (", ..." if len(unlisted) > SHOWN else "")
        line = f"Beside the frames, taken by no stage: {len(unlisted)} files, {shown}"
        console.print(line, highlight=False, soft_wrap=True, markup=False)
    if _learns(checked):
        console.print(LEARNED, highlight=False, soft_wrap=True)
