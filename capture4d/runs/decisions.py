"""What the whole take decides: the shape of its subject, and colours that are learned.

Each is a file in the folder of the stage that goes by it, and every frame is made from it. It is kept while all that it
was found from but the scans stays the same, so that a frame that is added does not renew every other one.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_json

__all__ = ["DECISIONS", "GIVEN", "forget_decisions", "take_over_decisions"]

DECISIONS: Mapping[str, tuple[str, ...]] = {
    "shape": ("body/shape.json",),
    "colours": ("garment/colours.json", "body/colours.json"),
}
"""Files in a work folder, by what they decide."""
GIVEN = "given"
"""What a decision was found from that comes from another take: it is kept whatever changes."""


def forget_decisions(work: Path, what: Collection[str]) -> None:
    """Let the next run find them anew.

    Raises:
        InputError: one is none of `DECISIONS`.
    """
    for name in what:
        if name not in DECISIONS:
            raise InputError(f"--renew: expected {' or '.join(DECISIONS)}, found {name[:80]!a}")
    for name in what:
        for place in DECISIONS[name]:
            (work / place).unlink(missing_ok=True)


def take_over_decisions(work: Path, like: Path) -> None:
    """Let a work folder, whose stages have not been run, go by the decisions of another one's.

    Raises:
        InputError: the other one has none.
    """
    places = [place for places in DECISIONS.values() for place in places if (like / place).is_file()]
    if not places:
        raise InputError("expected a work folder with a shape or colours, found none", where=like)
    for place in places:
        write_json(work / place, {**read_json(like / place), "found_from": GIVEN})
