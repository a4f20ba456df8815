"""What was read of a scan, and whether it still is so: the file and those it names, by size, time and content.

A scan's digest is that of its content and of the materials, buffers and textures that reading it came upon; where the
file lies and what it is called does not count. A scan is hashed when a stage reads it anyway, and again only when its
size or time have changed.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from capture4d.captures.capture import Capture, scan_path
from capture4d.errors import InputError, StaleError
from capture4d.files.reading import companions_named
from capture4d.runs.frame_lists import frame_file
from capture4d.runs.made import FileState, Ledger, digest_of, file_state, is_as
from capture4d.runs.stage import read_record

__all__ = [
    "DAMAGED",
    "as_it_is_now",
    "replaced_scan",
    "require_same_take",
    "scan_digest",
    "scan_looked_at",
    "stands_with_scan",
]

DAMAGED = "damaged"
"""What is said of a file whose scan could not be read: that is tried again in every run, in case it was repaired."""


@contextmanager
def scan_looked_at(capture: Capture, frame_id: int, *, known: Sequence[FileState] = ()) -> Iterator[list[FileState]]:
    """Read a frame's scan inside; what was read of it stands in the list afterwards, also where reading failed.

    Args:
        known: what there is to be said of the scan, if it need not be read.
    """
    looked: list[FileState] = [*known]
    if known:
        yield looked
        return
    path = scan_path(capture, frame_id)
    own = file_state(path, path.name)  # before it is read: what is changed meanwhile is read again next time
    with companions_named() as named:
        try:
            yield looked
        finally:
            others = sorted((_name(each, path.parent), each) for each in named)
            looked += [own, *(file_state(each, name) for name, each in others)]


def as_it_is_now(capture: Capture, frame_id: int, before: tuple[FileState, ...]) -> tuple[FileState, ...]:
    """The files that were read of a scan as they are now; itself alone if it was never read, or is another file."""
    try:
        path = scan_path(capture, frame_id)
    except InputError:
        return ()
    if not before or before[0].name != path.name:
        return (file_state(path, path.name),)
    if all(is_as(path if at == 0 else path.parent / each.name, each) for at, each in enumerate(before)):
        return before
    places = [path, *(path.parent / each.name for each in before[1:])]
    return tuple(
        each if is_as(place, each) else file_state(place, each.name) for place, each in zip(places, before, strict=True)
    )


def scan_digest(files: Sequence[FileState]) -> str:
    """Digest of a scan from what was read of it."""
    own, *others = files
    return digest_of([Path(own.name).suffix.lower(), own.digest, *([each.name, each.digest] for each in others)])


def stands_with_scan(ledger: Ledger, path: Path, capture: Capture, frame_id: int, inputs: Mapping[str, str]) -> bool:
    """Whether a file of a stage is there, made from the frame's scan as it is now and from the same else.

    Args:
        inputs: what else it would be made from.
    """
    made = ledger.of(path)
    if made is None or made.said.get(DAMAGED) or {**made.inputs, "scan": ""} != {**inputs, "scan": ""}:
        return False
    files = as_it_is_now(capture, frame_id, made.files)
    if files is made.files:
        return ledger.is_whole(path, made)
    if not files or scan_digest(files) != made.inputs["scan"] or not ledger.is_whole(path, made):
        return False
    ledger.note(path, replace(made, files=files))  # the same content at another time
    return True


def replaced_scan(ledger: Ledger, path: Path, capture: Capture, frame_id: int) -> bool:
    """Whether a file of a stage was made from another scan than the frame's is now."""
    made = ledger.of(path)
    if made is None:
        return False
    files = as_it_is_now(capture, frame_id, made.files)
    return files is not made.files and bool(files) and scan_digest(files) != made.inputs.get("scan")


def require_same_take(folder: Path, capture: Capture) -> None:
    """See that a stage's folder is not that of another take: one that lies elsewhere and has no scan in common.

    Raises:
        StaleError: it is. A take may be given by a wrong name, and what a stage has made is not lost to that.
    """
    record = read_record(folder / "stage.json") if (folder / "stage.json").is_file() else {}
    place = record.get("sources", {}).get("capture")
    if record.get("status") == "discarded" or place is None or Path(place) == capture.path.resolve():
        return
    ledger = Ledger.read(folder)
    paths = {each: frame_file(folder, each) for each in capture.frame_ids}
    known = [each for each, path in paths.items() if ledger.of(path) is not None]
    if known and all(replaced_scan(ledger, paths[each], capture, each) for each in known):
        raise StaleError(
            f"was made from another take, {place}: none of its scans is the same; give another --output, or "
            "--overwrite",
            where=folder,
        )


def _name(path: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # on another drive
        return str(path)
