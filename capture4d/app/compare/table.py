"""The table of compared surfaces, for the page of the comparison and for the take's report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from capture4d.app.drawing.page import Column, Table

__all__ = ["LEARNED", "comparison_table"]

LEARNED = "* This model learned from these very frames: what it holds, not what it foresees."
COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("vertex, mm", "vertex_mm", ".2f"),
    ("normal, deg", "normal_deg", ".2f"),
    ("wrinkle energy kept", "wrinkle_energy_kept", ".2f"),
    ("flicker, deg", "flicker_deg", ".2f"),
    ("ms a frame", "ms_per_frame", ".1f"),
    ("model, MB", "model_mb", ".1f"),
)


def comparison_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """One row a surface, as compare.json has them; a star on those of which `LEARNED` holds."""
    return Table(
        [Column("surface"), *(Column(heading, number=True) for heading, _, _ in COLUMNS)],
        [
            [
                row["name"] + (" *" if row["learned"] else ""),
                *("–" if row[key] is None else format(row[key], shape) for _, key, shape in COLUMNS),
            ]
            for row in rows
        ],
    )
