"""Flagged frames as people read them: one row for all frames that are flagged for the same reasons."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from capture4d.app.drawing.page import Badge, Column, Table
from capture4d.app.report.metrics import shown
from capture4d.runs.frame_lists import frame_ranges

__all__ = ["FLAGGED_NOTE", "flagged_table", "verdict_counts", "verdict_runs"]

FLAGGED_NOTE = "Frames with the same reasons share a row; its figures are those of the worst of them."
DETAIL = re.compile(r", and in \d+ more|\b(left|right) |\d+(\.\d+)?(e[+-]?\d+)?")
"""What differs between reasons of one kind: how much, on which side, how often."""
WORST_FIRST = ("failed", "lost", "check")


def flagged_table(
    records: Sequence[Mapping[str, Any]], *, measures: Sequence[tuple[str, str]] = (), worst_by: str | None = None
) -> Table:
    """One row for each combination of verdict and reasons, the worst verdict and the most frames first.

    Args:
        measures: heading and key of further columns.
        worst_by: the measure by which a row's worst frame is chosen; the first of them if None.
    """
    every = [int(record["frame_id"]) for record in records]
    groups: dict[tuple[str, tuple[str, ...]], list[Mapping[str, Any]]] = {}
    for record in records:
        if record["verdict"] != "good":
            kinds = tuple(DETAIL.sub("", reason) for reason in record["reasons"])
            groups.setdefault((record["verdict"], kinds), []).append(record)
    by = worst_by if worst_by is not None else next((key for _, key in measures), None)
    order = sorted(
        groups.items(),
        key=lambda item: (WORST_FIRST.index(item[0][0]) if item[0][0] in WORST_FIRST else 0, -len(item[1])),
    )
    rows = []
    for (verdict, _), members in order:
        worst = members[0] if by is None else max(members, key=lambda record: record.get(by) or 0.0)
        frames = frame_ranges([int(member["frame_id"]) for member in members], among=every)
        named = f"in {worst['frame_id']}: " if len(members) > 1 else ""
        reasons = named + "; ".join(worst["reasons"])
        rows.append([frames, Badge(verdict), reasons, *(shown(worst.get(key)) for _, key in measures)])
    columns = [Column("frames"), Column("verdict"), Column("reasons")]
    return Table([*columns, *(Column(heading, number=True) for heading, _ in measures)], rows, stacks=True)


def verdict_runs(records: Sequence[Mapping[str, Any]]) -> list[tuple[str, int]]:
    """Verdicts along the take, and how many frames each lasts."""
    return [(verdict, len(list(group))) for verdict, group in groupby(record["verdict"] for record in records)]


def verdict_counts(records: Sequence[Mapping[str, Any]], verdicts: Sequence[str]) -> list[tuple[str, int]]:
    """How many frames have each of the verdicts, those that none has left out."""
    counts = [(verdict, sum(record["verdict"] == verdict for record in records)) for verdict in verdicts]
    return [(verdict, count) for verdict, count in counts if count]
