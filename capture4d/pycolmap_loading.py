"""Import pycolmap without breaking OpenCV.

Both wheels carry a libpng. If pycolmap's comes first, `cv2.imwrite` of a PNG aborts the process ("free(): invalid
pointer", pycolmap 4.2.1 with OpenCV 5.0.0); with OpenCV first, both work.
"""

from __future__ import annotations

import functools
import importlib
from typing import Any

__all__ = ["import_pycolmap"]


@functools.cache
def import_pycolmap() -> Any:
    """The pycolmap module."""
    importlib.import_module("cv2")
    return importlib.import_module("pycolmap")
