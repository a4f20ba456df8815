"""What a command's exit code says: one table for all of them. A bug keeps its traceback, and Python's code 1."""

GOOD = 0
BAD_INPUT = 1
"""A file, a frame or an argument is wrong; one line says which."""
BAD_COMMAND_LINE = 2
"""No such command or option, something missing, or a value that cannot be read as what it should be."""
BAD_RESULT = 3
"""The work was done and its result is bad, or a limit is broken."""
INTERRUPTED = 130
"""By Ctrl-C; finished frames are kept."""
TERMINATED = 143
"""By SIGTERM, likewise."""
