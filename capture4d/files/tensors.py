"""Arrays and a JSON note in one safetensors file: written whole or not at all, read without running code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from capture4d.errors import InputError
from capture4d.files.atomic import write_bytes
from capture4d.files.json_values import json_value
from capture4d.files.reading import reading, shortened

__all__ = ["TensorFile", "read_tensors", "write_tensors"]

_NOTE = "capture4d"
_PICKLE_STARTS = (b"\x80", b"PK\x03\x04")
"""A bare pickle, and the zip that torch.save writes."""


@dataclass(frozen=True, slots=True, eq=False)
class TensorFile:
    """What a file held."""

    path: Path
    tensors: Mapping[str, np.ndarray]
    note: Mapping[str, Any]

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.tensors:
            found = shortened(", ".join(self.tensors), 200) or "none"
            raise InputError(f"expected a tensor '{shortened(name, 80)}', found {found}", where=self.path)
        return self.tensors[name]

    def get(self, name: str) -> np.ndarray | None:
        return self[name] if name in self.tensors else None

    def prefixed(self, prefix: str) -> dict[str, np.ndarray]:
        """The tensors whose names begin so, without the beginning."""
        return {name.removeprefix(prefix): each for name, each in self.tensors.items() if name.startswith(prefix)}

    def entry(self, name: str) -> Any:
        """An entry of the note."""
        if name not in self.note:
            found = shortened(", ".join(self.note), 200) or "none"
            raise InputError(f"expected '{name}' in its note, found {found}", where=self.path)
        return self.note[name]


def write_tensors(path: str | Path, kind: str, tensors: Mapping[str, np.ndarray], note: Mapping[str, Any]) -> None:
    """Write arrays with a note, atomically. Equal arrays give equal bytes.

    Args:
        kind: what the file is, checked when it is read.
        note: whatever JSON holds.
    """
    text = json.dumps({"kind": kind, **note}, sort_keys=True, allow_nan=False)
    plain = {name: np.asarray(array, order="C") for name, array in tensors.items()}
    write_bytes(path, safetensors.numpy.save(plain, metadata={_NOTE: text}))


def read_tensors(path: str | Path, kind: str) -> TensorFile:
    """Read a file that `write_tensors` wrote.

    Raises:
        InputError: it is missing, cut off, a pickle or another kind of file.
    """
    path = Path(path)
    with reading(path, "safetensors file"):
        with path.open("rb") as stream:
            start = stream.read(4)
        try:
            with safetensors.safe_open(path, framework="numpy") as file:
                note = json_value((file.metadata() or {}).get(_NOTE, "{}"))
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        except InputError:
            raise
        except Exception as error:  # whatever the reader meets
            if start.startswith(_PICKLE_STARTS):  # a header of 128 bytes begins like a pickle, but it can be read
                raise InputError("expected a safetensors file, found a pickle or an archive, which is not opened"
                                 ) from None  # fmt: skip
            raise error
        if not isinstance(note, dict) or note.get("kind") != kind:
            found = note.get("kind") if isinstance(note, dict) else None
            raise InputError(f"expected {kind}, found {shortened(str(found or 'a file of somebody else'), 80)}")
    return TensorFile(path, tensors, note)
