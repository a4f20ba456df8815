"""What goes wrong inside a file that is being read becomes one line that names it."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Iterator
from os import PathLike, fspath
from pathlib import Path, PurePath, PureWindowsPath

import numpy as np

from capture4d.errors import InputError

__all__ = ["companion", "one_line", "reading", "shortened"]

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
    """The file that another file names, beside it or below its folder.

    Args:
        name: as it stands in the file.
        what: what it is to that file, as in "texture".
    Raises:
        InputError: there is no such file, or the name leads elsewhere: a file from a stranger does not say what is
            read on this machine.
    """
    inside = PurePath(name)
    if "\0" in name or inside.is_absolute() or PureWindowsPath(name).drive or ".." in inside.parts:
        raise InputError(f"expected the {what} beside it or in a folder below, found {name!r}", where=path)
    found = path.parent / inside
    if not found.is_file():
        raise InputError(f"no such file, the {what} of {path.name}", where=found)
    return found


def _damaged(path: str | PathLike[str], kind: str, error: Exception) -> InputError:
    says = "too large for the memory there is" if isinstance(error, MemoryError) else one_line(error)
    if isinstance(error, (KeyError, IndexError, TypeError, AttributeError)):  # their text alone says little
        says = f"{type(error).__name__}: {says}"
    return InputError(f"not a readable {kind}, cut off or damaged ({says})", where=fspath(path))
