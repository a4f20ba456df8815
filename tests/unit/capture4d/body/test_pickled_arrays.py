"""Arrays come out of pickles of every protocol, and nothing that such a file names is called."""

import pickle
import pickletools
import re
import struct
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
    assert set(found) == {"plain", "columns", "backwards", "narrow", "empty", "by row", "by column"}
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
    "a shape too large": (_array(b"(I999999999\nt"), "expected an array of shape (999999999,), found 16 bytes"),
    "a negative shape": (_array(b"(I-2\nt"), "expected an array of shape (-2,)"),
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
