"""Frames that end the worker that does them, for want of memory say: after three of them such a frame is given up.

A worker leaves a note before each frame and removes it when the frame is done, so a note that is found tells of a
worker that has not come back. Notes are counted on a cluster alone, and of one command: here, the second worker that is
killed in a step ends the command, and whoever pulls the plug three times has said nothing about the frame.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

from capture4d.errors import InputError
from capture4d.files.atomic import TEMPORARY_SUFFIX

__all__ = ["MOST_KILLED", "begin_frame", "count_attempts", "end_frame", "end_frames"]

MOST_KILLED = 3
"""Workers that a frame may end."""

_command: str | None = None
"""Name of the command for which this process counts attempts; None counts none."""
_begun: set[Path] = set()
"""Files that this process has begun."""


def count_attempts(command: str | None) -> None:
    """Count from now on in this process, for a command by this name."""
    global _command
    _command = command


def begin_frame(path: Path) -> None:
    """Note that the file of a frame is about to be made.

    Raises:
        InputError: three workers have not come back from it.
    """
    note = _note(path)
    if note is None:
        return
    killed = note.stat().st_size if note.is_file() else 0
    if killed >= MOST_KILLED:
        raise InputError(f"{killed} workers of the cluster were ended while they worked on this frame")
    _begun.add(path)
    note.parent.mkdir(parents=True, exist_ok=True)
    with note.open("ab") as file:
        file.write(b".")


def end_frame(path: Path) -> None:
    """Note that it is done."""
    _begun.discard(path)
    note = _note(path)
    if note is not None:
        with contextlib.suppress(FileNotFoundError):
            note.unlink()


def end_frames() -> None:
    """Note that this process is at none any more: it has come back, if with a fault."""
    for path in [*_begun]:
        end_frame(path)


def _note(path: Path) -> Path | None:
    """Its name is that of a temporary file, which a stage sweeps when it is finished."""
    return None if _command is None else path.with_name(f".{path.name}-{_command}{TEMPORARY_SUFFIX}")
