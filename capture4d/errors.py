"""The one exception that means "the input is at fault, not the program"."""


class InputError(ValueError):
    """Bad data from outside: a file, a frame, an argument.

    The message is one line that names the file, frame or argument, says what was expected, and what was found. The
    command line prints it without a traceback and exits with 1; every other exception is our own bug and keeps its
    traceback.
    """
