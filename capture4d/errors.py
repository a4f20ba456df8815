"""The exception that means "the input is at fault, not the program", and faults that callers tell apart."""

from copy import copy
from os import PathLike, fspath
from typing import Any, TypeVar

__all__ = ["CommandLineError", "EmptyMeshError", "InputError", "NotFiniteError", "StaleError"]

Fault = TypeVar("Fault", bound="InputError")


class InputError(ValueError):
    """Bad data from outside: a file, a frame, an argument.

    The message is one line, whatever a file held, that names the file, frame or argument, says what was expected, and
    what was found. The command line prints it without a traceback and exits with 1. What the system answers about a
    file that is there (no permission, a full disk) stays an OSError, which it prints likewise; every other exception is
    our own bug and keeps its traceback.

    Attributes:
        reason: the message without the file.
        where: the file or folder that the message begins with, None if it names none.
        line: the line of that file, None if it names none.
    """

    def __init__(self, reason: str, *, where: str | PathLike[str] | None = None, line: int | None = None) -> None:
        self.reason, self.where, self.line = _one_line(reason), None if where is None else fspath(where), line
        place = "" if self.where is None else f"{self.where}: " if line is None else f"{self.where}:{line}: "
        super().__init__(_one_line(f"{place}{reason}"))

    def at(self: Fault, where: str | PathLike[str]) -> Fault:
        """The same fault, of that file or folder instead of the one it named."""
        moved = copy(self)
        InputError.__init__(moved, self.reason, where=where, line=self.line)
        return moved

    def __reduce__(self) -> tuple[Any, ...]:
        """Whole again on the other side of a process."""
        return _rebuilt, (type(self), {**self.__dict__})


class CommandLineError(InputError):
    """Something that a command needs was not given."""


class EmptyMeshError(InputError):
    """A mesh without faces."""


class NotFiniteError(InputError):
    """NaN or infinity among numbers that have to be finite."""


class StaleError(InputError):
    """A stage's earlier output, made with other settings or from other inputs."""


def _one_line(text: str) -> str:
    """A text from a file may hold line breaks, or what a terminal obeys: these are written out."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def _rebuilt(kind: type[InputError], state: dict[str, Any]) -> InputError:
    error = kind.__new__(kind)
    InputError.__init__(error, state["reason"], where=state["where"], line=state["line"])
    error.__dict__.update(state)
    return error
