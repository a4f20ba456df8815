"""Import open3d, warp, anny, pycolmap and numba where they are needed: quietly, and so that they load at all, also
where neither the code nor the home of the user can be written to."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from capture4d.cache import cache_path, kernel_cache, user_cache_folder, usual_cache_path

__all__ = ["import_anny", "import_open3d", "import_pycolmap", "import_warp", "native_stderr_closed", "njit"]


@functools.cache
def import_open3d() -> Any:
    """The open3d module. Slow (about 1.5 s), so call it inside the function that needs it."""
    if sys.platform == "linux":
        try:
            ctypes.CDLL("libusb-1.0.so.0")
        except OSError:
            package = importlib.import_module("libusb_package")
            ctypes.CDLL(str(package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    return importlib.import_module("open3d")


@functools.cache
def import_pycolmap() -> Any:
    """The pycolmap module."""
    importlib.import_module("cv2")
    return importlib.import_module("pycolmap")


@functools.cache
def import_warp() -> Any:
    """The warp module, initialised. To be called before anything that imports warp itself (newton, anny)."""
    with native_stderr_closed():  # on a machine without CUDA its library prints a warning that nothing switches off
        import warp

        if "WARP_CACHE_PATH" not in os.environ and cache_path() != usual_cache_path():
            warp.config.kernel_cache_dir = str(user_cache_folder() / "warp")
        warp.config.log_level = warp.LOG_ERROR  # or it prints each device and each compiled module
        warp.init()
    return warp


@functools.cache
def import_anny() -> Any:
    """The anny module. It asks for a home as it is loaded, and is told the cache folder by a user without one."""
    import_warp()
    try:
        Path.home()
    except RuntimeError:  # neither HOME nor an entry among the users
        os.environ["HOME"] = str(cache_path())
        try:
            return importlib.import_module("anny")
        finally:
            del os.environ["HOME"]
    return importlib.import_module("anny")


def njit(**options: Any) -> Callable[[Any], Any]:
    """numba's decorator. What it compiles is kept beside the code, else in the cache folder, else not at all."""
    numba = _import_numba()

    def compiled(function: Any) -> Any:
        try:
            return numba.njit(**options)(function)
        except RuntimeError as error:  # "no locator available": it can be kept nowhere
            if "locator" not in str(error):
                raise
            return numba.njit(**{**options, "cache": False})(function)

    return compiled


@functools.cache
def _import_numba() -> Any:
    numba: Any = importlib.import_module("numba")
    folder = kernel_cache()
    if folder is not None and not os.environ.get("NUMBA_CACHE_DIR"):
        with contextlib.suppress(OSError):  # without it nothing is kept
            user_cache_folder()
        numba.core.config.CACHE_DIR = str(folder)
    return numba


@contextlib.contextmanager
def native_stderr_closed() -> Iterator[None]:
    """Drop what native code writes to stderr meanwhile; Python's own exceptions pass."""
    if sys.stderr is None:  # of a program without a console
        yield
        return
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
