"""What an array file claims is compared with its bytes before memory is asked for."""

import io
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile, map_array


def npy(descr: str, shape: str, body: bytes = b"", *, version: int = 1, length: int | None = None) -> bytes:
    """An npy file with whatever is claimed."""
    header = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    size = struct.pack("<H" if version == 1 else "<I", len(header) if length is None else length)
    return b"\x93NUMPY" + bytes([version, 0]) + size + header + body


def npz(path: Path, *members: tuple[str, bytes], method: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members:
            info = zipfile.ZipInfo(name)
            info.compress_type = method
            archive.writestr(info, data)
    return path


def everything(path: Path) -> None:
    with ArrayFile(path) as arrays:
        arrays.names("a") if "a" in arrays else arrays.numbers()


def refused(path: Path, said: str) -> None:
    """One line, and little memory."""
    tracemalloc.start()
    with pytest.raises(InputError, match=said) as caught:
        map_array(path) if path.suffix == ".npy" else everything(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert caught.value.where == str(path)
    assert peak < 20_000_000


@pytest.mark.parametrize(("descr", "shape"), [
    ("<f4", "(10**12,)"), ("<f4", "(1000000000000,)"), ("<f4", "(4611686018427387904, 4)"), ("<f4", "(-1,)"),
    ("<f4", "(2.0, 3)"), ("<f4", "(True,)"), ("<f4", "None"), ("<f4", "(" + "1, " * 70 + ")"),
    ("<U0", "(10000000000,)"), ("|S0", "(5,)"), ("|V0", "(10000000000,)"), ("<f4", "(10000000000, 0)"),
    ("<f4", "(0, 10000000000)"), ("|O", "(1,)"), ("|V12", "(1,)"), ("<M8[s]", "(1,)"), ("x", "(1,)"),
])  # fmt: skip
@pytest.mark.parametrize("ending", ["npz", "npy"])
def test_a_claim_that_has_no_bytes_is_refused(tmp_path: Path, descr: str, shape: str, ending: str) -> None:
    data, path = npy(descr, shape), tmp_path / f"x.{ending}"
    path.write_bytes(data) if ending == "npy" else npz(path, ("a.npy", data))
    refused(path, "damaged|expected")


@pytest.mark.parametrize("version", [1, 2])
def test_a_header_is_short(tmp_path: Path, version: int) -> None:
    length = 65_535 if version == 1 else 2**32 - 1
    refused(npz(tmp_path / "x.npz", ("a.npy", npy("<f4", "(1,)", version=version, length=length))), "damaged array 'a'")


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_an_archive_that_unpacks_to_more_than_is_believed_is_refused(tmp_path: Path, method: int) -> None:
    path, shape = tmp_path / "x.npz", "(300000000,)"
    with zipfile.ZipFile(path, "w", method) as archive, archive.open("a.npy", "w") as member:
        member.write(npy("|u1", shape))
        for _ in range(300):
            member.write(bytes(1_000_000))
    refused(path, "more than is believed|that claim to be")


def test_an_array_is_there_once(tmp_path: Path) -> None:
    data = npy("<i4", "(1,)", bytes(4))
    with pytest.warns(UserWarning, match="Duplicate name"):
        npz(tmp_path / "x.npz", ("a.npy", data), ("a.npy", data))
    refused(tmp_path / "x.npz", "every array once")


def test_arrays_that_lie_over_each_other_are_refused(tmp_path: Path) -> None:
    """Many entries of the directory for one stretch of bytes, as in the zip bombs of D. Fifield, 2019."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("a.npy", npy("<i4", "(1000,)", bytes(4000)))
        archive.filelist += [zipfile.ZipInfo(f"{row}.npy") for row in range(50)]
        first = archive.filelist[0]
        for other in archive.filelist[1:]:
            other.CRC, other.compress_size, other.file_size = first.CRC, first.compress_size, first.file_size
            other.header_offset = 0
    (tmp_path / "x.npz").write_bytes(stream.getvalue())
    refused(tmp_path / "x.npz", "claim more than")


def test_what_is_no_number_is_none(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", flag=np.array(True), text=np.array("1"), two=np.zeros(2), one=np.array([3]))
    with ArrayFile(tmp_path / "x.npz") as arrays:
        assert arrays.number("one") == 3
        for name in ("flag", "text", "two"):
            with pytest.raises(InputError, match=rf"'{name}': expected one number"):
                arrays.number(name)
