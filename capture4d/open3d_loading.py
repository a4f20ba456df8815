"""Import open3d on a machine without system packages.

The open3d wheel links against libusb (for depth cameras), which slim Linux images lack, so that `import open3d` fails
with "libusb-1.0.so.0: cannot open shared object file". The pip package `libusb-package` carries that one library;
loading it first, by its soname, is enough.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
import sys
from typing import Any

__all__ = ["import_open3d"]


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
