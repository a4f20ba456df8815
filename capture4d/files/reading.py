"""What goes wrong inside a file that is being read becomes one line that names it."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from contextvars import ContextVar
from os import PathLike, fspath
from pathlib import Path, PurePath, PureWindowsPath

import numpy as np

from capture4d.errors import InputError

__all__ = ["ALLOW_OUTSIDE", "companion", "companions_named", "one_line", "reading", "require_file", "shortened"]

ALLOW_OUTSIDE = "CAPTURE4D_ALLOW_OUTSIDE"
"""Variable of the environment, which worker processes inherit."""
_DEEPEST = 3
"""Folders above that of a mesh in which its capture.json may lie."""
_NO_FILES = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
_ABSENT = (errno.ENOENT, errno.ENOTDIR)
_MEANT_OF_THE_CONTENT = (errno.EINVAL, errno.EOVERFLOW)
"""What the system answers to a place in the file, or a size, that a damaged file named."""


@contextlib.contextmanager
def reading(path: str | PathLike[str], kind: str = "file", *, absent: str = "no such file") -> Iterator[None]:
    """Whatever fails while a file is read and parsed is an InputError of that file.

    Put it around reading and parsing alone: computing with what was read has faults of its own, which keep their
    traceback. An InputError that names a file already (a texture beside its mesh) keeps it. What the system says of a
    file that is there (no permission, a broken disk) stays an OSError.

    Args:
        kind: what was expected, as in "npz file".
        absent: what to say of a file that is not there.
    """
    require_file(path, kind)
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # no numbers are found by what checks them
            yield
    except InputError as error:
        if error.where is not None:
            raise
        error.reason = shortened(error.reason)
        raise error.at(path) from None
    except Warning:  # one that was made an exception says something about us, not about the file
        raise
    except OSError as error:
        if error.errno in _ABSENT:
            raise InputError(absent, where=path) from None
        if error.errno == errno.EISDIR:
            raise InputError(f"expected a {kind}, found a folder", where=path) from None
        if error.errno is not None and error.errno not in _MEANT_OF_THE_CONTENT:
            raise
        raise _damaged(path, kind, error) from error
    except Exception as error:
        raise _damaged(path, kind, error) from error


def one_line(error: BaseException) -> str:
    """What an exception says, without its line breaks and at most 200 characters of it."""
    return shortened(" ".join(f"{error}".split()), 200) or type(error).__name__


def shortened(text: str, most: int = 500) -> str:
    """A text that a message can hold: what a file has in it may be of any length."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def companion(path: Path, name: str, what: str) -> Path:
    """The file that another file names: in its folder or below, or, for a capture's, anywhere in the capture.

    Links are followed before that is judged. CAPTURE4D_ALLOW_OUTSIDE=1, which `--allow-outside` sets, lets a name lead
    anywhere.

    Args:
        name: as it stands in the file.
        what: what it is to that file, as in "texture".
    Raises:
        InputError: there is no such file, or the name leads elsewhere, or to what is no file: a file from a stranger
            does not say what is read on this machine.
    """
    found = path.parent / name
    absolute = PurePath(name).is_absolute() or PureWindowsPath(name).drive
    if "\0" in name:
        raise InputError(f"expected the name of a {what}, found {shortened(repr(name), 200)}", where=path)
    if os.environ.get(ALLOW_OUTSIDE) != "1" and (absolute or not _within(found, path.parent)):
        told = shortened(repr(name), 200)
        raise InputError(
            f"expected the {what} beside it or in a folder below, found {told}; --allow-outside reads it all the same",
            where=path,
        )
    named = _named.get()
    if named is not None:
        named.add(found)
    require_file(found, what)
    if not found.is_file():
        raise InputError(f"no such file, the {what} of {path.name}", where=found)
    return found


@contextlib.contextmanager
def companions_named() -> Iterator[set[Path]]:
    """The files that those which are read inside name and may read, whether or not they are there."""
    named: set[Path] = set()
    token = _named.set(named)
    try:
        yield named
    finally:
        _named.reset(token)


_named: ContextVar[set[Path] | None] = ContextVar("companions that are named", default=None)


def require_file(path: str | PathLike[str], kind: str) -> None:
    """Raises InputError where something is there that is neither file nor folder: opening a pipe waits for its writer,
    and a device has no end."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # whoever opens it says what is wrong
        return
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        found = next((name for test, name in _NO_FILES if test(mode)), "something else")
        raise InputError(f"expected a {kind}, found {found}", where=path)


def _within(found: Path, folder: Path) -> bool:
    """Whether a path, its links followed, lies in a folder, or in the capture that the folder belongs to."""
    try:
        place, folder = found.resolve(), folder.resolve()
    except (OSError, RuntimeError):  # links that go in circles
        return False
    nearest = [folder, *folder.parents][: 1 + _DEEPEST]
    above = next((each for each in nearest if (each / "capture.json").is_file()), folder)
    return place.is_relative_to(folder) or place.is_relative_to(above)


def _damaged(path: str | PathLike[str], kind: str, error: Exception) -> InputError:
    says = "too large for the memory there is" if isinstance(error, MemoryError) else one_line(error)
    if isinstance(error, (KeyError, IndexError, TypeError, AttributeError)):  # their text alone says little
        says = f"{type(error).__name__}: {says}"
    return InputError(f"not a readable {kind}, cut off or damaged ({says})", where=fspath(path))
