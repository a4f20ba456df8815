"""What a command that was ended by an exception says, and its exit code; of our own bugs nothing, they keep their
traceback."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Sequence

from capture4d.cli.exit_codes import BAD_COMMAND_LINE, BAD_INPUT, GOOD, INTERRUPTED, TERMINATED
from capture4d.errors import CommandLineError, InputError
from capture4d.runs.address_space import memory_fault

__all__ = ["TerminatedError", "answer_to", "complain"]

_DISK_ANSWERS = {
    errno.EACCES,
    errno.EDQUOT,
    errno.EEXIST,
    errno.EISDIR,
    errno.ENOENT,
    errno.ENOSPC,
    errno.ENOTDIR,
    errno.EPERM,
    errno.EROFS,
}
"""What a user's disk can answer; the message names the path, and a traceback would add nothing."""
_KEPT = "finished frames are kept, "
_GOES_ON = "the same command goes on"
_BEGINS_ANEW = "without --overwrite the same command goes on, with it it begins anew"


class TerminatedError(BaseException):
    """SIGTERM, which a scheduler sends to a job whose time is up."""


def complain(message: str, *, code: int = BAD_INPUT) -> int:
    """Say a line on stderr; the exit code."""
    print(f"capture4d: {' '.join(message.splitlines())}", file=sys.stderr)
    return code


def answer_to(error: BaseException, arguments: Sequence[str]) -> int | None:
    """Say what ended a command, and what its command line, typed again, would do; the exit code, None of a bug."""
    if isinstance(error, BrokenPipeError):  # whoever read our output, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return GOOD
    answer = _said(error)
    if answer is None:
        return None
    said, code = answer
    if "--overwrite" in arguments:
        said = said.replace(f"kept, {_GOES_ON}", f"kept; {_GOES_ON}").replace(_GOES_ON, _BEGINS_ANEW)
    return complain(said, code=code)


def _said(error: BaseException) -> tuple[str, int] | None:
    if isinstance(error, CommandLineError):
        return str(error), BAD_COMMAND_LINE
    if isinstance(error, InputError):
        return str(error), BAD_INPUT
    if isinstance(error, KeyboardInterrupt):
        return f"interrupted; {_KEPT}{_GOES_ON}", INTERRUPTED
    if isinstance(error, TerminatedError):
        return f"terminated; {_KEPT}{_GOES_ON}", TERMINATED
    out_of_memory = memory_fault(error)
    if out_of_memory is not None:
        return out_of_memory, BAD_INPUT
    if isinstance(error, OSError):
        if error.errno not in _DISK_ANSWERS or (error.filename is None and error.errno != errno.ENOSPC):
            return None
        kept = f"; {_KEPT}{_GOES_ON}" if error.errno == errno.ENOSPC else ""
        return f"{error.filename or 'output'}: {error.strerror}{kept}", BAD_INPUT
    if isinstance(error, RuntimeError):
        from capture4d.runs.workers import WorkerDied

        return (str(error), BAD_INPUT) if isinstance(error, WorkerDied) else None
    return None
