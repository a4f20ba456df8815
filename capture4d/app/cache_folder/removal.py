"""Entries of the cache folder go: each at once, none that is being written or read for what is being written."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from pathlib import Path

from capture4d.app.cache_folder.contents import INTERRUPTED, Contents, Entry
from capture4d.errors import InputError
from capture4d.runs.locks import alone, holders

__all__ = ["ALL", "OLD", "Removal", "chosen", "remove"]

OLD, ALL = "old", "all"
"""What may stand for names."""
_MOST_NAMES = 8


@dataclass(frozen=True, slots=True)
class Removal:
    """What is gone, or would be."""

    removed: tuple[Entry, ...]
    left: Mapping[str, str]
    """Why something is still there that was to go, by its name."""

    @property
    def freed_bytes(self) -> int:
        return sum(entry.bytes for entry in self.removed)


def chosen(contents: Contents, words: Sequence[str]) -> tuple[Entry, ...]:
    """The entries that are meant, the largest first.

    Args:
        words: `old`; `all`, which leaves alone what capture4d does not keep; names of entries or of the folders that
            they are in.
    Raises:
        InputError: there is no such entry.
    """
    names = {entry.name for word in words for entry in _meant(contents, word)}
    return tuple(entry for entry in contents.entries if entry.name in names)


def remove(contents: Contents, entries: Sequence[Entry], *, dry_run: bool = False) -> Removal:
    """Remove entries; what cannot go is told.

    Args:
        dry_run: only tell what would go.
    """
    needed = {take: entry for entry in contents.entries if entry.writer is not None for take in entry.takes}
    removed, left = list[Entry](), dict[str, str]()
    for entry in entries:
        maker = needed.get(entry.name)
        if entry.writer is not None or maker is not None:
            left[entry.name] = entry.writing if maker is None else f"{maker.name}, made from it, is {maker.writing}"
            continue
        try:
            if not dry_run:
                _remove(entry.path)
            removed.append(entry)
        except InputError:  # who began since it was looked at
            left[entry.name] = "being written"
        except OSError as error:
            left[entry.name] = error.strerror or str(error)
    return Removal(tuple(removed), left)


def _meant(contents: Contents, word: str) -> Sequence[Entry]:
    if word == OLD:
        return contents.old
    if word == ALL:
        return [entry for entry in contents.entries if not entry.is_strange]
    name = word.rstrip("/")
    found = [entry for entry in contents.entries if entry.name == name or entry.name.startswith(f"{name}/")]
    if not found:
        raise InputError(
            f"--remove: expected {OLD}, {ALL} or a name of what is kept, found '{word}'; {_known(contents, word)}"
        )
    return found


def _known(contents: Contents, word: str) -> str:
    """The names that there are, those most like a word first."""
    likeness = {entry.name: SequenceMatcher(None, word, entry.name).ratio() for entry in contents.entries}
    names = sorted(likeness, key=lambda name: -likeness[name])
    if not names:
        return "nothing is kept"
    more = len(names) - _MOST_NAMES
    return f"there is {', '.join(names[:_MOST_NAMES])}{f' and {more} more' if more > 0 else ''}"


def _remove(path: Path) -> None:
    """
    Raises:
        InputError: somebody is writing to it.
        OSError: it cannot be removed.
    """
    if path.is_symlink():  # goes alone; what lies behind it is not ours
        path.unlink()
        return
    with alone(path, folder=False, wait=None):
        if not path.is_dir():
            path.unlink()
            return
        if holders(path):
            raise InputError("somebody is writing there", where=path)
        going = path
        if not path.name.endswith(INTERRUPTED):  # under its own name it is never seen in part
            going = path.with_name(f".{path.name}{INTERRUPTED}")
            if going.exists():
                shutil.rmtree(going)
            os.rename(path, going)
        shutil.rmtree(going)
