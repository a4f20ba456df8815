"""One command at a time for what it writes: a lock that ends with the process that holds it, however that ends."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import platform
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from capture4d.errors import InputError

__all__ = ["LOCK", "Holder", "alone", "holders"]

LOCK = ".capture4d.lock"
"""In a folder that is written to; of a single file, `.NAME` stands before it. It goes when the command ends; one that a
kill left behind holds nobody up."""
_POLL_S = 0.2
_LOOKS = 3
"""How often a lock is tried before its folder is said to be taken: whoever asks who holds it has it for a moment."""
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""What a file system answers that knows no locks."""


@dataclass(frozen=True, slots=True)
class Holder:
    """A command that is writing now, as far as its lock tells."""

    place: Path
    """The lock's."""
    command: str = ""
    process: int | None = None
    machine: str = ""
    since: str = ""
    """ISO 8601, UTC."""


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
            _sign(handle)
            yield
        finally:
            with contextlib.suppress(OSError):
                lock.unlink()  # while it is held: whoever waits for it looks whether it is still there
            os.close(handle)
    finally:
        for each in made:
            with contextlib.suppress(OSError):
                each.rmdir()


def holders(folder: Path) -> list[Holder]:
    """The commands that are writing to a folder, to those in it, or to files of it, at this moment."""
    locks = [path for pattern in (f"*{LOCK}", f"*/*{LOCK}") for path in sorted(folder.glob(pattern))]
    return [_holder(path) for path in locks if _is_held(path)]


def _is_held(lock: Path) -> bool:
    """Whether a process holds a lock; a file that a kill left behind nobody does."""
    try:
        handle = os.open(lock, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    except OSError:  # it has just ended, or it is somebody else's, of whom nothing can be known
        return False
    try:
        _lock(handle)
    except BlockingIOError:
        return True
    except OSError:  # of a file system that knows no locks
        return False
    finally:
        os.close(handle)
    return False


def _sign(handle: int) -> None:
    """Say in a lock who holds it: for people, and only where it can be written."""
    signature = {
        "command": " ".join(["capture4d", *sys.argv[1:]]),
        "process": os.getpid(),
        "machine": platform.node(),
        "since": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    with contextlib.suppress(OSError):
        os.ftruncate(handle, 0)
        os.write(handle, json.dumps(signature).encode())


def _holder(lock: Path) -> Holder:
    try:
        said = json.loads(lock.read_text(encoding="utf-8"))
        return Holder(lock, str(said["command"]), int(said["process"]), str(said["machine"]), str(said["since"]))
    except (OSError, ValueError, KeyError, TypeError):  # not signed, or, where locks forbid reading, not to be read
        return Holder(lock)


def _waited_for(lock: Path, output: Path, wait: bool | None) -> int:
    told, looks = False, 0
    while (handle := _taken(lock)) is None:
        looks += 1
        if not wait and looks < _LOOKS:
            time.sleep(_POLL_S)
            continue
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
