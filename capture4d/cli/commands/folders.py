"""`capture4d diff` and `status`: work folders from outside."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from capture4d.cli.exit_codes import BAD_RESULT, GOOD

__all__ = ["Diff", "Status"]


@dataclass(frozen=True, kw_only=True)
class Diff:
    """Compare two work folders, finished or not: what changed in settings, metrics and frames; a page with both."""

    first: Annotated[Positional[Path], arg(metavar="WORK1")]
    """Work folder of a take or an animation: what there was."""
    second: Annotated[Positional[Path], arg(metavar="WORK2")]
    """Work folder that is compared with it: what it has become."""
    fail_if_worse: UseAppendAction[tuple[Annotated[str, arg(metavar="METRIC=PERCENT")], ...]] = ()
    """Exit with 3 if this metric is worse in WORK2 by more than so many percent of its value in WORK1; may be given
    several times."""
    output: Path | None = None
    """HTML page to write; WORK2/diff/WORK1.html if absent."""
    overwrite: bool = False
    """Write the page over a file that holds something else."""
    json: bool = False
    """Print JSON instead of a table, and write a page only if --output names one."""

    def __call__(self) -> int:
        import json

        from capture4d import pipeline
        from capture4d.app.differences.page import default_page, write_page
        from capture4d.app.differences.table import table_lines
        from capture4d.app.differences.work_diff import as_json, broken_limits, parse_worse_limits

        limits = parse_worse_limits(self.fail_if_worse)
        found = pipeline.diff(self.first, self.second)
        broken = broken_limits(found, limits)
        print(json.dumps(as_json(found), indent=2) if self.json else "\n".join(table_lines(found)))
        if self.output is not None:
            write_page(found, self.output, overwrite=self.overwrite)
        elif not self.json:
            write_page(found, default_page(found), overwrite=True)
        if not self.json:
            print(f"page: {self.output or default_page(found)}")
        for line in broken:
            print(f"capture4d: {line}", file=sys.stderr)
        return BAD_RESULT if broken else GOOD


@dataclass(frozen=True, kw_only=True)
class Status:
    """Tell what is done in a work folder, what is running, stale or damaged, and why; which frames are flagged."""

    folder: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder of a take or an animation; another command may be writing to it."""
    json: bool = False
    """Print JSON instead of a table."""

    def __call__(self) -> int:
        import json

        from capture4d import pipeline
        from capture4d.app.status.survey import as_json
        from capture4d.app.status.table import status_lines

        found = pipeline.status(self.folder)
        print(json.dumps(as_json(found), indent=2) if self.json else "\n".join(status_lines(found)))
        return BAD_RESULT if found.is_damaged else GOOD
