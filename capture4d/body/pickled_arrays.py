"""The arrays of a pickle, read without unpickling: nothing is imported, called or built that the file names.

Body models are handed out as pickles of numpy arrays, SciPy sparse matrices and chumpy wrappers. A pickle is a small
program, and even one that may build numpy objects only can crash the process, because their flags are part of it. So
its instructions are followed here on plain values, objects stay names with what they were given, and arrays are made at
the end of shape, type letter and raw bytes. Nothing that a few bytes can name many times over is copied, hashed or
printed as often: what a pickle costs grows with its length.
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
    "numpy": ("_reconstruct", "ndarray", "matrix", "dtype", "scalar", "_frombuffer"),
    "collections": ("OrderedDict",),
    "_codecs": ("encode",),
    "copy_reg": ("_reconstructor", "__newobj__"),
    "copyreg": ("_reconstructor", "__newobj__"),
    "__builtin__": ("object", "bytes"),
    "builtins": ("object", "bytes"),
}
"""What such files name, by package; of chumpy and scipy anything."""
_INSTRUCTIONS = {known.code: known for known in pickletools.opcodes}
_MOST = 20_000_000
"""Entries of all sparse matrices, zeros included; SMPL-X's regressor of joints has half a million."""
_LONGEST = {"key": 256, "arguments": 64, "axes": 32}
"""What no honest file exceeds."""


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
        data = path.read_bytes()
        found = _Machine(data).run()
        if not isinstance(found, dict):
            what = f"an object of {found.name}" if isinstance(found, _Object) else type(found).__name__
            raise InputError(f"expected a dictionary of arrays, found {what}")
        made = _Arrays(len(data))
        arrays = {name: made.array(value) for name, value in found.items()}
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
                return self._taken(1)[0]
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
                if not isinstance(module, str) or not isinstance(attribute, str):
                    raise InputError("damaged, expected the name of a class or function")
                stack.append(_named(module, attribute))
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
            short = ((key, value) for key, value in pairs if isinstance(key, str) and len(key) <= _LONGEST["key"])
            self._stack[-1].update(short)


def _named(module: str, name: str) -> _Object:
    package = module.split(".")[0]
    if package not in ("chumpy", "scipy") and name not in _NAMES.get(package, ()):
        raise InputError(f"expected only arrays in the pickle, found {module}.{name}"[:200])
    return _Object(package if package in ("chumpy", "scipy") else name)


def _called(made: Any, given: Any) -> Any:
    if not isinstance(made, _Object) or not isinstance(given, tuple):
        raise InputError("damaged, expected a name and its arguments on its stack")
    if len(given) > _LONGEST["arguments"]:
        raise InputError(f"expected the arguments of an array, found {len(given)} of them")
    if made.name == "OrderedDict":
        return {}
    if made.name in ("_reconstructor", "__newobj__") and given and isinstance(given[0], _Object):
        return _Object(given[0].name, given[1:])
    return _Object(made.name, given)


def _refused(name: str) -> InputError:
    return InputError(f"expected only arrays in the pickle, found the instruction {name}")


# --- arrays ------------------------------------------------------------------------------------------------------


class _Arrays:
    """Arrays made of what a pickle names: together no larger than it is, so that no byte of it serves twice."""

    def __init__(self, length: int) -> None:
        self._bytes_left, self._entries_left = length, _MOST
        self._made: dict[int, np.ndarray | None] = {}

    def array(self, value: Any) -> np.ndarray | None:
        """The numbers of a numpy array, a sparse matrix or a chumpy wrapper; None for others."""
        if not isinstance(value, _Object):
            return None
        if id(value) not in self._made:  # which the machine's dictionary keeps alive
            self._made[id(value)] = self._array(value)
        return self._made[id(value)]

    def _array(self, value: _Object) -> np.ndarray | None:
        if value.name == "_reconstruct" and isinstance(value.state, tuple) and len(value.state) == 5:
            _, shape, kind, column_major, raw = value.state
            return self._numbers(raw, kind, shape, "F" if column_major is True or column_major == 1 else "C")
        if value.name == "_frombuffer" and len(value.given) == 4:
            raw, kind, shape, order = value.given
            return self._numbers(raw, kind, shape, "F" if order == "F" else "C")
        if not isinstance(value.state, dict):
            return None
        if "indptr" in value.state:
            return self._compressed(value.state)
        if "row" in value.state or "coords" in value.state:
            return self._listed(value.state)
        inner = value.state.get("x")  # of chumpy
        return None if not isinstance(inner, _Object) or isinstance(inner.state, dict) else self.array(inner)

    def _numbers(self, raw: Any, kind: Any, shape: Any, order: str) -> np.ndarray | None:
        dtype = _number_type(kind)
        if dtype is None:
            return None
        if isinstance(raw, _Object) and raw.name in ("encode", "bytes"):  # bytes, as protocols 0 to 2 write them
            raw = raw.given[0] if raw.given else b""
        if not isinstance(raw, (bytes, bytearray, str)) or not isinstance(shape, tuple):
            raise InputError("damaged, expected the bytes of an array and its shape")
        self._bytes_left -= len(raw)
        if self._bytes_left < 0:
            raise InputError("expected arrays of bytes of their own, found some that share them")
        data = raw.encode("latin1") if isinstance(raw, str) else raw
        if not _is_shape(shape) or math.prod(shape) * dtype.itemsize != len(data):
            raise InputError(f"expected an array of shape {_said(shape)}, found {len(data)} bytes")
        array = np.frombuffer(data, dtype)
        return (array.reshape(shape[::-1]).T if order == "F" else array.reshape(shape)).astype(dtype.newbyteorder("="))

    def _compressed(self, state: dict[str, Any]) -> np.ndarray:
        """A matrix compressed by row or column, with all its zeros."""
        shape = self._matrix_shape(state)
        starts, indices, data = (self._row_of(state.get(name)) for name in ("indptr", "indices", "data"))
        by_row = len(starts) == shape[0] + 1
        long, short = shape if by_row else shape[::-1]
        counts = np.diff(starts)
        if len(starts) != long + 1 or (counts < 0).any() or not counts.sum() == len(indices) == len(data):
            raise InputError(f"expected the entries of a sparse matrix of {shape}, found others")
        dense = _filled((long, short), np.repeat(np.arange(long), counts), indices, data)
        return dense if by_row else dense.T

    def _listed(self, state: dict[str, Any]) -> np.ndarray:
        """A matrix as a list of entries, with all its zeros."""
        shape = self._matrix_shape(state)
        places = state.get("coords", (state.get("row"), state.get("col")))
        if not isinstance(places, tuple) or len(places) != 2:
            raise InputError("damaged, expected the rows and columns of a sparse matrix")
        rows, columns, data = (self._row_of(each) for each in (*places, state.get("data")))
        if not len(rows) == len(columns) == len(data):
            raise InputError(f"expected the entries of a sparse matrix of {shape}, found others")
        return _filled(shape, rows, columns, data)

    def _matrix_shape(self, state: dict[str, Any]) -> tuple[int, int]:
        shape = state.get("_shape", state.get("shape"))
        if not isinstance(shape, tuple) or len(shape) != 2:
            raise InputError("damaged, expected a sparse matrix of two axes")
        if not _is_shape(shape) or math.prod(shape) > self._entries_left:
            raise InputError(f"expected a sparse matrix of at most {_MOST} entries, found {_said(shape)}")
        self._entries_left -= math.prod(shape)
        return shape[0], shape[1]

    def _row_of(self, value: Any) -> np.ndarray:
        array = self.array(value)
        if array is None or array.ndim != 1:
            raise InputError("damaged, expected the entries of a sparse matrix")
        return array


def _filled(shape: tuple[int, int], rows: np.ndarray, columns: np.ndarray, data: np.ndarray) -> np.ndarray:
    for places, side in ((rows, shape[0]), (columns, shape[1])):
        if places.dtype.kind not in "iu" or (len(places) and not (places.min() >= 0 and places.max() < side)):
            raise InputError(f"expected the entries of a sparse matrix of {shape}, found others")
    dense = np.zeros(shape, data.dtype)
    np.add.at(dense, (rows, columns), data)
    return dense


def _number_type(kind: Any) -> np.dtype | None:
    """Of a type's letter and byte order, of which alone it is made; None for what are no numbers."""
    letter = kind.given[0] if isinstance(kind, _Object) and kind.name == "dtype" and kind.given else None
    if not isinstance(letter, str) or len(letter) > 4 or letter.lstrip("<>=|") not in _LETTERS:
        return None
    order = kind.state[1] if isinstance(kind.state, tuple) and len(kind.state) > 1 else "="
    return np.dtype(letter.lstrip("<>=|")).newbyteorder(">" if order == ">" or letter[0] == ">" else "<")


_LETTERS = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")


def _is_shape(shape: tuple[Any, ...]) -> bool:
    return len(shape) <= _LONGEST["axes"] and all(type(side) is int and 0 <= side < 2**40 for side in shape)


def _said(shape: tuple[Any, ...]) -> str:
    sides = [f"{side}" if type(side) is int and abs(side) < 2**63 else "?" for side in shape[:6]]
    return f"({', '.join(sides)}{', ...' if len(shape) > 6 else ''})"
