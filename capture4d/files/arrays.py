"""Arrays in an npz file: without pickle, and every fault an InputError that names the file."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.errors import InputError
from capture4d.types import Mesh

__all__ = ["ArrayFile", "mesh_arrays"]


def mesh_arrays(prefix: str, mesh: Mesh) -> dict[str, np.ndarray]:
    arrays = {f"{prefix}vertices": mesh.vertices, f"{prefix}faces": mesh.faces}
    return arrays if mesh.uv is None else {**arrays, f"{prefix}uv": mesh.uv}


class ArrayFile:
    """An open npz file in which everything that is wrong becomes an InputError that names the file."""

    def __init__(self, path: str | Path, data: bytes | None = None) -> None:
        """`data`: what the file holds, if it was read already."""
        self._path, self._data = Path(path), data

    def __enter__(self) -> ArrayFile:
        try:
            self._stream = self._path.open("rb") if self._data is None else io.BytesIO(self._data)
        except FileNotFoundError:
            raise InputError(f"{self._path}: no such file") from None
        try:
            self._arrays = np.load(self._stream, allow_pickle=False)
            self._names = self._arrays.files
        except (ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
            self._stream.close()
            raise InputError(f"{self._path}: not a readable npz file, cut off or damaged ({error})") from None
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self._stream.close()
        if isinstance(error, InputError) and not str(error).startswith(str(self._path)):
            raise InputError(f"{self._path}: {error}") from None

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._names:
            raise InputError(f"{self._path}: expected an array '{name}', found {', '.join(self._names) or 'none'}")
        try:
            return self._arrays[name]
        except (ValueError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(f"{self._path}: damaged array '{name}' ({error})") from None

    def get(self, name: str) -> np.ndarray | None:
        return self[name] if name in self._names else None

    def names(self, name: str) -> tuple[str, ...]:
        return tuple(str(entry) for entry in self[name])

    def prefixed(self, prefix: str) -> dict[str, np.ndarray]:
        return {name.removeprefix(prefix): self[name] for name in self._names if name.startswith(prefix)}

    def mesh(self, prefix: str) -> Mesh:
        return Mesh(self[f"{prefix}vertices"], self[f"{prefix}faces"], self.get(f"{prefix}uv"))
