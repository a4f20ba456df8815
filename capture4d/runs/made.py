"""What every file of a stage was made from: a record by which a stage redoes what has changed, and nothing else.

A stage that goes by frames keeps, of each file it writes, the digests of what it truly read for it, by name (the scan,
the settings, the frame that it started from), and the digest of the file itself. Before a file is made, what it would
be made from is compared with what it was made from; if nothing differs the file stands. A file that is made again and
comes out as it was changes nothing for what reads it, for that goes by its digest: so a change travels as far as it
makes a difference, and no farther, and the result is that of a run from scratch.

    STAGE/made.jsonl     a file a line, complete whenever the stage is opened and when it is finished
    STAGE/made/*.jsonl   what each process has made since, one by one; read and merged when the stage is opened

A line is added after its file is whole, so a kill between the two costs that file once more. Before a file is replaced
another line says that what is known of it no longer holds. Size and time tell whether a file is still the one that was
recorded; where they differ, as after a copy of the folder, its content decides.

References: redo (Bernstein) and Shake (Mitchell, ICFP 2012) for the early cut-off; "Racy Git" (git's technical
documentation) for times of files that are too fresh to be believed.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import json
import os
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from capture4d.files.atomic import plain_value, write_bytes

__all__ = ["FileState", "Ledger", "Made", "digest_of", "file_state", "is_as", "joined", "make", "noted"]

MADE, JOURNALS = "made.jsonl", "made"
ABSENT, UNREADABLE = "absent", "unreadable"
"""In place of the digest of a file that is not there, or that the system does not let us read."""
FRESH_NS = 2_000_000_000
"""A file that was changed so shortly before it was looked at may be changed again without its time telling: the
coarsest file systems count in steps of two seconds."""


@dataclass(frozen=True, slots=True)
class FileState:
    """A file as it was when it was looked at."""

    name: str
    size: int
    time_ns: int
    """Of its last change; 0 if that was too short ago to be relied upon."""
    digest: str


@dataclass(frozen=True, slots=True)
class Made:
    """A file of a stage, and what it was made from."""

    inputs: Mapping[str, str]
    """What was read for it, by name: digests, or short texts."""
    digest: str
    size: int
    time_ns: int
    files: tuple[FileState, ...] = ()
    """Of the user's, that were read for it; one of its inputs is a digest of them."""
    said: Mapping[str, Any] = field(default_factory=dict)
    """What is to be known of it without opening it."""


@dataclass(eq=False)
class Ledger:
    """What the files of a stage were made from, as it was known when the stage was opened and has been noted since."""

    folder: Path
    _made: dict[str, Made]
    _is_settled: bool = False
    """The file of the stage says the same."""

    @staticmethod
    def read(folder: Path) -> Ledger:
        """What is known, without writing anything."""
        with _collector_at_rest():
            made = dict(_settled(folder / MADE))
            journals = sorted((folder / JOURNALS).glob("*.jsonl"))
            for path in journals:
                made.update(_lines(path))
        known = {place: each for place, each in made.items() if each is not _GONE} if journals else made
        return Ledger(folder, known, not journals)

    @staticmethod
    def open(folder: Path) -> Ledger:
        """The same, the notes of killed runs merged into one file."""
        ledger = Ledger.read(folder)
        if not ledger._is_settled:
            ledger.settle()
        return ledger

    def of(self, path: Path) -> Made | None:
        """What is known of a file, whether or not it still is the one."""
        return self._made.get(self._place(path))

    def inputs_of(self, folder: str) -> dict[str, Mapping[str, str]]:
        """What each file of one of the stage's folders was made from, by its place."""
        return {place: made.inputs for place, made in self._made.items() if place.rpartition("/")[0] == folder}

    def said_of(self, folder: str) -> dict[str, Mapping[str, Any]]:
        """What is to be known of each file of one of the stage's folders, by its place."""
        return {place: made.said for place, made in self._made.items() if place.rpartition("/")[0] == folder}

    def stands(self, path: Path, inputs: Mapping[str, str]) -> bool:
        """Whether a file is there, whole, and was made from the same."""
        made = self.of(path)
        return made is not None and made.inputs == inputs and self.is_whole(path, made)

    def sound(self, path: Path) -> Made | None:
        """What is known of a file that is there as it was recorded."""
        made = self.of(path)
        return made if made is not None and self.is_whole(path, made) else None

    def digest_of(self, paths: Iterable[Path]) -> str:
        """One digest over the names and contents of files that were all made."""
        places = [self._place(path) for path in paths]
        return joined((place, self._made[place].digest) for place in places)

    def note(self, path: Path, made: Made) -> None:
        """Know of a file that was made by this process or another."""
        self._made[self._place(path)] = made
        self._is_settled = False

    def forget(self, keep: Callable[[str], bool]) -> None:
        """Know no longer of files that are not to be kept, by their names."""
        kept = {place: made for place, made in self._made.items() if keep(place.rpartition("/")[2])}
        self._is_settled &= len(kept) == len(self._made)
        self._made = kept

    def settle(self) -> None:
        """Write what is known into one file; the notes that it was known from go."""
        if self._is_settled:
            return
        lines = (_line(place, made) for place, made in self._made.items())
        write_bytes(self.folder / MADE, "".join(lines).encode())
        for path in (self.folder / JOURNALS).glob("*.jsonl"):
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            (self.folder / JOURNALS).rmdir()
        self._is_settled = True

    def _place(self, path: Path) -> str:
        """A file's place in the folder; pathlib's own way takes a second for all that are asked of a long take."""
        place, folder = str(path), f"{self.folder}{os.sep}"
        assert place.startswith(folder), place
        return place[len(folder) :] if os.sep == "/" else place[len(folder) :].replace(os.sep, "/")

    def is_whole(self, path: Path, made: Made) -> bool:
        """Whether a file is there as it was recorded."""
        try:
            found = os.stat(path)
        except OSError:
            return False
        if found.st_size != made.size:
            return False
        return found.st_mtime_ns == made.time_ns or _content_digest(path, found) == made.digest


# --- files that are made -----------------------------------------------------------------------------------------


def make(
    folder: Path,
    path: Path,
    write: Callable[[], object],
    *,
    inputs: Mapping[str, str],
    files: Sequence[FileState] = (),
    said: Mapping[str, Any] | None = None,
) -> Made:
    """Write a file of a stage and note what it was made from; by any process, of different files at once.

    Args:
        folder: of the stage.
        write: makes the file, whole or not at all.
    """
    place = path.relative_to(folder).as_posix()
    if path.exists():
        _append(folder, _gone(place))
    write()
    found = os.stat(path)
    made = Made(dict(inputs), _hashed(path), found.st_size, found.st_mtime_ns, tuple(files), dict(said or {}))
    _append(folder, _line(place, made))
    return made


_journals: dict[tuple[int, Path], Path] = {}
"""Of this process, by its number (a forked one starts another), and by the stage."""


def _append(folder: Path, line: str) -> None:
    key = (os.getpid(), folder)
    if key not in _journals:
        _journals[key] = folder / JOURNALS / f"{key[0]}-{secrets.token_hex(4)}.jsonl"
    _journals[key].parent.mkdir(parents=True, exist_ok=True)
    with _journals[key].open("a", encoding="utf-8") as file:
        file.write(line)


def noted(folder: Path) -> int:
    """How many files have been made since the stage was opened: cheap enough to be asked every second."""
    count = 0
    for path in (folder / JOURNALS).glob("*.jsonl"):
        with contextlib.suppress(OSError):
            count += path.read_bytes().count(b'"digest"')
    return count


# --- lines -------------------------------------------------------------------------------------------------------

_GONE = Made({}, "", 0, 0)
"""Of a file that was about to be replaced."""


def _line(place: str, made: Made) -> str:
    row: dict[str, Any] = {
        "path": place, "inputs": made.inputs, "digest": made.digest, "size": made.size, "time": made.time_ns,
    }  # fmt: skip
    if made.files:
        row["files"] = [[each.name, each.size, each.time_ns, each.digest] for each in made.files]
    if made.said:
        row["said"] = made.said
    return json.dumps(row, default=plain_value) + "\n"


def _gone(place: str) -> str:
    return json.dumps({"path": place}) + "\n"


@contextlib.contextmanager
def _collector_at_rest() -> Iterator[None]:
    """Nothing that is made inside is in a circle; looking for circles again and again, while a hundred thousand small
    objects come to be, takes most of the time."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _settled(path: Path) -> Mapping[str, Made]:
    """What a stage's file says; the stages of one run do not read it twice."""
    try:
        found = os.stat(path)
    except FileNotFoundError:
        return {}
    if _is_fresh(found):
        return dict(_lines(path))
    return _remembered_lines(path, found.st_size, found.st_mtime_ns)


@lru_cache(maxsize=16)
def _remembered_lines(path: Path, size: int, time_ns: int) -> Mapping[str, Made]:
    """That of a file of this size and time."""
    return dict(_lines(path))


def _lines(path: Path) -> Iterator[tuple[str, Made]]:
    """The files that a list knows; a line that a kill or a full disk cut off is no line."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return
    for line in text.splitlines():
        try:
            row = json.loads(line)
            place = row["path"]
            if "digest" not in row:
                yield place, _GONE
                continue
            files = tuple(FileState(*each) for each in row.get("files", ()))
            yield place, Made(row["inputs"], row["digest"], row["size"], row["time"], files, row.get("said", {}))
        except (ValueError, KeyError, TypeError, AttributeError):
            continue


# --- digests -----------------------------------------------------------------------------------------------------


def file_state(path: Path, name: str, *, now_ns: int | None = None) -> FileState:
    """Look at a file of the user's, whatever there is.

    Args:
        name: what it is to be called.
        now_ns: the time, if not the clock's.
    """
    try:
        found = os.stat(path)
    except OSError:
        return FileState(name, 0, 0, ABSENT)
    digest = _content_digest(path, found)
    fresh = _is_fresh(found, now_ns)
    return FileState(name, found.st_size, 0 if fresh or digest == UNREADABLE else found.st_mtime_ns, digest)


def is_as(path: Path, before: FileState) -> bool:
    """Whether size and time say that a file is as it was when it was looked at."""
    try:
        found = os.stat(path)
    except OSError:
        return before.digest == ABSENT
    return before.time_ns != 0 and (found.st_size, found.st_mtime_ns) == (before.size, before.time_ns)


def _is_fresh(found: os.stat_result, now_ns: int | None = None) -> bool:
    return found.st_mtime_ns + FRESH_NS >= (time.time_ns() if now_ns is None else now_ns)


def _content_digest(path: Path, found: os.stat_result) -> str:
    """SHA-256 of a file's content; the stages of one run do not read it twice, unless its time cannot be believed."""
    if _is_fresh(found):
        return _hashed(path)
    return _remembered(path, found.st_size, found.st_mtime_ns)


@lru_cache(maxsize=65_536)
def _remembered(path: Path, size: int, time_ns: int) -> str:
    """That of a file of this size and time."""
    return _hashed(path)


def _hashed(path: Path) -> str:
    if not path.is_file():  # a pipe would wait for its writer
        return UNREADABLE
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return UNREADABLE


def digest_of(value: Any) -> str:
    """Digest of settings, or of anything that JSON can hold, exactly."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=plain_value).encode()).hexdigest()


def joined(parts: Iterable[tuple[str, str]]) -> str:
    """One digest of files' names and digests, whatever order they come in; that of `files.atomic.file_digest`."""
    return hashlib.sha256("".join(f"{name}\0{part}\n" for name, part in sorted(parts)).encode()).hexdigest()
