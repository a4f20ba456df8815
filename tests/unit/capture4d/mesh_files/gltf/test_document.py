"""Containers, buffers and images in all the places where they may be, and in those where they may not."""

import base64
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.mesh_files.glb import read_coloured_glb, read_glb
from capture4d.mesh_files.meshes import read_mesh
from tests.gltf_files import GltfFile, grid

VERTICES, FACES, _ = grid()


def sheet() -> GltfFile:
    file = GltfFile()
    file.primitive({"POSITION": file.accessor(VERTICES)}, indices=file.accessor(FACES.ravel(), 5123))
    return file


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack("<I4s", len(data), kind) + data


def container(*chunks: bytes, length: int | None = None) -> bytes:
    body = b"".join(chunks)
    return b"glTF" + struct.pack("<II", 2, 12 + len(body) if length is None else length) + body


def parts() -> tuple[bytes, bytes]:
    file = sheet()
    file.tree["buffers"][0]["byteLength"] = len(file.data)
    text = json.dumps(file.tree).encode()
    return text + b" " * (-len(text) % 4), bytes(file.data)


def require_sheet(path: Path) -> None:
    found = read_glb(path).mesh
    np.testing.assert_array_equal(found.vertices, VERTICES)
    np.testing.assert_array_equal(found.faces, FACES)


def test_a_binary_file_may_have_more_than_two_parts(tmp_path: Path) -> None:
    text, binary = parts()
    extra = chunk(b"XTRA", b"1234")
    path = tmp_path / "x.glb"
    for data in (
        container(chunk(b"JSON", text), chunk(b"BIN\0", binary)),
        container(chunk(b"JSON", text), chunk(b"BIN\0", binary), extra),
        container(chunk(b"JSON", text), extra, chunk(b"BIN\0", binary)),
        container(chunk(b"BIN\0", binary), chunk(b"JSON", text)),
        container(chunk(b"JSON", text.rstrip() + b"\0\0"), chunk(b"BIN\0", binary + b"\0\0\0")),
        container(chunk(b"JSON", text), chunk(b"BIN\0", binary)) + b"behind its end",
        container(chunk(b"JSON", b"\xef\xbb\xbf" + text), chunk(b"BIN\0", binary), chunk(b"BIN\0", b"")),
    ):
        path.write_bytes(data)
        require_sheet(path)


def test_a_container_that_lies_is_one_line(tmp_path: Path) -> None:
    text, binary = parts()
    whole = container(chunk(b"JSON", text), chunk(b"BIN\0", binary))
    for data, said in (
        (whole[:-1], "cut off: expected"),
        (whole[:19], "not a readable GLB file, cut off"),
        (whole[:4] + struct.pack("<I", 1) + whole[8:], "expected version 2 of glTF, found 1"),
        (container(chunk(b"JSON", text), chunk(b"BIN\0", binary), length=10**9), "cut off: expected 1000000000 bytes"),
        (container(chunk(b"JSON", text), struct.pack("<I4s", 2**31, b"BIN\0") + binary), "a chunk reaches beyond"),
        (container(chunk(b"JSON", text)), r"buffers\[0\]: expected bytes, found none"),
        (container(chunk(b"BIN\0", binary)), "not valid JSON"),
        (container(chunk(b"JSON", b"[1, 2] "), chunk(b"BIN\0", binary)), "expected a JSON object, found list"),
        (container(chunk(b"JSON", b"[" * 100_000)), "not valid JSON"),
        (container(chunk(b"JSON", text), chunk(b"BIN\0", binary[:100])), r"bufferViews\[0\]: expected 192 bytes"),
        (b"", "not a readable GLB file"),
        (b"\x1f\x8b\x08" + whole, "not a readable GLB file"),
    ):
        (tmp_path / "x.glb").write_bytes(data)
        with pytest.raises(InputError, match=said) as caught:
            read_mesh(tmp_path / "x.glb")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["x.bin", "a b.bin", "ä%20ö.bin", "inner/x.bin"])
def test_buffers_lie_inside_or_beside_a_text_file(name: str, tmp_path: Path) -> None:
    file = sheet()
    require_sheet(file.save(tmp_path / "x.gltf"))
    place = tmp_path / name
    place.parent.mkdir(exist_ok=True)
    place.write_bytes(bytes(file.data))
    for uri in (quote(name), name, name.replace("/", "\\")):
        require_sheet(file.save(tmp_path / "x.gltf", uri=uri))


@pytest.mark.parametrize(
    "uri", ["X.BIN", "./x.bin", "file:///home/ana/x.bin", "file://x.bin", "C:\\Users\\ana\\x.bin", "/home/ana/X.bin"]
)
def test_a_name_from_another_machine_is_the_file_beside_it(uri: str, tmp_path: Path) -> None:
    file = sheet()
    (tmp_path / "x.bin").write_bytes(bytes(file.data))
    require_sheet(file.save(tmp_path / "x.gltf", uri=uri))


def test_a_name_with_a_per_cent_sign_and_the_name_that_it_stands_for(tmp_path: Path) -> None:
    """What is meant by the standard goes before what some programs write."""
    file = sheet()
    (tmp_path / "a%20b.bin").write_bytes(bytes(len(file.data)))
    (tmp_path / "a b.bin").write_bytes(bytes(file.data))
    require_sheet(file.save(tmp_path / "x.gltf", uri="a%20b.bin"))
    (tmp_path / "a b.bin").rename(tmp_path / "a%20b.bin")
    require_sheet(file.save(tmp_path / "x.gltf", uri="a%20b.bin"))


def test_data_in_the_json_in_all_its_spellings(tmp_path: Path) -> None:
    file = sheet()
    body = base64.b64encode(bytes(file.data)).decode()
    for uri in (
        f"data:application/octet-stream;base64,{body}",
        f"data:application/gltf-buffer;base64,{body.rstrip('=')}",
        f"data:;base64,{body}",
        f"DATA:application/octet-stream;BASE64,{body}",
        f"data:application/octet-stream;base64,{quote(body)}",
        f"data:application/octet-stream;base64,{body.replace('+', '-').replace('/', '_')}",
        f"data:application/octet-stream,{quote(bytes(file.data))}",
    ):
        require_sheet(file.save(tmp_path / "x.gltf", uri=uri))
    for uri, said in (("data:base64", "expected data after a comma"), ("data:;base64,x!", "expected base64")):
        with pytest.raises(InputError, match=rf"buffers\[0\]: {said}"):
            read_mesh(file.save(tmp_path / "x.gltf", uri=uri))


def test_a_file_is_told_by_its_beginning(tmp_path: Path) -> None:
    file = sheet()
    file.save(tmp_path / "a.gltf").rename(tmp_path / "x.glb")
    file.save(tmp_path / "a.glb").rename(tmp_path / "x.gltf")
    require_sheet(tmp_path / "x.glb")
    require_sheet(tmp_path / "x.gltf")
    (tmp_path / "x.gltf").write_bytes(b"\xef\xbb\xbf\n" + file.save(tmp_path / "b.gltf").read_bytes())
    require_sheet(tmp_path / "x.gltf")


@pytest.mark.parametrize(
    ("uri", "said"),
    [
        ("../x.bin", "expected the buffer beside it or in a folder below"),
        ("%2e%2e/x.bin", "expected the buffer beside it"),
        ("..\\x.bin", "expected the buffer beside it"),
        ("inner/../../x.bin", "expected the buffer beside it"),
        ("/etc/passwd", "expected the buffer beside it"),
        ("C:\\x.bin", "expected the buffer beside it"),
        ("x%00.bin", "expected the name of a buffer"),
        ("none.bin", "none.bin: no such file, the buffer of x.gltf"),
        ("file:///etc/passwd", "expected the buffer beside it"),
        ("file:///../x.bin", "expected the buffer beside it"),
        ("https://example.com/x.bin", "expected the name of a file, found 'https://example.com/x.bin'"),
        ("inner", "no such file, the buffer of x.gltf"),
    ],
)
def test_a_file_does_not_choose_what_is_read(uri: str, said: str, tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    (folder / "inner").mkdir(parents=True)
    (tmp_path / "x.bin").write_bytes(bytes(sheet().data))
    with pytest.raises(InputError, match=said):
        read_mesh(sheet().save(folder / "x.gltf", uri=uri))


@pytest.mark.parametrize(
    ("asset", "said"),
    [
        ({"version": "1.0"}, "expected version 2.0 of glTF, found '1.0'"),
        ({"version": "2.1", "minVersion": "2.1"}, "found '2.1'"),
        ({"version": "3.0"}, "found '3.0'"),
        ({"version": "2.1", "minVersion": "2.0"}, None),
        ({"version": "2.1"}, None),
        ({}, None),
        (None, None),
    ],
)
def test_versions(asset: Any, said: str | None, tmp_path: Path) -> None:
    file = sheet()
    file.tree["asset"] = asset
    path = file.save(tmp_path / "x.glb")
    if said is None:
        require_sheet(path)
    else:
        with pytest.raises(InputError, match=said):
            read_mesh(path)


@pytest.mark.parametrize(
    ("required", "read"),
    [
        (["KHR_mesh_quantization", "KHR_texture_transform", "KHR_materials_unlit", "KHR_materials_anything"], True),
        (["KHR_lights_punctual"], True),
        (["EXT_mesh_gpu_instancing"], False),
        (["KHR_gaussian_splatting"], False),
        (["VENDOR_new_geometry", "KHR_mesh_quantization"], False),
        ("KHR_mesh_quantization", False),
        ([7], False),
    ],
)
def test_what_a_file_needs_is_read_or_named(required: Any, read: bool, tmp_path: Path) -> None:
    file = sheet()
    file.tree["extensionsRequired"] = required
    path = file.save(tmp_path / "x.glb")
    if read:
        require_sheet(path)
    else:
        named = str(required[0]) if isinstance(required, list) else "expected a list"
        with pytest.raises(InputError, match=named):
            read_mesh(path)


def test_geometry_that_lies_in_an_unknown_extension_is_named(tmp_path: Path) -> None:
    """Though the file does not say that it needs it: its accessors have no bytes."""
    file = sheet()
    del file.tree["accessors"][0]["bufferView"]
    file.tree["meshes"][0]["primitives"][0]["extensions"] = {"VENDOR_packed_mesh": {}}
    with pytest.raises(InputError, match="expected a buffer view, found none but VENDOR_packed_mesh"):
        read_mesh(file.save(tmp_path / "x.glb"))


def test_a_buffer_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many views there are of it: it may be large."""
    file = sheet()
    (tmp_path / "x.bin").write_bytes(bytes(file.data))
    path = file.save(tmp_path / "x.gltf", uri="x.bin")
    read: list[str] = []
    real = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda self: read.append(self.name) or real(self))
    read_coloured_glb(path)
    assert sorted(read) == ["x.bin", "x.gltf"]


@pytest.mark.parametrize(
    "uri", ["/dev/zero", "../other.bin", "file:///etc/passwd", "https://example.org/a.bin", "none.bin"]
)
def test_bytes_that_nothing_uses_may_not_be_elsewhere_either(uri: str, tmp_path: Path) -> None:
    file = sheet()
    file.add("buffers", {"uri": uri, "byteLength": 100})
    with pytest.raises(InputError, match=r"buffer|expected the name of a file"):
        read_mesh(file.save(tmp_path / "sheet.glb"))
