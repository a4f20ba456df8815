"""What the cache folder keeps: entry by entry how large it is, when it was last used, and whether this version uses it.

Looking changes nothing, takes no lock, and follows no link.

FOLDER/takes/NAME-HASH     synthetic takes, training sets, drapes
FOLDER/printed/NAME        scans of a take in takes, which it links to
FOLDER/works/NAME          work folders of takes, and models
FOLDER/offsets/NAME        networks that learned from drapes
FOLDER/people, drapes      small files that are told apart by a hash
FOLDER/warp, kernels       compiled kernels
FOLDER/body-anny-vN.npz    the built-in body
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from capture4d.app.cache_folder.verdicts import Record, State, Verdict, read_records, verdict_of_records, worst
from capture4d.body.anny import BAKE_VERSION
from capture4d.errors import InputError
from capture4d.files.atomic import TEMPORARY_SUFFIX
from capture4d.runs.locks import LOCK, Holder, holders

__all__ = ["INTERRUPTED", "Contents", "Entry", "look"]

INTERRUPTED = ".removed"
"""Ends the name of what was about to be removed."""
_GROUPS = ("takes", "printed", "works", "offsets")
"""Folders whose folders are entries."""
_WHOLE = {
    "people": ("people of benchmarks", re.compile(r".*\.npz")),
    "drapes": ("garments as they are put on", re.compile(r".*\.npz")),
    "warp": ("compiled kernels", re.compile(r"(.*/)?wp_.*")),
    "kernels": ("compiled kernels", re.compile(r".*\.nb[ci](\..*)?")),
}
"""Entries whose version cannot be told: what they are, and what the files in them are called."""
_BODY = re.compile(r"body-anny-v(\d+)\.npz")
_HASHED = re.compile(r"-[0-9a-f]{12}$")
"""Ends the name of a take that was not put there by hand."""
_OWN_WORKS = ("work", "works")
"""Folders inside takes that are made again by themselves: what they are does not decide about the take."""


@dataclass(frozen=True, slots=True)
class Entry:
    """What is removed as one."""

    name: str
    """Its place in the folder, as in "takes/tiny-ae0239c707ae"."""
    path: Path
    bytes: int
    used: float | None
    """When it was last written or read, as far as the disk knows, seconds since 1970; None of an empty folder."""
    state: State
    why: str = ""
    takes: tuple[str, ...] = ()
    """Names of the entries that it is made from."""
    writer: Holder | None = None
    """Who is writing to it now."""
    is_strange: bool = False
    """It does not look like anything that capture4d keeps: the folder may be one that somebody else uses as well."""

    @property
    def writing(self) -> str:
        """Who is writing to it now, in words; empty if nobody is."""
        if self.writer is None:
            return ""
        return "being written" if self.writer.process is None else f"being written (process {self.writer.process})"


@dataclass(frozen=True, slots=True)
class Contents:
    """All entries, the largest first."""

    folder: Path
    entries: tuple[Entry, ...]

    @property
    def bytes(self) -> int:
        return sum(entry.bytes for entry in self.entries)

    @property
    def old(self) -> tuple[Entry, ...]:
        return tuple(entry for entry in self.entries if entry.state == "old")


def look(folder: Path) -> Contents:
    """What a cache folder keeps; nothing if it is not there.

    Raises:
        InputError: it is no folder.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("expected a folder, found a file", where=folder)
    things = [_seen(folder, path) for path in _places(folder)]
    takes = {thing.name: _verdict(thing) for thing in things if thing.group == "takes"}
    entries = [_entry(folder, thing, takes) for thing in things]
    return Contents(folder, tuple(sorted(entries, key=lambda entry: (-entry.bytes, entry.name))))


# --- on the disk -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Thing:
    """What will be an entry, before it is judged."""

    name: str
    group: str
    """First part of its name."""
    path: Path
    bytes: int
    used: float | None
    files: Sequence[Path]
    records: Sequence[Record]

    @property
    def is_folder(self) -> bool:
        return self.path.is_dir() and not self.path.is_symlink()


def _places(folder: Path) -> Iterator[Path]:
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.name in _GROUPS and path.is_dir() and not path.is_symlink():
            yield from (each for each in sorted(path.iterdir()) if not each.name.endswith(LOCK))
        elif not path.name.endswith(LOCK):
            yield path


def _seen(folder: Path, path: Path) -> _Thing:
    """Look through everything below a path."""
    is_folder = path.is_dir() and not path.is_symlink()
    files = [Path(parent, name) for parent, _, names in os.walk(path) for name in names] if is_folder else [path]
    total, times = 0, list[float]()
    for file in files:
        try:
            found = file.lstat()
        except OSError:  # it has just gone
            continue
        total += found.st_size
        if not file.name.endswith(LOCK):
            times.append(found.st_mtime)
            if file.suffix != ".json":  # looking reads those
                times.append(found.st_atime)
    name = path.relative_to(folder)
    return _Thing(
        name=name.as_posix(),
        group=name.parts[0],
        path=path,
        bytes=total,
        used=max(times, default=None),
        files=files,
        records=read_records(file for file in files if file.name == "stage.json" and not file.is_symlink()),
    )


def _writer(thing: _Thing) -> Holder | None:
    """Who is writing to a folder, to what is below it, or makes it."""
    beside = thing.path.parent / f".{thing.path.name}{LOCK}"
    places = {file for file in (beside, *thing.files) if file.name.endswith(LOCK) and file.exists()}
    held = (holder for parent in {place.parent for place in places} for holder in holders(parent))
    return next((holder for holder in held if holder.place in places), None)


# --- what it is --------------------------------------------------------------------------------------------------


def _entry(folder: Path, thing: _Thing, takes: Mapping[str, Verdict]) -> Entry:
    made_from: list[str] = []
    verdict = takes.get(thing.name) or _verdict(thing)
    if thing.group in _GROUPS and thing.group != "takes" and thing.is_folder and not _is_going(thing):
        made_from = _takes_of(folder, thing, takes)
        verdict = worst([verdict, *(_as_made_from(name, takes) for name in made_from)])
        if thing.group == "printed" and not made_from:
            verdict = Verdict("unknown", "of no take that is kept here")
    is_strange = _is_strange(thing, made_from)
    return Entry(
        thing.name,
        thing.path,
        thing.bytes,
        thing.used,
        verdict.state,
        "does not look like ours" if is_strange else verdict.why,
        tuple(name for name in made_from if name in takes),
        _writer(thing),
        is_strange,
    )


def _verdict(thing: _Thing) -> Verdict:
    """Of a thing by itself."""
    if _is_going(thing):
        return Verdict("old", "its removal was interrupted")
    body = _BODY.fullmatch(thing.name)
    if body is not None:
        number = int(body[1])
        state = "current" if number == BAKE_VERSION else "old" if number < BAKE_VERSION else "unknown"
        return Verdict(state, "" if state == "current" else f"version {number}, now {BAKE_VERSION}")
    if thing.path.is_symlink():
        return Verdict("unknown", "a link")
    if thing.name in _WHOLE:
        return Verdict("unknown", _WHOLE[thing.name][0])
    if thing.group == "printed":  # no stage: what it is scanned from decides
        return Verdict("current")
    return verdict_of_records([record for record in thing.records if not _is_in_works(thing, record)])


def _is_going(thing: _Thing) -> bool:
    return thing.path.name.startswith(".") and thing.path.name.endswith(INTERRUPTED)


def _is_strange(thing: _Thing, made_from: Sequence[str]) -> bool:
    """Whether nothing speaks for it being ours; what is empty or a link does no harm if it goes."""
    if _is_going(thing) or _BODY.fullmatch(thing.name) or (thing.is_folder and not thing.files):
        return False
    if thing.name in _WHOLE and thing.is_folder:
        paths = (file.relative_to(thing.path).as_posix() for file in thing.files)
        return not all(_WHOLE[thing.name][1].fullmatch(path) or path.endswith(TEMPORARY_SUFFIX) for path in paths)
    if thing.group not in _GROUPS or thing.name == thing.group:
        return True
    return not (thing.path.is_symlink() or thing.records or made_from)


def _is_in_works(thing: _Thing, record: Record) -> bool:
    return thing.group == "takes" and any(part in _OWN_WORKS for part in record.path.relative_to(thing.path).parts)


def _as_made_from(take: str, takes: Mapping[str, Verdict]) -> Verdict:
    """Of what was made from a take."""
    if take not in takes:
        return Verdict("old", "its take is gone")
    state = takes[take].state
    return Verdict(state, "" if state == "current" else f"its take is {state}")


def _takes_of(folder: Path, thing: _Thing, takes: Mapping[str, Verdict]) -> list[str]:
    """Names of the takes that something was made from, of those that are gone as well."""
    roots = [folder / "takes", folder.resolve() / "takes"]
    named = [*_links(thing.path), *(place for record in thing.records for place in _sources(record))]
    found = {
        f"takes/{place.relative_to(root).parts[0]}"
        for place in named
        for root in roots
        if place.is_relative_to(root) and place != root
    }
    for take in takes:  # works that were written from the truth of a take are called as it is
        name = take.removeprefix("takes/")
        if _HASHED.search(name) and (f"-{thing.path.name}".endswith(f"-{name}") or (thing.path / name).is_dir()):
            found.add(take)
    return sorted(found)


def _links(path: Path) -> Iterator[Path]:
    for each in sorted(path.iterdir()):
        if each.is_symlink():
            yield Path(os.path.normpath(path / each.readlink()))


def _sources(record: Record) -> list[Path]:
    sources = (record.said or {}).get("sources")
    return [Path(place) for place in sources.values() if isinstance(place, str)] if isinstance(sources, dict) else []
