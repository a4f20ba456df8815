"""Numbers in the JSON of a glTF file."""

from __future__ import annotations

from typing import Any

import numpy as np

from capture4d.errors import InputError

__all__ = ["count_of", "extension", "numbers_of"]


def count_of(entry: dict[str, Any], name: str, default: int | None = None) -> int:
    """A whole number of an entry."""
    value = entry.get(name, default)
    if type(value) is float and value.is_integer():  # as some programs write all numbers
        value = int(value)
    if type(value) is not int or value < 0:
        raise InputError(f"{name}: expected a whole number, found {str(value)[:40]!r}")
    return value


def numbers_of(entry: dict[str, Any], name: str, default: np.ndarray) -> np.ndarray:
    """Numbers of an entry, as many as there are of the default."""
    try:
        found = np.asarray(entry.get(name, default))
    except ValueError:  # lists of several lengths
        found = np.zeros(0, object)
    if found.dtype.kind not in "iuf" or found.shape != default.shape or not np.isfinite(found).all():
        raise InputError(f"{name}: expected {len(default)} finite numbers, found {str(entry.get(name))[:40]}")
    return found.astype(np.float64)


def extension(entry: dict[str, Any], name: str) -> dict[str, Any] | None:
    """What an extension says of an entry, if it does."""
    found = entry.get("extensions")
    if not isinstance(found, dict) or name not in found:
        return None
    if not isinstance(found[name], dict):
        raise InputError(f"{name}: expected an object, found {str(found[name])[:40]!r}")
    return found[name]
