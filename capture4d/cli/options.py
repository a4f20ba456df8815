"""What commands have in common. Standard library alone: `capture4d --help` loads it."""

from __future__ import annotations

import os
from dataclasses import dataclass, field

__all__ = ["StageOptions", "all_cores"]


def all_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True, kw_only=True)
class StageOptions:
    workers: int = field(default_factory=all_cores)
    """Processes to use; the result does not depend on it."""
    overwrite: bool = False
    """Start clean: delete what an earlier run left in the output folder."""
