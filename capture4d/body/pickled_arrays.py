"""The arrays of a pickle, read without unpickling: nothing is imported, called or built that the file names.

Body models are handed out as pickles of numpy arrays, SciPy sparse matrices and chumpy wrappers. A pickle is a small
program, and even one that may build numpy objects only can crash the process, because their flags are part of it. So
its instructions are followed here on plain values, objects stay names with what they were given, and arrays are made at
the end of shape, type letter and raw bytes.
"""

from __future__ import annotations

import codecs
import io
import math
import pickletools
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.errors import InputError
from capture4d.files.reading import reading

__all__ = ["read_pickled_arrays"]

_NAMES = {
    "numpy": ("_reconstruct", "ndarray", "dtype", "scalar", "_frombuffer"),
    "_codecs": ("encode",),
    "copy_reg": ("_reconstructor", "__newobj__"),
    "copyreg": ("_reconstructor", "__newobj__"),
    "__builtin__": ("object", "bytes"),
    "builtins": ("object", "bytes"),
}
"""What such files name, by package; of chumpy and scipy anything."""
_INSTRUCTIONS = {known.code: known for known in pickletools.opcodes}
_MOST = 100_000_000
"""Entries of a sparse matrix, zeros included."""


@dataclass(slots=True, eq=False)
class _Object:
    """An object that was not built: its class or function, and what it was given."""

    name: str
    given: tuple[Any, ...] = ()
    state: Any = None


class _Mark:
    pass


_MARK = _Mark()


def read_pickled_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of numbers in a pickled dictionary, by their keys; whatever else it holds is passed over.

    Raises:
        InputError: the file is missing or damaged, holds no dictionary, or names anything but arrays.
    """
    with reading(path, "pickle of arrays"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of odd escapes in its text
        found = _Machine(path.read_bytes()).run()
        if not isinstance(found, dict):
            raise InputError(f"expected a dictionary of arrays, found {type(found).__name__}")
        arrays = {name: _array(value) for name, value in found.items() if isinstance(name, str)}
        return {name: array for name, array in arrays.items() if array is not None}


class _Machine:
    """Pickle's stack machine, on plain values."""

    def __init__(self, data: bytes) -> None:
        self._stream = io.BytesIO(data)
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def run(self) -> Any:
        """The value that is left at the end."""
        while True:
            code = self._stream.read(1)
            known = _INSTRUCTIONS.get(code.decode("latin1"))
            if known is None:
                raise InputError("cut off, or not a pickle")
            if known.name == "STOP":
                return self._stack.pop()
            self._step(known.name, self._argument(known))

    def _argument(self, known: Any) -> Any:
        if known.name == "STRING":  # bytes of Python 2, which pickletools takes for ASCII
            quoted = self._stream.readline().strip()
            return getattr(codecs, "escape_decode")(quoted[1:-1])[0].decode("latin1")  # noqa: B009 (typeshed has no such name)
        return None if known.arg is None else known.arg.reader(self._stream)

    def _step(self, name: str, argument: Any) -> None:
        stack = self._stack
        match name:
            case "PROTO" | "FRAME":
                pass
            case "MARK":
                stack.append(_MARK)
            case "POP":
                stack.pop()
            case "POP_MARK":
                self._marked()
            case "DUP":
                stack.append(stack[-1])
            case "NONE":
                stack.append(None)
            case "NEWTRUE" | "NEWFALSE":
                stack.append(name == "NEWTRUE")
            case "PUT" | "BINPUT" | "LONG_BINPUT":
                self._memo[argument] = stack[-1]
            case "MEMOIZE":
                self._memo[len(self._memo)] = stack[-1]
            case "GET" | "BINGET" | "LONG_BINGET":
                stack.append(self._memo[argument])
            case _ if argument is not None and name not in ("GLOBAL", "INST"):
                if name.startswith(("PERSID", "EXT")):
                    raise _refused(name)
                stack.append(argument)
            case _:
                if not self._collect(name):
                    self._object(name, argument)

    def _collect(self, name: str) -> bool:
        """Lists, tuples and dictionaries."""
        stack = self._stack
        match name:
            case "EMPTY_LIST":
                stack.append([])
            case "EMPTY_TUPLE":
                stack.append(())
            case "EMPTY_DICT":
                stack.append({})
            case "LIST":
                stack.append(self._marked())
            case "TUPLE":
                stack.append(tuple(self._marked()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                stack.append(tuple(self._taken(int(name[-1]))))
            case "DICT":
                entries = self._marked()
                stack.append({})
                self._set(entries)
            case "APPEND" | "APPENDS":
                entries = self._taken(1) if name == "APPEND" else self._marked()
                if isinstance(stack[-1], list):
                    stack[-1].extend(entries)
            case "SETITEM" | "SETITEMS":
                self._set(self._taken(2) if name == "SETITEM" else self._marked())
            case _:
                return False
        return True

    def _object(self, name: str, argument: Any) -> None:
        """Names, what is called with arguments, and what is given a state."""
        stack = self._stack
        match name:
            case "GLOBAL":
                stack.append(_named(*argument.split(" ", 1)))
            case "STACK_GLOBAL":
                module, attribute = self._taken(2)
                stack.append(_named(str(module), str(attribute)))
            case "INST":
                given = self._marked()
                stack.append(_Object(_named(*argument.split(" ", 1)).name, tuple(given)))
            case "OBJ":
                made, *given = self._marked()
                stack.append(_called(made, tuple(given)))
            case "REDUCE" | "NEWOBJ":
                made, given = self._taken(2)
                stack.append(_called(made, given))
            case "NEWOBJ_EX":
                made, given, _ = self._taken(3)
                stack.append(_called(made, given))
            case "BUILD":
                state = stack.pop()
                if isinstance(stack[-1], _Object):
                    stack[-1].state = state
            case _:
                raise _refused(name)

    def _taken(self, count: int) -> list[Any]:
        taken = self._stack[len(self._stack) - count :] if len(self._stack) >= count else []
        if len(taken) < count or any(value is _MARK for value in taken):
            raise InputError("damaged, expected more on its stack")
        del self._stack[len(self._stack) - count :]
        return taken

    def _marked(self) -> list[Any]:
        marked: list[Any] = []
        while (value := self._stack.pop()) is not _MARK:
            marked.append(value)
        return marked[::-1]

    def _set(self, entries: list[Any]) -> None:
        if isinstance(self._stack[-1], dict):
            # Other keys tell no array apart, and hashing what a stranger nested deeply can overflow the C stack.
            pairs = zip(entries[::2], entries[1::2], strict=True)
            self._stack[-1].update((key, value) for key, value in pairs if isinstance(key, (str, int)))


def _named(module: str, name: str) -> _Object:
    package = module.split(".")[0]
    if package not in ("chumpy", "scipy") and name not in _NAMES.get(package, ()):
        raise InputError(f"expected only arrays in the pickle, found {module}.{name}"[:200])
    return _Object(package if package in ("chumpy", "scipy") else name)


def _called(made: Any, given: Any) -> _Object:
    if not isinstance(made, _Object) or not isinstance(given, tuple):
        raise InputError("damaged, expected a name and its arguments on its stack")
    if made.name in ("_reconstructor", "__newobj__") and given and isinstance(given[0], _Object):
        return _Object(given[0].name, given[1:])
    return _Object(made.name, given)


def _refused(name: str) -> InputError:
    return InputError(f"expected only arrays in the pickle, found the instruction {name}")


# --- arrays ------------------------------------------------------------------------------------------------------


def _array(value: Any) -> np.ndarray | None:
    """The numbers of a numpy array, a sparse matrix or a chumpy wrapper, in an array made here; None for others."""
    if not isinstance(value, _Object):
        return None
    if value.name == "_reconstruct" and isinstance(value.state, tuple) and len(value.state) == 5:
        _, shape, kind, column_major, raw = value.state
        return _numbers(raw, kind, shape, "F" if column_major else "C")
    if value.name == "_frombuffer" and len(value.given) == 4:
        raw, kind, shape, order = value.given
        return _numbers(raw, kind, shape, "F" if order == "F" else "C")
    if not isinstance(value.state, dict):
        return None
    if "indptr" in value.state:
        return _dense(value.state)
    inner = value.state.get("x")  # of chumpy
    return None if isinstance(inner, _Object) and isinstance(inner.state, dict) else _array(inner)


def _numbers(raw: Any, kind: Any, shape: Any, order: str) -> np.ndarray | None:
    letter = kind.given[0] if isinstance(kind, _Object) and kind.name == "dtype" and kind.given else None
    if not isinstance(letter, str) or letter.lstrip("<>=|") not in _LETTERS:
        return None
    state = kind.state if isinstance(kind.state, tuple) and len(kind.state) > 1 else (None, "=")
    dtype = np.dtype(letter.lstrip("<>=|")).newbyteorder(">" if ">" in (state[1], letter[0]) else "<")
    if isinstance(raw, _Object) and raw.name in ("encode", "bytes"):  # bytes, as protocols 0 to 2 write them
        raw = raw.given[0] if raw.given else b""
    data = raw.encode("latin1") if isinstance(raw, str) else raw
    if not isinstance(data, (bytes, bytearray)) or not isinstance(shape, tuple):
        raise InputError("damaged, expected the bytes of an array and its shape")
    if any(type(side) is not int or side < 0 for side in shape) or math.prod(shape) * dtype.itemsize != len(data):
        raise InputError(f"expected an array of shape {str(shape)[:80]}, found {len(data)} bytes")
    array = np.frombuffer(data, dtype)
    return (array.reshape(shape[::-1]).T if order == "F" else array.reshape(shape)).astype(dtype.newbyteorder("="))


_LETTERS = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")


def _dense(state: dict[str, Any]) -> np.ndarray:
    """A compressed sparse matrix with all its zeros."""
    shape = state.get("_shape", state.get("shape"))
    starts, indices, data = (_array(state.get(name)) for name in ("indptr", "indices", "data"))
    if starts is None or indices is None or data is None or not isinstance(shape, tuple) or len(shape) != 2:
        raise InputError("damaged, expected a sparse matrix of two axes")
    if any(type(side) is not int or side < 0 for side in shape) or math.prod(shape) > _MOST:
        raise InputError(f"expected a sparse matrix of at most {_MOST} entries, found {str(shape)[:80]}")
    by_row = len(starts) == shape[0] + 1
    long, short = shape if by_row else shape[::-1]
    counts = np.diff(starts)
    fits = len(starts) == long + 1 and (counts >= 0).all() and counts.sum() == len(indices) == len(data)
    if not fits or (len(indices) and (indices.min() < 0 or indices.max() >= short)):
        raise InputError(f"expected the entries of a sparse matrix of {shape}, found others")
    dense = np.zeros((long, short), data.dtype)
    np.add.at(dense, (np.repeat(np.arange(long), counts), indices), data)
    return dense if by_row else dense.T
