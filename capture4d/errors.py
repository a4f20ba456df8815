"""The exception that means "the input is at fault, not the program", and three faults that callers tell apart."""

__all__ = ["EmptyMeshError", "InputError", "NotFiniteError", "StaleError"]


class InputError(ValueError):
    """Bad data from outside: a file, a frame, an argument.

    The message is one line that names the file, frame or argument, says what was expected, and what was found. The
    command line prints it without a traceback and exits with 1; every other exception is our own bug and keeps its
    traceback.
    """


class EmptyMeshError(InputError):
    """A mesh without faces."""


class NotFiniteError(InputError):
    """NaN or infinity among numbers that have to be finite."""


class StaleError(InputError):
    """A stage's earlier output, made with other settings or from other inputs."""
