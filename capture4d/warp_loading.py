"""Import warp without its announcements."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from collections.abc import Iterator
from typing import Any

__all__ = ["import_warp"]


@functools.cache
def import_warp() -> Any:
    """The warp module, initialised. To be called before anything that imports warp itself (newton, anny)."""
    with _native_stderr_closed():  # on a machine without CUDA its library prints a warning that nothing switches off
        import warp

        warp.config.log_level = warp.LOG_ERROR  # or it prints each device and each compiled module
        warp.init()
    return warp


@contextlib.contextmanager
def _native_stderr_closed() -> Iterator[None]:
    """Drop what native code writes to stderr meanwhile; Python's own exceptions pass."""
    sys.stderr.flush()
    saved = os.dup(2)
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(sink)
