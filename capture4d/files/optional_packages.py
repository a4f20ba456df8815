"""Packages that few users need and that are large: found when a file of their format is to be read or written."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from capture4d.errors import InputError

__all__ = [
    "ALEMBIC", "EXR", "ONNX", "ONNX_RUNTIME", "USD", "VISER", "is_installed", "package_module", "require_package",
]  # fmt: skip

USD, ALEMBIC = ("pxr", "usd"), ("alembic3d", "alembic")
ONNX, ONNX_RUNTIME = ("onnx", "onnx"), ("onnxruntime", "onnx")
EXR, VISER = ("OpenEXR", "exr"), ("viser", "view")
"""What is imported, and the extra of this project that installs it."""


def is_installed(package: tuple[str, str]) -> bool:
    """Whether there is such a package; it is not loaded."""
    return importlib.util.find_spec(package[0]) is not None


def require_package(package: tuple[str, str]) -> None:
    """
    Raises:
        InputError: it is not installed; says how it is installed.
    """
    if not is_installed(package):
        raise InputError(
            f"expected the Python package '{package[0]}', found none; run: pip install 'capture4d[{package[1]}]'"
        )


def package_module(package: tuple[str, str], name: str) -> Any:
    """A module of the package, such as "UsdGeom", or "" for the package itself; untyped, for it may be absent.

    Raises:
        InputError: it is not installed; says how it is installed.
    """
    require_package(package)
    return importlib.import_module(f"{package[0]}.{name}" if name else package[0])
