"""How much address space the system gives this process (`ulimit -v`), and how much commands need to begin with."""

from __future__ import annotations

import sys

from capture4d.errors import InputError

__all__ = ["memory_fault", "require_address_space"]

_LIGHT = ("check-rig", "convert-body", "convert-poses", "convert-rig", "doctor")
_MIDDLE = ("cache", "calibrate", "check", "extract", "register", "register-mesh", "template")
_NEEDED = {**dict.fromkeys(_LIGHT, 0.4e9), **dict.fromkeys(_MIDDLE, 1.0e9)}
_MOST = 2.5e9
"""Bytes that a small take takes, libraries included, as VmPeak of /proc/self/status has it; the rest loads torch."""
_NOT_LOADED = ("failed to map segment", "cannot allocate memory", "cannot map")
"""What the loader says of a library that does not fit in."""


def require_address_space(command: str) -> None:
    """
    Raises:
        InputError: the command would only crash, or its libraries would, page by page.
    """
    limit, needed = _limit(), _NEEDED.get(command, _MOST)
    if limit is not None and limit < needed:
        raise InputError(f"{_told(limit)}; capture4d {command} needs {needed / 1e9:g} GB and more for large files")


def memory_fault(error: BaseException) -> str | None:
    """What to say of memory that was asked for and not given; None of another fault."""
    unloaded = isinstance(error, ImportError | OSError) and any(each in str(error).lower() for each in _NOT_LOADED)
    if not isinstance(error, MemoryError) and not unloaded:
        return None
    limit = _limit()
    given = "the machine has no more" if limit is None else _told(limit)
    return f"out of memory: {given}; with fewer --workers, or more memory, the same command goes on"


def _told(limit: int) -> str:
    return f"the system gives this process at most {limit / 1e9:.3g} GB of address space (ulimit -v)"


def _limit() -> int | None:
    if sys.platform == "win32":
        return None
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit in (resource.RLIM_INFINITY, -1) else limit
