"""What is done to the files of readers: bytes, words, numbers and lines; arrays and their headers; JSON and its shape.

A mutant is decided by a `random.Random` alone, so that a seed gives it again.
"""

from __future__ import annotations

import copy
import io
import json
import math
import random
import re
import struct
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np

__all__ = ["ARRAY_CHANGES", "JSON_VALUES", "NUMBERS", "WORDS", "damaged", "mutant", "with_arrays"]

NUMBERS = (
    b"-1", b"0", b"1", b"3", b"255", b"-2147483649", b"4294967296", b"99999999999999999999", b"1e999", b"1e39", b"nan",
    b"1.5", b"", b"x", b"null", b"[]", b"{}", b'"1"', b"[[1, 2], [3]]", b"true", b"Infinity", b"-0", b"1_0",
    "\N{ARABIC-INDIC DIGIT THREE}".encode(), b"9" * 5000,
)  # fmt: skip
"""What may stand instead of a number in a text."""
WORDS = tuple(
    struct.pack(form, value)
    for form, value in (
        ("<I", 0), ("<I", 0xFFFFFFFF), ("<I", 0x7FFFFFFF), ("<i", -3), ("<Q", 2**62), ("<Q", 2**64 - 1), ("<f", np.nan),
        ("<f", np.inf), ("<f", 1e30), ("<d", np.nan), ("<d", 1e300), ("<H", 0xFFFF), ("<B", 0x80), (">I", 2**31),
    )
)  # fmt: skip
"""What may stand instead of some bytes."""
JSON_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2.5, 2**31, 2**63, 10**30, -(10**30), 1e308, math.nan, math.inf, "", "x", "1", "../x",
    "\0", "a\nb", "x" * 5000, [], {}, [[]], [1, [2]], [None], {"x": 1}, [1e9] * 3, ["1"] * 3,
)  # fmt: skip
ARRAY_CHANGES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "number": lambda _: np.zeros(()),
    "nothing": lambda array: np.zeros(0, array.dtype),
    "no rows": lambda array: array[:0] if array.ndim else array,
    "doubles": lambda array: array.astype(np.float64) if array.dtype.kind in "biuf" else np.zeros(array.shape),
    "halves": lambda array: array.astype(np.float16) if array.dtype.kind == "f" else array,
    "bytes": lambda array: np.zeros(array.shape, np.uint8),
    "words": lambda array: np.full(array.shape, "x"),
    "complex": lambda array: np.zeros(array.shape, np.complex128),
    "booleans": lambda array: np.zeros(array.shape, bool),
    "NaN": lambda array: np.full_like(array, np.nan) if array.dtype.kind == "f" else array,
    "infinite": lambda array: np.full_like(array, np.inf) if array.dtype.kind == "f" else array,
    "very large": lambda array: np.full(array.shape, 1e300) if array.dtype.kind == "f" else array,
    "large floats": lambda array: np.full(array.shape, 3e38, np.float32) if array.dtype.kind == "f" else array,
    "zeros": lambda array: np.zeros_like(array),
    "negative": lambda array: np.full_like(array, -7) if array.dtype.kind in "if" else array,
    "largest": lambda array: np.full_like(array, np.iinfo(array.dtype).max) if array.dtype.kind in "iu" else array,
    "scaled": lambda array: array * 3 if array.dtype.kind in "iuf" else array,
    "an axis more": lambda array: array[None],
    "flat": lambda array: array.reshape(-1),
    "a row less": lambda array: array[:-1] if array.ndim else array,
    "a row twice": lambda array: np.concatenate([array[:1], array]) if array.ndim else array,
    "turned": lambda array: array.T,
    "last first": lambda array: array[::-1] if array.ndim else array,
    "big-endian": lambda array: array.astype(array.dtype.newbyteorder(">")),
    "objects": lambda array: np.full(array.shape, None),
    "no columns": lambda array: np.zeros((*array.shape[:1], 0, *array.shape[2:]), array.dtype) if array.ndim else array,
}
"""What may become of an array in an npz file."""
_TYPES = ("<f4", "<f8", ">f4", "<i4", "<i8", "|b1", "<U0", "<U5", "|V0", "|S0", "|S3", "<c8", "|O", "|V12", "<M8[s]",
          "x", "[('a', '<f4')]")  # fmt: skip
_SHAPES = ("()", "(0,)", "(10**9,)", "(1000000000000,)", "(3, 1000000000000, 0)", "(-1,)", "(2.0, 3)", "(True, 6, 3)",
           "(4611686018427387904, 4)", "(1,) * 70", "None", "((1,),)")  # fmt: skip


def mutant(chance: random.Random, name: str, files: dict[str, bytes]) -> tuple[str, dict[str, bytes]]:
    """A file damaged by chance, with what lies beside it, and what was done to it.

    Args:
        name: of the file that is damaged.
        files: all of them, whole.
    """
    data = files[name]
    ways = [_bytes, _bytes]
    if name.endswith(".npz"):
        ways += [_array, _array, _header, _archive]
    if name.endswith(".npy"):
        ways += [_npy_header]
    if name.endswith(".json"):
        ways += [_json, _json, _json]
    if name.endswith(".jsonl"):
        ways += [_json_line]
    if name.endswith((".glb", ".gltf")):
        ways += [_scene, _scene, _scene]
    if name.endswith(".safetensors"):
        ways += [_tensor_header, _tensor_header]
    if name.endswith(".ply"):
        ways += [_ply_header, _ply_header]
    said, changed = chance.choice(ways)(chance, data)
    return said, files | {name: changed}


# --- any file ------------------------------------------------------------------------------------------------------


def damaged(data: bytes, how: str, place: float, with_what: Any) -> bytes:
    """One damage.

    Args:
        place: from 0 to below 1, of the length.
        with_what: a bit to flip, a number of bytes to cut, bytes, or "twice" or "gone" of a line.
    """
    at = int(place * len(data))
    match how:
        case "flip" if data:
            return data[:at] + bytes([data[at] ^ (1 << with_what)]) + data[at + 1 :]
        case "cut":
            return data[:at] + data[at + with_what :]
        case "end":
            return data[:at]
        case "insert":
            return data[:at] + with_what + data[at:]
        case "number":
            found = list(re.finditer(rb"-?\d+(\.\d+)?(e[+-]?\d+)?", data))
            if not found:
                return data
            chosen = found[int(place * len(found))]
            return data[: chosen.start()] + with_what + data[chosen.end() :]
        case "word":
            return data[:at] + with_what + data[at + len(with_what) :]
        case "line":
            lines = data.splitlines(keepends=True) or [b""]
            row = int(place * len(lines))
            return b"".join(lines[:row] + lines[row : row + 1] * (2 if with_what == "twice" else 0) + lines[row + 1 :])
    return data


def _bytes(chance: random.Random, data: bytes) -> tuple[str, bytes]:
    said = []
    for _ in range(chance.choice((1, 1, 2, 3))):
        how = chance.choice(("flip", "cut", "end", "insert", "number", "number", "word", "line"))
        what: Any = {
            "flip": chance.randrange(8),
            "cut": chance.randrange(1, 41),
            "insert": chance.randbytes(chance.randrange(1, 7)),
            "number": chance.choice(NUMBERS),
            "word": chance.choice(WORDS),
            "line": chance.choice(("twice", "gone")),
        }.get(how)
        place = chance.random()
        data = damaged(data, how, place, what)
        said.append(f"{how} {str(what)[:40]} at {place:.3f}")
    return ", ".join(said), data


# --- arrays --------------------------------------------------------------------------------------------------------


def with_arrays(data: bytes, changed: dict[str, Any]) -> bytes:
    """An npz file with some of its arrays changed, or left out where they are None."""
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        arrays = dict(archive)
    arrays = {name: array for name, array in (arrays | changed).items() if array is not None}
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=True, **arrays)
    return stream.getvalue()


def _array(chance: random.Random, data: bytes) -> tuple[str, bytes]:
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        arrays = dict(archive)
    name, change = chance.choice(list(arrays)), chance.choice([*ARRAY_CHANGES, "gone", "entries", "entries"])
    if change == "gone":
        return f"{name} gone", with_arrays(data, {name: None})
    if change == "entries":
        flat = arrays[name].copy().reshape(-1)
        for _ in range(chance.randrange(1, 4)):
            if flat.size and flat.dtype.kind in "iuf":
                flat[chance.randrange(flat.size)] = np.array(chance.choice((-1, 0, 1, 2, 7, 100))).astype(flat.dtype)
        return f"entries of {name}", with_arrays(data, {name: flat.reshape(arrays[name].shape)})
    return f"{name}: {change}", with_arrays(data, {name: ARRAY_CHANGES[change](arrays[name])})


def _lie(chance: random.Random, member: bytes) -> tuple[str, bytes]:
    """An npy file whose header says something else than its bytes are."""
    length = struct.unpack_from("<H", member, 8)[0]
    header, body = member[10 : 10 + length].decode("latin-1").strip(), member[10 + length :]
    what = chance.choice(("descr", "shape", "order", "version", "length", "deep"))
    if what == "descr":
        header = re.sub(r"'descr': '[^']*'", f"'descr': {chance.choice(_TYPES)!r}", header)
    elif what == "shape":
        header = re.sub(r"'shape': \([^)]*\)", f"'shape': {chance.choice(_SHAPES)}", header)
    elif what == "order":
        header = header.replace("False", chance.choice(("True", "1", "None")))
    elif what == "deep":
        header = chance.choice(("(", "[", "{1:")) * 4000
    version = bytes([chance.randrange(5), 0]) if what == "version" else b"\1\0"
    said = chance.randrange(65536) if what == "length" else len(header) + 1
    return f"header, {what}", b"\x93NUMPY" + version + struct.pack("<H", said) + header.encode() + b"\n" + body


def _header(chance: random.Random, data: bytes) -> tuple[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = chance.choice(list(members))
    said, members[name] = _lie(chance, members[name])
    return f"{name}: {said}", _zipped(list(members.items()))


def _npy_header(chance: random.Random, data: bytes) -> tuple[str, bytes]:
    return _lie(chance, data)


def _archive(chance: random.Random, data: bytes) -> tuple[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    method = chance.choice((zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_STORED))
    what = chance.choice(("packed", "twice", "many", "renamed", "empty"))
    at = chance.randrange(len(members))
    if what == "twice":
        members.append(members[at])
    elif what == "many":
        members += [(f"{row}.npy", members[at][1]) for row in range(300)]
    elif what == "renamed":
        members[at] = (chance.choice(("../x.npy", "/x.npy", ".npy", "loop_.npy", "x")), members[at][1])
    elif what == "empty":
        members[at] = (members[at][0], b"")
    return f"archive, {what}", _zipped(members, method)


def _zipped(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, data in members:
            info = zipfile.ZipInfo(name)
            info.compress_type = method
            _put(archive, info, data)
    return stream.getvalue()


def _put(archive: zipfile.ZipFile, info: zipfile.ZipInfo, data: bytes) -> None:
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a name stands twice
        archive.writestr(info, data)


# --- JSON ----------------------------------------------------------------------------------------------------------


def _edited(chance: random.Random, tree: Any) -> tuple[str, Any]:
    """One change somewhere in a JSON value."""
    tree = copy.deepcopy(tree)
    places: list[tuple[Any, Any]] = []

    def walk(inner: Any) -> None:
        entries = inner.items() if isinstance(inner, dict) else enumerate(inner) if isinstance(inner, list) else ()
        for key, value in entries:
            places.append((inner, key))
            walk(value)

    walk(tree)
    if not places or chance.random() < 0.03:
        return "whole", chance.choice(JSON_VALUES)
    owner, key = chance.choice(places)
    what = chance.choice(("value", "value", "value", "gone", "twice", "other's", "scaled"))
    if what == "gone":
        del owner[key]
    elif what == "twice" and isinstance(owner, list):
        owner.append(owner[key])
    elif what == "other's":
        other, entry = chance.choice(places)
        owner[key] = copy.deepcopy(other[entry])
    elif what == "scaled" and isinstance(owner[key], int | float) and not isinstance(owner[key], bool):
        owner[key] = owner[key] * chance.choice((-1, 2, 1000, 2**20)) + chance.choice((0, 1))
    else:
        owner[key] = chance.choice(JSON_VALUES)
    return f"{what} at {key!r}", tree


def _text(chance: random.Random, tree: Any) -> bytes:
    """As JSON, now and then with a name that stands twice, or very deep."""
    text = json.dumps(tree)
    turn = chance.random()
    if turn < 0.04:
        text = re.sub(r'("\w+": )', r"\1 0, \1", text, count=1)
    elif turn < 0.06:
        text = re.sub(r": \S+", ": " + "[" * 100_000, text, count=1)
    return text.encode()


def _json(chance: random.Random, data: bytes) -> tuple[str, bytes]:
    said, tree = _edited(chance, json.loads(data))
    return f"JSON, {said}", _text(chance, tree)


def _json_line(chance: random.Random, data: bytes) -> tuple[str, bytes]:
    lines = data.splitlines()
    row = chance.randrange(len(lines))
    said, lines[row] = _json(chance, lines[row])
    return f"{said} of line {row + 1}", b"\n".join(lines)


def _scene(chance: random.Random, data: bytes) -> tuple[str, bytes]:
    """glTF, the JSON alone or in its binary container, with lengths that fit again."""
    if data[:4] != b"glTF":
        return _json(chance, data)
    length = struct.unpack_from("<I", data, 12)[0]
    said, tree = _edited(chance, json.loads(data[20 : 20 + length]))
    if chance.random() < 0.3:
        more, tree = _edited(chance, tree)
        said = f"{said}, {more}"
    text = _text(chance, tree)
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + rest
    return f"scene, {said}", struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _tensor_header(chance: random.Random, data: bytes) -> tuple[str, bytes]:
    length = struct.unpack_from("<Q", data)[0]
    header = json.loads(data[8 : 8 + length])
    note = header.get("__metadata__", {}).get("capture4d")
    if note is not None and chance.random() < 0.6:
        said, tree = _edited(chance, json.loads(note))
        header["__metadata__"]["capture4d"] = _text(chance, tree).decode()
        said = f"note, {said}"
    else:
        said, header = _edited(chance, header)
    text = _text(chance, header)
    return f"tensors, {said}", struct.pack("<Q", len(text)) + text + data[8 + length :]


# --- ply -----------------------------------------------------------------------------------------------------------


def _ply_header(chance: random.Random, data: bytes) -> tuple[str, bytes]:
    head, end, body = data.partition(b"end_header")
    lines = head.decode().splitlines()
    row = chance.randrange(1, len(lines))
    words = lines[row].split()
    what = chance.choice(("count", "type", "name", "more", "swap", "element"))
    if what == "count" and words[0] == "element":
        words[2] = chance.choice(("0", "-1", "1", "1000000000000", "4294967297", "x", "1e3", "7", "1_0"))
    elif what == "type" and words[0] == "property":
        place = chance.randrange(1, len(words) - 1)
        words[place] = chance.choice(
            ("char", "uchar", "short", "ushort", "int", "uint", "float", "double", "list", "x")
        )
    elif what == "name":
        words[-1] = chance.choice(("x", "red", "vertex", "face", "vertex_indices", "texcoord", "s", "nx", ""))
    elif what == "more":
        words += ["\nproperty", chance.choice(("list uchar int a", "list float int a", "double a", "list uint x y"))]
    elif what == "element":
        words += ["\nelement", chance.choice(("a", "vertex", "face")), chance.choice(("1000000000000", "2"))]
    lines[row] = " ".join(words)
    if what == "swap":
        other = chance.randrange(1, len(lines))
        lines[row], lines[other] = lines[other], lines[row]
    return f"ply header, {what} in line {row + 1}", "\n".join(lines).encode() + b"\n" + end + body
