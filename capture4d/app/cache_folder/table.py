"""What the cache folder keeps, and what was removed, as text and for machines."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from capture4d.app.cache_folder.contents import Contents, Entry
from capture4d.app.cache_folder.removal import Removal
from capture4d.app.differences.table import aligned
from capture4d.app.status.table import size

__all__ = ["as_json", "contents_lines", "removal_as_json", "removal_lines"]


def contents_lines(contents: Contents) -> list[str]:
    """A line an entry, and the sums."""
    if not contents.entries:
        there = "nothing is kept there" if contents.folder.is_dir() else "no such folder; nothing is kept"
        return [f"{contents.folder}: {there}"]
    head = ("entry", "size", "last used", "state", "why")
    rows = [(each.name, size(each.bytes), _day(each), each.state, _why(each)) for each in contents.entries]
    old = sum(entry.bytes for entry in contents.old)
    told = f"{size(old)} of it old, which capture4d cache --remove old removes" if contents.old else "nothing of it old"
    kept = _counted(contents.entries)
    return [f"{contents.folder}:", "", *aligned([head, *rows], left=(0, 2, 3, 4)), "",
            f"{kept}, {size(contents.bytes)}; {told}"]  # fmt: skip


def removal_lines(removal: Removal, strange: Sequence[Entry] = (), *, dry_run: bool) -> list[str]:
    """What went, what did not and why, and the sum.

    Args:
        strange: entries that `all` leaves alone.
    """
    did = "would remove" if dry_run else "removed"
    lines = [f"{did} {entry.name} ({size(entry.bytes)})" for entry in removal.removed]
    lines += [f"left {name}: {why}" for name, why in removal.left.items()]
    lines += [f"left {entry.name}: {entry.why}; its name removes it" for entry in strange]
    if not removal.removed:
        return [*lines, "Nothing was removed."]
    sums = f"{_counted(removal.removed)}, {size(removal.freed_bytes)}"
    return [*lines, f"Nothing was removed; it would be {sums}." if dry_run else f"Removed: {sums} freed."]


def as_json(contents: Contents) -> dict[str, Any]:
    """The same for machines."""
    return {
        "format": 1,
        "folder": str(contents.folder),
        "bytes": contents.bytes,
        "old_bytes": sum(entry.bytes for entry in contents.old),
        "entries": [
            {
                "name": each.name,
                "bytes": each.bytes,
                "used": each.used and datetime.fromtimestamp(each.used, UTC).isoformat(timespec="seconds"),
                "state": each.state,
                "why": each.why,
                "is_being_written": each.writer is not None,
            }
            for each in contents.entries
        ],
    }


def removal_as_json(removal: Removal, *, dry_run: bool) -> dict[str, Any]:
    """What went, for machines."""
    names = [entry.name for entry in removal.removed]
    return {
        "format": 1,
        "dry_run": dry_run,
        "removed": names,
        "left": dict(removal.left),
        "freed_bytes": removal.freed_bytes,
    }


def _why(entry: Entry) -> str:
    return "; ".join(word for word in (entry.why, entry.writing) if word)


def _day(entry: Entry) -> str:
    return "" if entry.used is None else datetime.fromtimestamp(entry.used).astimezone().strftime("%Y-%m-%d %H:%M")


def _counted(entries: Sequence[Entry]) -> str:
    return f"{len(entries)} {'entry' if len(entries) == 1 else 'entries'}"
