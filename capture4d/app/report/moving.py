"""The page that `export --format html` made, inside the report: what moves is seen moving."""

from __future__ import annotations

from pathlib import Path

__all__ = ["exported_page", "shows_it"]

_PAGE = "../exports/garment.html"
"""As a report names it."""


def exported_page(work: Path) -> str | None:
    """The exported page, as the report of a work folder names it; None where there is none."""
    return _PAGE if (work / "exports" / "garment.html").is_file() else None


def shows_it(report: Path, page: str | None) -> bool:
    """Whether a report that was drawn shows the exported page, if there is one, and none if there is none."""
    path = report / "index.html"
    return path.is_file() and (f'src="{_PAGE}"' in path.read_text(encoding="utf-8")) == (page is not None)
