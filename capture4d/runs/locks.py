"""One command at a time for what it writes: a lock that ends with the process that holds it, however that ends."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from capture4d.errors import InputError

__all__ = ["LOCK", "alone"]

LOCK = ".capture4d.lock"
"""In a folder that is written to; of a single file, `.NAME` stands before it. It goes when the command ends; one that a
kill left behind holds nobody up."""
_POLL_S = 0.2
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""What a file system answers that knows no locks."""


@contextlib.contextmanager
def alone(output: Path, *, folder: bool, wait: bool | None = False) -> Iterator[None]:
    """Nobody else writes to a folder, or to a file, meanwhile.

    Args:
        folder: whether it is a folder; it is made, and goes again if nothing is written to it.
        wait: for whoever is writing to it, instead of refusing; None where nobody can say that it should.
    Raises:
        InputError: somebody is, and `wait` is off.
        OSError: nothing can be written there; names it.
    """
    output = output.resolve()
    place = output if folder else output.parent
    if folder and place.exists() and not place.is_dir():
        raise InputError("expected a folder to write to, found a file", where=output)
    made = [each for each in (place, *place.parents) if not each.exists()]
    place.mkdir(parents=True, exist_ok=True)
    lock = place / (LOCK if folder else f".{output.name}{LOCK}")
    try:
        handle = _waited_for(lock, output, wait)
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                lock.unlink()  # while it is held: whoever waits for it looks whether it is still there
            os.close(handle)
    finally:
        for each in made:
            with contextlib.suppress(OSError):
                each.rmdir()


def _waited_for(lock: Path, output: Path, wait: bool | None) -> int:
    told = False
    while (handle := _taken(lock)) is None:
        if not wait:
            option = "" if wait is None else ", or with --wait"
            raise InputError(
                f"another capture4d command is writing there; run this one when it has ended{option}", where=output
            )
        if not told:
            print(f"capture4d: waiting for the command that is writing to {output}", file=sys.stderr, flush=True)
            told = True
        time.sleep(_POLL_S)
    return handle


def _taken(lock: Path) -> int | None:
    """The open lock file, None if another process holds it."""
    while True:
        try:
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(lock.parent)) from None
        try:
            _lock(handle)
            if _is_still(handle, lock):
                return handle
        except BlockingIOError:
            os.close(handle)
            return None
        except OSError as error:
            if error.errno in _NO_LOCKS:
                return handle
            os.close(handle)
            raise OSError(error.errno, error.strerror or str(error), str(lock)) from error
        os.close(handle)


def _is_still(handle: int, lock: Path) -> bool:
    """Whether a lock file is that of the folder, and not one that its holder has removed meanwhile."""
    try:
        there = lock.stat()
    except FileNotFoundError:
        return False
    return os.path.samestat(there, os.fstat(handle))


if sys.platform == "win32":
    import msvcrt

    def _lock(handle: int) -> None:
        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        except OSError as error:
            raise BlockingIOError from error
else:
    import fcntl

    def _lock(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
