"""--dry-run: what a command would do is said, and nothing is done."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from capture4d.cli.exit_codes import BAD_RESULT, GOOD

if TYPE_CHECKING:
    from capture4d.app.status.plan import Plan

__all__ = ["DryRunOptions"]


@dataclass(frozen=True, kw_only=True)
class DryRunOptions:
    """Of commands that can say what they would do."""

    dry_run: bool = False
    """Say which frames would be done and why, about how long it takes and what disk it needs; do nothing."""

    def told(self, plan: Plan) -> int:
        """Print what would be done; the exit code says whether it would be refused."""
        from capture4d.app.status.table import plan_lines

        print("\n".join(plan_lines(plan)))
        return BAD_RESULT if plan.refuses else GOOD
