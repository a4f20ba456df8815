"""Arrays in npz and npy files: without pickle, and every fault an InputError that names the file.

A header may claim any size. What it claims is compared with the bytes that are there before memory is asked for.
"""

from __future__ import annotations

import contextlib
import io
import math
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.errors import InputError
from capture4d.files.reading import one_line, reading
from capture4d.types import Mesh

__all__ = ["DEFLATE_RATIO", "ArrayFile", "map_array", "mesh_arrays"]

DEFLATE_RATIO = 1032
"""Nothing that deflate packed is longer than this many times its bytes (zlib's technical notes)."""

_BELIEVED, _USUAL_RATIO = 1 << 28, 100
"""Bytes that a member may always unpack to, and how much longer than packed it may be beyond: honest arrays of that
size are not all zeros."""
_LONGEST_HEADER = 1 << 16
_SMALL = 1 << 16
"""Entries along an axis that are believed of an array without bytes."""
_CHUNK = 1 << 24


class _NotPlainError(InputError):
    """An array of Python objects or records."""


def mesh_arrays(prefix: str, mesh: Mesh) -> dict[str, np.ndarray]:
    arrays = {f"{prefix}vertices": mesh.vertices, f"{prefix}faces": mesh.faces}
    return arrays if mesh.uv is None else {**arrays, f"{prefix}uv": mesh.uv}


class ArrayFile:
    """An open npz file in which everything that is wrong becomes an InputError that names the file.

    Its `with` is also a `reading` of the file: what is made of the arrays inside it may fail, and names the file too.
    """

    def __init__(self, path: str | Path, data: bytes | None = None, *, kind: str = "npz file") -> None:
        """`data`: what the file holds, if it was read already."""
        self._path, self._data, self._kind = Path(path), data, kind

    def __enter__(self) -> ArrayFile:
        with contextlib.ExitStack() as opened:
            opened.enter_context(reading(self._path, self._kind))
            self._archive = zipfile.ZipFile(self._path if self._data is None else io.BytesIO(self._data))
            self._bytes = self._path.stat().st_size if self._data is None else len(self._data)
            found = [(info.filename.removesuffix(".npy"), info) for info in self._archive.infolist()]
            self._members = {name: info for name, info in found if name != info.filename}
            if len(self._members) < sum(name != info.filename for name, info in found):
                raise InputError("expected every array once, found one twice")
            if sum(info.compress_size for _, info in found) > self._bytes:
                raise InputError(f"damaged, its arrays claim more than the {self._bytes} bytes that it has")
            self._opened = opened.pop_all()
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self._archive.close()
        self._opened.__exit__(kind, error, trace)

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._members:
            raise InputError(
                f"expected an array '{name}', found {', '.join(self._members) or 'none'}", where=self._path
            )
        info = self._members[name]
        try:
            if info.compress_size > self._bytes or info.file_size > DEFLATE_RATIO * info.compress_size + 64:
                raise InputError(f"{info.compress_size} of {self._bytes} bytes that claim to be {info.file_size}")
            if info.file_size > max(_BELIEVED, _USUAL_RATIO * info.compress_size):
                raise InputError(f"{info.compress_size} bytes that unpack to {info.file_size}, more than is believed")
            with self._archive.open(info) as file:
                assert isinstance(file, io.BufferedIOBase)
                return _read_array(file, info.file_size)
        except _NotPlainError as error:
            raise _NotPlainError(f"damaged array '{name}' ({error.reason})", where=self._path) from None
        except MemoryError:
            raise InputError(f"array '{name}' is too large for the memory there is", where=self._path) from None
        except OSError as error:
            if error.errno is not None:
                raise
            raise InputError(f"damaged array '{name}' ({one_line(error)})", where=self._path) from error
        except Exception as error:  # zip, zlib and numpy have a dozen for what a damaged file holds
            raise InputError(f"damaged array '{name}' ({one_line(error)})", where=self._path) from error

    def names_of_arrays(self) -> tuple[str, ...]:
        return tuple(self._members)

    def get(self, name: str) -> np.ndarray | None:
        return self[name] if name in self._members else None

    def numbers(self) -> dict[str, np.ndarray]:
        """All arrays of numbers; whatever else the file holds is passed over."""
        found = {}
        for name in self._members:
            with contextlib.suppress(_NotPlainError):
                found[name] = self[name]
        return {name: array for name, array in found.items() if array.dtype.kind in "biuf"}

    def real(self, name: str) -> np.ndarray:
        """An array of numbers, as float64."""
        value = self[name]
        if value.dtype.kind not in "iuf":
            raise InputError(f"'{name}': expected numbers, found {value.dtype}", where=self._path)
        return value.astype(np.float64)

    def number(self, name: str) -> float:
        """A single number; arrays of one will do."""
        value = self[name]
        if value.size != 1 or value.dtype.kind not in "iuf":
            raise InputError(
                f"'{name}': expected one number, found {value.dtype} of shape {value.shape}", where=self._path
            )
        return float(value.reshape(-1)[0])

    def names(self, name: str) -> tuple[str, ...]:
        value = self[name]
        if value.ndim != 1 or value.dtype.kind != "U":
            raise InputError(
                f"'{name}': expected a list of names, found {value.dtype} of shape {value.shape}", where=self._path
            )
        return tuple(str(entry) for entry in value)

    def prefixed(self, prefix: str) -> dict[str, np.ndarray]:
        return {name.removeprefix(prefix): self[name] for name in self._members if name.startswith(prefix)}

    def mesh(self, prefix: str) -> Mesh:
        return Mesh(self[f"{prefix}vertices"], self[f"{prefix}faces"], self.get(f"{prefix}uv"))


def map_array(path: str | Path, *, expected: str = "an array", absent: str = "no such file") -> np.ndarray:
    """The array of an npy file, read-only, which stays on disk until it is touched.

    Args:
        expected: what it should hold, for the message.
        absent: what to say of a file that is not there.
    Raises:
        InputError: the file is missing or damaged.
    """
    path = Path(path)
    with reading(path, "npy file", absent=absent):
        try:
            with path.open("rb") as file:
                shape, _, dtype = _header(file)
                there = path.stat().st_size - file.tell()
        except (ValueError, EOFError, SyntaxError) as error:
            raise InputError(f"expected {expected}, found a damaged file ({one_line(error)})") from error
        needed = _bytes_of(shape, dtype)
        if not shape or needed != there:
            found = f"{shape} of {dtype}, {needed} bytes, of which {there} are there"
            raise InputError(f"expected {expected}, found a damaged file ({found})")
        return np.load(path, mmap_mode="r" if there else None, allow_pickle=False)


def _read_array(file: io.BufferedIOBase, length: int) -> np.ndarray:
    shape, fortran_order, dtype = _header(file)
    expected, there = _bytes_of(shape, dtype), length - file.tell()
    if expected != there:
        raise InputError(f"expected {shape} of {dtype}, {expected} bytes, found {there}")
    flat = np.empty(math.prod(shape), dtype)
    into, filled = flat.view(np.uint8).data if expected else memoryview(b""), 0
    while filled < expected:
        if not (read := file.readinto(into[filled : filled + _CHUNK])):
            raise InputError(f"expected {expected} bytes, found {filled}")
        filled += read
    file.read(1)  # the checksum is compared at the end
    return flat.reshape(shape[::-1]).T if fortran_order else flat.reshape(shape)


def _bytes_of(shape: tuple[int, ...], dtype: np.dtype) -> int:
    """How long an array is; one of many entries that take no bytes is refused."""
    count = math.prod(shape)
    if (count and not dtype.itemsize) or (not count and max(shape) > _SMALL):
        raise InputError(f"expected an array, found {shape} of {dtype}, which has no bytes")
    return count * dtype.itemsize


def _header(file: io.BufferedIOBase) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, order and type, as they stand at the head of an npy file."""
    version = np.lib.format.read_magic(file)
    begin, width = file.tell(), 2 if version == (1, 0) else 4
    if (size := int.from_bytes(file.read(width), "little")) > _LONGEST_HEADER:
        raise InputError(f"expected a header of at most {_LONGEST_HEADER} bytes, found {size}")
    file.seek(begin)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a header is old, or has a strange escape
        if version == (1, 0):
            shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(file)
        elif version == (2, 0):
            shape, fortran_order, dtype = np.lib.format.read_array_header_2_0(file)
        else:
            raise InputError(f"expected version 1.0 or 2.0 of the npy format, found {version}")
    if any(side < 0 or isinstance(side, bool) for side in shape):
        raise InputError(f"expected a shape, found {shape}")
    if dtype.kind not in "biufcSU":
        raise _NotPlainError(f"expected numbers or text, found {dtype}")
    return shape, fortran_order, dtype
