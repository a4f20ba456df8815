"""Accessors: the numbers of a glTF file, of any component type, interleaved, normalised, sparse."""

from __future__ import annotations

from typing import Any

import numpy as np

from capture4d.errors import InputError
from capture4d.mesh_files.gltf.document import MOST, Document
from capture4d.mesh_files.gltf.entries import count_of

__all__ = ["accessor_values", "has_bytes", "normalised", "unpacked_values"]

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def accessor_values(document: Document, index: Any) -> np.ndarray:
    """(count, width): integers or float32, and float32 between -1 and 1 where integers are normalised."""
    accessor = document.entry("accessors", index)
    where = f"accessors[{index}]"
    kind, dtype = accessor.get("type"), _component(where, accessor)
    if kind not in _WIDTHS:
        raise InputError(f"{where}: expected a type of glTF, found {str(kind)[:40]!r}")
    count, width = count_of(accessor, "count"), _WIDTHS[kind]
    if accessor.get("bufferView") is not None:
        values = _values(document, where, accessor, count, width, dtype)
    else:
        values = document.zeros(where, count, width, dtype)
    if accessor.get("sparse") is not None:
        _put(document, f"{where}.sparse", accessor["sparse"], values)
    return normalised(values) if accessor.get("normalized") is True else values


def has_bytes(document: Document, index: Any) -> bool:
    """Whether an accessor is more than zeros."""
    accessor = document.entry("accessors", index)
    return accessor.get("bufferView") is not None or accessor.get("sparse") is not None


def unpacked_values(document: Document, index: Any, values: np.ndarray) -> np.ndarray:
    """What was decompressed elsewhere, as the accessor that stands for it says that it is meant."""
    accessor = document.entry("accessors", index)
    dtype = _component(f"accessors[{index}]", accessor)
    if values.dtype.kind in "iu" and dtype.kind in "iu":
        limits = np.iinfo(dtype)
        if values.size and (values.min() < limits.min or values.max() > limits.max):
            raise InputError(f"accessors[{index}]: expected numbers from {limits.min} to {limits.max}, found others")
        values = values.astype(dtype)
    return normalised(values) if accessor.get("normalized") is True else values


def normalised(values: np.ndarray) -> np.ndarray:
    """Integers as fractions; others as they are."""
    if values.dtype.kind not in "iu":
        return values
    return np.maximum(values / np.float64(np.iinfo(values.dtype).max), -1).astype(np.float32)


def _component(where: str, entry: dict[str, Any]) -> np.dtype:
    component = entry.get("componentType")
    if type(component) is not int or component not in _COMPONENTS:
        raise InputError(f"{where}: expected a component type of glTF, found {str(component)[:40]!r}")
    return np.dtype(_COMPONENTS[component])


def _values(
    document: Document, where: str, place: dict[str, Any], count: int, width: int, dtype: np.dtype
) -> np.ndarray:
    data, stride = document.view(place["bufferView"])
    row, offset = width * dtype.itemsize, count_of(place, "byteOffset", 0)
    stride = stride or row
    if stride < row:
        raise InputError(f"{where}: expected {row} bytes from one element to the next, found {stride}")
    needed = offset + (stride * (count - 1) + row if count else 0)
    if needed > len(data):
        raise InputError(f"{where}: expected {needed} bytes, found {len(data)}")
    if not count:
        return np.zeros((0, width), dtype)
    return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize)).copy()


def _put(document: Document, where: str, sparse: dict[str, Any], values: np.ndarray) -> None:
    """Replace some of the values."""
    count, indices = count_of(sparse, "count"), sparse["indices"]
    dtype = _component(where, indices)
    if dtype.kind != "u" or count > MOST:
        raise InputError(f"{where}: expected indices that are whole numbers, found {dtype}")
    rows = _values(document, where, indices, count, 1, dtype)[:, 0].astype(np.int64)
    if len(rows) and rows.max() >= len(values):
        raise InputError(f"{where}: expected indices from 0 to {len(values) - 1}, found {rows.max()}")
    values[rows] = _values(document, where, sparse["values"], count, values.shape[1], values.dtype)
