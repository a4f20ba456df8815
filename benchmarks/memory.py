"""The largest resident set of this process, of its own making."""

from __future__ import annotations

import re
from pathlib import Path

__all__ = ["peak_rss_mb"]


def peak_rss_mb() -> float:
    """Peak resident set so far, MB.

    Linux tells it in /proc. getrusage will not do there: its peak outlives exec, so that a child starts from its
    parent's.
    """
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text()) if status.is_file() else None
    if found:
        return int(found[1]) / 1024
    import resource  # not on every system

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
