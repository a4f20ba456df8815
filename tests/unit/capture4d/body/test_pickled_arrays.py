"""Arrays come out of pickles of every protocol, and nothing that such a file names is called."""

import pickle
import pickletools
import re
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from capture4d.body.pickled_arrays import read_pickled_arrays
from capture4d.errors import InputError

RNG = np.random.default_rng(8)
PARTS = RNG.random((4, 6)) * (RNG.random((4, 6)) < 0.4)
FIELDS: dict[str, Any] = {
    "plain": RNG.random((3, 4)),
    "columns": np.asfortranarray(RNG.random((3, 4), np.float32)),
    "backwards": np.arange(5, dtype=">u4"),
    "narrow": np.arange(6, dtype=np.uint8).reshape(2, 3),
    "empty": np.zeros((0, 3), np.float32),
    "by row": sparse.csr_matrix(PARTS),
    "by column": sparse.csc_matrix(PARTS),
    "by entry": sparse.coo_matrix(PARTS),
    "by row, an array": sparse.csr_array(PARTS),
    "a view": RNG.random((6, 4))[::2, ::-1],
    "style": "smpl",
    "count": 3,
    "words": np.array(["a", "b"]),
    "objects": np.array([{}, []], object),
    "nested": {"list": [1, 2.5, None, True], "tuple": (1, (2, 3), b"x")},
}


@pytest.mark.parametrize("protocol", range(6))
def test_arrays_of_every_protocol(protocol: int, tmp_path: Path) -> None:
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps(FIELDS, protocol=protocol))
    found = read_pickled_arrays(path)
    assert set(FIELDS) - set(found) == {"style", "count", "words", "objects", "nested"}
    for name, value in found.items():
        expected = FIELDS[name].toarray() if name.startswith("by") else FIELDS[name]
        np.testing.assert_array_equal(value, expected)
        assert value.dtype == expected.dtype.newbyteorder("=")


@pytest.mark.parametrize("protocol", [0, 2])
def test_bytes_as_python_2_wrote_them(protocol: int, tmp_path: Path) -> None:
    """Its strings are bytes: quoted and escaped as text, or with their length."""
    array = RNG.random(7)
    raw = array.tobytes()
    text = b"S" + repr(raw)[1:].encode() + b"\n" if protocol == 0 else b"T" + struct.pack("<i", len(raw)) + raw
    path = tmp_path / "x.pkl"
    path.write_bytes(
        b"(dS'x'\nccopy_reg\n_reconstructor\n(cchumpy.ch\nCh\nc__builtin__\nobject\nNtR(dS'x'\n"
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR(I1\n(I7\ntcnumpy\ndtype\n(S'f8'\nI0\nI1\ntR"
        b"(I3\nS'<'\nNNNI-1\nI-1\nI0\ntbI00\n" + text + b"tbsbs."
    )
    np.testing.assert_array_equal(read_pickled_arrays(path)["x"], array)


def _array(shape: bytes = b"(I2\nt", letter: bytes = b"f8", state: bytes = b"(I3\nS'<'\nNNNI-1\nI-1\nI0\nt") -> bytes:
    return (
        b"(dS'x'\ncnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR(I1\n" + shape +
        b"cnumpy\ndtype\n(S'" + letter + b"'\nI0\nI1\ntR" + state + b"bI00\nC\x10" + bytes(16) + b"tbs."
    )  # fmt: skip


HOSTILE = {
    "a call": (b"cos\nsystem\n(S'true'\ntR.", "expected only arrays in the pickle, found os.system"),
    "numpy's own door": (b"cnumpy\nload\n(S'x'\ntR.", "found numpy.load"),
    "a persistent name": (b"Px\n.", "found the instruction PERSID"),
    "an extension": (b"\x82\x01.", "found the instruction EXT1"),
    "no dictionary": (b"I1\n.", "expected a dictionary of arrays, found int"),
    "nothing": (b"", "cut off"),
    "cut off": (_array()[:-3], "cut off"),
    "an empty stack": (b"R.", "damaged, expected more on its stack"),
    "a shape too large": (_array(b"(I999999999\nt"), "expected an array of shape (999999999), found 16 bytes"),
    "a negative shape": (_array(b"(I-2\nt"), "expected an array of shape (-2)"),
    "a shape of long numbers": (_array(b"(" + b"\x8b\x00\x00\x01\x00" + b"\x7f" * 65536 + b"t"), "shape (?), found"),
    "a shape of many axes": (
        _array(b"(" + b"I1\n" * 1000 + b"I2\nt"),
        "expected an array of shape (1, 1, 1, 1, 1, 1, ...)",
    ),
    "a long number in words": (b"L" + b"9" * 100_000 + b"L\n.", "not a readable pickle of arrays"),
    "buffers from elsewhere": (b"\x80\x05}(\x8c\x01x\x97u.", "found the instruction NEXT_BUFFER"),
    "a name that is a list": (b"]\x8c\x01xR.", "expected a name and its arguments"),
    "a name of lists": (b"]q\x00]h\x00a\x93.", "expected the name of a class or function"),
    "arguments without end": (b"ccopy_reg\n_reconstructor\n(" + b"N" * 100 + b"tR.", "found 100 of them"),
    "a shape that is a number": (_array(b"I2\n"), "expected the bytes of an array and its shape"),
    "bytes longer than the file": (b"\x8e" + struct.pack("<Q", 2**60) + b"x.", "not a readable pickle of arrays"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_pickle_is_one_line(name: str, tmp_path: Path) -> None:
    data, said = HOSTILE[name]
    path = tmp_path / "x.pkl"
    path.write_bytes(data)
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        read_pickled_arrays(path)
    assert caught.value.where == str(path)


def test_flags_that_would_crash_numpy_are_never_set(tmp_path: Path) -> None:
    """An array of doubles whose type claims to hold objects: numpy would follow its bytes as addresses."""
    path = tmp_path / "x.pkl"
    hostile = _array(state=b"(I3\nS'<'\nNNNI8\nI8\nI63\nt")
    assert len(list(pickletools.genops(hostile))) > 30, "a whole pickle"
    path.write_bytes(hostile)
    np.testing.assert_array_equal(read_pickled_arrays(path)["x"], [0, 0])
    path.write_bytes(_array(letter=b"O8"))
    assert read_pickled_arrays(path) == {}
    scalar = b"(dS'x'\ncnumpy.core.multiarray\nscalar\n(cnumpy\ndtype\n(S'O8'\nI0\nI1\ntRC\x08AAAAAAAAtRs."
    path.write_bytes(scalar)
    assert read_pickled_arrays(path) == {}


def test_a_place_in_the_memo_costs_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "x.pkl"
    path.write_bytes(b"}r\xff\xff\xff\x7f.")
    assert read_pickled_arrays(path) == {}


def test_keys_are_not_hashed_however_deep(tmp_path: Path) -> None:
    path = tmp_path / "x.pkl"
    path.write_bytes(b"})" + b"\x85" * 300_000 + b"Ns.")
    assert read_pickled_arrays(path) == {}


@pytest.mark.parametrize(
    "change",
    [{"indices": np.array([9, 0], np.int32)}, {"indptr": np.array([0, 9, 2], np.int32)}, {"_shape": (9, 10**12)}],
)
def test_a_lying_sparse_matrix_is_one_line(change: dict[str, Any], tmp_path: Path) -> None:
    matrix = sparse.csr_matrix(np.eye(2))
    matrix.__dict__.update(change)
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps({"x": matrix}))
    with pytest.raises(InputError, match="sparse matrix"):
        read_pickled_arrays(path)


def _put(value: bytes, at: int) -> bytes:
    """A value that is remembered under a number."""
    return value + b"q" + bytes([at])


def _long_text(character: bytes, length: int = 1 << 20) -> bytes:
    return b"X" + struct.pack("<I", length) + character * length


def _entry(key: int, array: bytes) -> bytes:
    return b"X\x05\x00\x00\x00" + b"%05d" % key + array


_MADE = b"cnumpy.core.multiarray\n_reconstruct\n)R"


def _shared_bytes() -> bytes:
    """A mebibyte that three hundred arrays are to be made of."""
    array = _MADE + b"(I1\n(I1048576\ntcnumpy\ndtype\n(S'u1'\ntRI00\nh\x01tb"
    return b"}(" + _entry(0, _put(_long_text(b"\x00"), 1)) + b"".join(_entry(n, array) for n in range(1, 300)) + b"u."


def _zeros() -> bytes:
    return pickle.dumps({f"{n}": sparse.csr_matrix((4000, 4000)) for n in range(40)})


def _lists_of_lists() -> bytes:
    levels = (_put(b"](h" + bytes([n]) + b"h" + bytes([n]) + b"e", n + 1) for n in range(200))
    return b"}X\x01\x00\x00\x00x" + _put(b"]", 0) + b"".join(levels) + b"s."


def _long_arguments() -> bytes:
    start = _put(b"ccopy_reg\n_reconstructor\n", 0) + _put(b"(" + b"N" * 20_000 + b"t", 1)
    return start + b"h\x00h\x01R" * 3_000 + b"."


def _long_keys() -> bytes:
    number = b"\x8b" + struct.pack("<i", 1 << 20) + b"\x7f" * (1 << 20)
    return _put(b"}", 0) + _put(number, 1) + b"0" + b"h\x00h\x01Ns" * 1_000 + b"h\x00."


def _long_letters() -> bytes:
    array = _MADE + b"(I1\n)cnumpy\ndtype\n(h\x01tRI00\nC\x00tb"
    return b"}(" + _entry(0, _put(_long_text(b"<"), 1)) + b"".join(_entry(n, array) for n in range(1, 200)) + b"u."


BOMBS = {
    "bytes that many arrays share": _shared_bytes,
    "matrices that are all zeros": _zeros,
    "lists of lists": _lists_of_lists,
    "tuples of tuples as a key": lambda: b"})" + b"2\x86" * 5_000 + b"Ns.",
    "tuples of tuples as a name": lambda: b")" + b"2\x86" * 200 + b"2\x93.",
    "long arguments again and again": _long_arguments,
    "long keys again and again": _long_keys,
    "long type letters": _long_letters,
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_costs_no_more_than_its_length(name: str, tmp_path: Path) -> None:
    data, said = BOMBS[name](), ""
    path = tmp_path / "x.pkl"
    path.write_bytes(data)
    tracemalloc.start()
    try:
        found = read_pickled_arrays(path)
        assert not any(len(array) for array in found.values())
    except InputError as error:
        said = str(error)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert len(said) < 500
    assert peak < 60 * len(data) + 200_000_000, "20 million entries of 8 bytes are let through"
