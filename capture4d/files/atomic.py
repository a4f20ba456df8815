"""Files that are there whole or not at all, whatever kills the process that writes them."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.errors import InputError
from capture4d.files.json_values import json_value
from capture4d.files.reading import reading

__all__ = [
    "TEMPORARY_SUFFIX",
    "content_digest",
    "file_digest",
    "nan_to_none",
    "parse_json",
    "plain_value",
    "read_json",
    "read_json_lines",
    "write_bytes",
    "write_chunks",
    "write_json",
    "write_json_lines",
    "write_npy",
    "write_npy_rows",
    "write_npz",
]

TEMPORARY_SUFFIX = ".partial"
"""Of files that are being written; what a kill leaves of them is swept up by the next run."""


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file so that it is there whole or not at all, even if the process is killed.

    Raises:
        OSError: the disk is full or read-only; names the file. What stood at `path` before still stands.
    """
    write_chunks(path, [data])


def write_chunks(path: str | Path, chunks: Iterable[bytes | memoryview]) -> None:
    """`write_bytes` for more than memory should hold at once."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=TEMPORARY_SUFFIX, dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                for chunk in chunks:
                    file.write(chunk)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, 0o666 & ~_UMASK)
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(temporary)
            raise
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def _current_umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


_UMASK = _current_umask()


def write_json(path: str | Path, value: Any) -> None:
    """Write JSON for people to read, atomically. NaN is not JSON and raises ValueError."""
    write_bytes(path, (json.dumps(value, indent=2, allow_nan=False, default=plain_value) + "\n").encode())


def write_json_lines(path: str | Path, rows: Iterable[Mapping[str, Any]], *, sort_keys: bool = False) -> None:
    """Write a JSON object a line, atomically. NaN is not JSON and raises ValueError; see `nan_to_none`."""
    lines = (json.dumps(row, sort_keys=sort_keys, allow_nan=False, default=plain_value) + "\n" for row in rows)
    write_bytes(path, "".join(lines).encode())


def nan_to_none(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row as JSON can hold it: null where there is no finite number."""
    missing = {key for key, value in row.items() if isinstance(value, (float, np.floating)) and not np.isfinite(value)}
    return {key: None if key in missing else value for key, value in row.items()}


def write_npy(path: str | Path, array: np.ndarray) -> None:
    """Write one array, atomically."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    write_bytes(path, buffer.getvalue())


def write_npy_rows(path: str | Path, rows: Iterable[np.ndarray], *, count: int) -> None:
    """Write one array of `count` rows of equal shape and type, atomically, holding one row in memory at a time."""

    def chunks() -> Iterator[bytes | memoryview]:
        for index, row in enumerate(rows):
            if index == 0:
                header = io.BytesIO()
                described = np.lib.format.header_data_from_array_1_0(row)
                np.lib.format.write_array_header_1_0(
                    header, {**described, "fortran_order": False, "shape": (count, *row.shape)}
                )
                yield header.getvalue()
            yield np.ascontiguousarray(row).tobytes()

    write_chunks(path, chunks())


def write_npz(path: str | Path, **arrays: Any) -> None:
    """Write named arrays, uncompressed and atomically. Equal arrays give equal bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def read_json(path: str | Path, *, expected: str = "a JSON object") -> dict[str, Any]:
    """Read a JSON object; whatever is wrong with the file is an InputError that names it."""
    path = Path(path)
    with reading(path, "JSON file"):
        return _json_object(path.read_bytes(), expected)


def parse_json(data: bytes, path: Path) -> dict[str, Any]:
    """The object in a file's bytes; damage is an InputError that names the file."""
    with reading(path, "JSON file"):
        return _json_object(data)


def read_json_lines(path: str | Path) -> list[dict[str, Any]]:
    """Read a file with a JSON object a line; whatever is wrong with it is an InputError that names it and the line."""
    path = Path(path)
    rows = []
    with reading(path, "JSON file"), path.open(encoding="utf-8-sig") as lines:
        for number, line in enumerate(lines, start=1):
            try:
                rows.append(_json_object(line))
            except InputError as error:
                raise InputError(f"line {number}: {error.reason}") from None
    return rows


def _json_object(text: str | bytes, expected: str = "a JSON object") -> dict[str, Any]:
    found = json_value(text)
    if not isinstance(found, dict):
        raise InputError(f"expected {expected}, found {type(found).__name__}")
    return found


def file_digest(paths: Iterable[Path], *, root: Path) -> str:
    """SHA-256 over the names (relative to `root`) and contents of files, whatever order they come in."""
    parts = {}
    for path in paths:
        with path.open("rb") as file:
            parts[path.relative_to(root).as_posix()] = hashlib.file_digest(file, "sha256").hexdigest()
    return _joined_digest(parts)


def content_digest(files: Mapping[str, bytes]) -> str:
    """`file_digest` of files that were read already: contents by name."""
    return _joined_digest({name: hashlib.sha256(data).hexdigest() for name, data in files.items()})


def _joined_digest(parts: Mapping[str, str]) -> str:
    return hashlib.sha256("".join(f"{name}\0{part}\n" for name, part in sorted(parts.items())).encode()).hexdigest()


def plain_value(value: Any) -> Any:
    """What json.dumps does not know: configs, numpy scalars and arrays, paths."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")
