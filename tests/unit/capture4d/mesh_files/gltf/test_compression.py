"""Draco and meshoptimizer: what their encoders packed is read as it was, and what is damaged is one line."""

import threading
from pathlib import Path
from typing import Any

import DracoPy
import meshopt
import numpy as np
import pytest
import trimesh

from capture4d.errors import InputError
from capture4d.mesh_files.gltf.compression import DRACO, MESHOPT
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh
from tests.gltf_files import GltfFile, grid

VERTICES, FACES, UV = grid(12)
RNG = np.random.default_rng(9)
LIGHT = np.column_stack([VERTICES, np.ones(len(VERTICES))])
BYTES = np.rint(255 * LIGHT).astype(np.uint8)
SRGB_BYTES = [
    round(255 * (12.92 * v if v <= 0.0031308 else 1.055 * v ** (1 / 2.4) - 0.055)) for v in np.arange(256) / 255
]
COLOURS = np.array(SRGB_BYTES, np.uint8)[BYTES[:, :3]]


def draco_file(payload: bytes, ids: dict[str, int], *, normalised: bool = True) -> GltfFile:
    """A primitive of which all is in a payload."""
    file = GltfFile()
    kinds: dict[str, dict[str, Any]] = {
        "POSITION": {"componentType": 5126, "type": "VEC3", "count": len(VERTICES)},
        "TEXCOORD_0": {"componentType": 5126, "type": "VEC2", "count": len(VERTICES)},
        "COLOR_0": {"componentType": 5121, "type": "VEC4", "count": len(VERTICES), "normalized": normalised},
    }
    attributes = {name: file.add("accessors", kinds[name]) for name in ids}
    indices = file.add("accessors", {"componentType": 5123, "type": "SCALAR", "count": FACES.size})
    packed = {DRACO: {"bufferView": file.view(payload), "attributes": ids}}
    file.primitive(attributes, indices=indices, extensions=packed)
    file.tree["extensionsUsed"] = file.tree["extensionsRequired"] = [DRACO]
    return file


def draco_payload(**more: Any) -> bytes:
    given = {"quantization_bits": 20, "tex_coord": UV.astype(np.float64), "colors": BYTES} | more
    return DracoPy.encode(VERTICES, FACES.astype(np.uint32), **given)


def ids_of(payload: bytes) -> dict[str, int]:
    names = {0: "POSITION", 2: "COLOR_0", 3: "TEXCOORD_0"}
    found = {names[each["attribute_type"]]: each["unique_id"] for each in DracoPy.decode(payload).attributes}
    return {name: found[name] for name in ("POSITION", "TEXCOORD_0", "COLOR_0")}


def require_same(file: GltfFile, folder: Path, reach: float = 1e-5) -> None:
    """The sheet with its UVs and colours, in whatever order its vertices are."""
    found = read_coloured_mesh(file.save(folder / "x.glb"))
    assert len(found.mesh.faces) == len(FACES)
    corners = found.mesh.vertices[found.mesh.faces].reshape(-1, 3)
    nearest = np.linalg.norm(corners[:, None] - VERTICES, axis=2).argmin(axis=1)
    np.testing.assert_allclose(corners, VERTICES[nearest], atol=reach)
    assert {tuple(sorted(face)) for face in nearest.reshape(-1, 3).tolist()} == set(map(tuple, np.sort(FACES).tolist()))
    normals = np.cross(*(found.mesh.vertices[found.mesh.faces[:, k]] - found.mesh.vertices[found.mesh.faces[:, 0]]
                         for k in (1, 2)))  # fmt: skip
    assert (normals[:, 2] > 0).all(), "wound as they were"
    assert found.mesh.uv is not None
    np.testing.assert_allclose(found.mesh.uv.reshape(-1, 2), ([0, 1] + UV * [1, -1])[nearest], atol=1e-3)
    assert found.colours is not None
    np.testing.assert_array_equal(found.colours[found.mesh.faces.reshape(-1)], COLOURS[nearest])


@pytest.mark.parametrize("level", [0, 3, 7, 10])
@pytest.mark.parametrize("in_order", [True, False])
def test_draco_holds_places_uvs_and_colours(level: int, in_order: bool, tmp_path: Path) -> None:
    payload = draco_payload(compression_level=level, preserve_order=in_order)
    require_same(draco_file(payload, ids_of(payload)), tmp_path)
    if in_order:
        np.testing.assert_allclose(read_mesh(tmp_path / "x.glb").mesh.vertices, VERTICES, atol=1e-5)


def test_draco_with_a_view_of_its_own_beside_it(tmp_path: Path) -> None:
    """What is not in the payload is where it always is."""
    payload = draco_payload(preserve_order=True, colors=None, compression_level=1)
    ids = {each["attribute_type"]: each["unique_id"] for each in DracoPy.decode(payload).attributes}
    file = draco_file(payload, {"POSITION": ids[0], "TEXCOORD_0": ids[3]})
    primitive = file.tree["meshes"][0]["primitives"][0]
    primitive["attributes"]["COLOR_0"] = file.accessor(BYTES, 5121, fractions=True)
    require_same(file, tmp_path)


def test_draco_metadata_is_passed_over(tmp_path: Path) -> None:
    payload = draco_payload(create_metadata=True, generic_attributes={"a name": np.ones((144, 2), np.uint16)})
    assert payload[10] == 0x80
    names = {0: "POSITION", 2: "COLOR_0", 3: "TEXCOORD_0"}
    found = {each["attribute_type"]: each["unique_id"] for each in DracoPy.decode(payload).attributes}
    require_same(draco_file(payload, {name: found[kind] for kind, name in names.items()}), tmp_path)


def test_draco_as_trimesh_writes_it(tmp_path: Path) -> None:
    model = trimesh.Trimesh(VERTICES, FACES, process=False)
    (tmp_path / "x.glb").write_bytes(trimesh.Scene(model).export(file_type="glb", extension_draco=True))
    found = read_mesh(tmp_path / "x.glb").mesh
    np.testing.assert_allclose(found.vertices, VERTICES, atol=1e-4)
    assert len(found.faces) == len(FACES)


def nested_metadata(payload: bytes) -> bytes:
    """A payload with a thousand names in names before it."""
    return payload[:9] + b"\0\x80" + b"\0" + b"\0\x01\x01a" * 3000 + b"\0\0" + payload[11:]


def claims(payload: bytes, at: int, number: int) -> bytes:
    """Another number where one of two bytes is."""
    varint = b""
    while number > 0x7F:
        varint += bytes([number & 0x7F | 0x80])
        number >>= 7
    return payload[:at] + varint + bytes([number]) + payload[at + 2 :]


FLAT = draco_payload(compression_level=0)
BREAKER = draco_payload(compression_level=7)


@pytest.mark.parametrize(
    ("payload", "said"),
    [
        (b"DRACO\2\2\1" + bytes(41), "found no triangles"),
        (b"stub of a payload", "expected the bytes DRACO at its beginning"),
        (b"DRACO\2\2", "cut off"),
        (FLAT[:60], "damaged"),
        (b"DRACO\1\2\1\0\0\0" + FLAT[11:], "expected a mesh of version 2.2"),
        (FLAT[:7] + b"\0" + FLAT[8:], "expected a mesh of version 2.2, found kind 0"),
        (claims(FLAT, 11, 2**31), "bytes that claim to be 2147483648 elements"),
        (claims(BREAKER, 12, 2**31), "bytes that claim to be 2147483648 elements"),
        (claims(BREAKER, 17, 2**30), "1073741824 symbols"),
        (FLAT[:11] + b"\xff" * 60, "a number that does not end"),
        (nested_metadata(FLAT), "cut off"),
    ],
)
def test_a_damaged_draco_payload_is_one_line(payload: bytes, said: str, tmp_path: Path) -> None:
    path = draco_file(payload, {"POSITION": 2}).save(tmp_path / "x.glb")
    with pytest.raises(InputError, match=rf"not readable as Draco \(KHR_draco_mesh_compression\), .*{said}") as caught:
        read_mesh(path)
    assert "\n" not in str(caught.value)


def test_a_number_that_a_payload_has_not_is_one_line(tmp_path: Path) -> None:
    for ids in ({"POSITION": 77}, {"POSITION": "a"}):
        with pytest.raises(InputError, match=r"expected POSITION as number \w+, found none"):
            read_mesh(draco_file(FLAT, ids).save(tmp_path / "x.glb"))
    file = draco_file(FLAT, ids_of(FLAT))
    file.tree["accessors"][0]["type"] = "VEC2"
    assert len(read_mesh(file.save(tmp_path / "x.glb")).mesh.vertices) == len(VERTICES), "the payload knows better"


def test_a_payload_that_takes_for_ever_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    let_go = threading.Event()
    monkeypatch.setattr(DracoPy, "decode", lambda payload: let_go.wait())
    monkeypatch.setattr("capture4d.mesh_files.gltf.compression._PATIENCE_S", 0.01)
    with pytest.raises(InputError, match=r"not readable as Draco .+not done in 0 s"):
        read_mesh(draco_file(FLAT, {"POSITION": 0}).save(tmp_path / "x.glb"))
    let_go.set()


# --- meshoptimizer -----------------------------------------------------------------------------------------------


def packed_file(name: str, version: int, *, mode: str = "TRIANGLES", wide: bool = False) -> GltfFile:
    """Every view compressed, and a buffer without bytes for those who cannot read that."""
    file = GltfFile()
    places = np.rint(65535 * VERTICES).astype(np.uint16)
    uv = np.rint(65535 * UV).astype(np.uint16)
    attributes = {
        "POSITION": file.accessor(np.column_stack([places, places[:, :1]]), 5123, fractions=True),
        "TEXCOORD_0": file.accessor(uv, 5123, fractions=True),
        "COLOR_0": file.accessor(BYTES, 5121, fractions=True),
    }
    file.tree["accessors"][0]["type"] = "VEC3"
    file.tree["bufferViews"][0]["byteStride"] = 8
    file.primitive(attributes, indices=file.accessor(FACES.ravel(), 5125 if wide else 5123))
    data, file.data = bytes(file.data), bytearray()
    for view, accessor in zip(file.tree["bufferViews"], file.tree["accessors"], strict=True):
        raw = data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        count = accessor["count"]
        rows = np.frombuffer(raw, np.uint8).reshape(count, -1)
        kind = mode if accessor["type"] == "SCALAR" else "ATTRIBUTES"
        packed = meshopt.encode_gltf_buffer(
            rows if kind == "ATTRIBUTES" else np.frombuffer(raw, np.uint32 if wide else np.uint16), kind, version
        )
        place = {"buffer": 0, "byteOffset": len(file.data), "byteLength": len(packed), "byteStride": rows.shape[1]}
        view["extensions"] = {name: place | {"count": count, "mode": kind}}
        view["buffer"] = 1
        file.data += packed + b"\0" * (-len(packed) % 4)
    file.tree["buffers"].append({"byteLength": len(data), "extensions": {name: {"fallback": True}}})
    file.tree["extensionsUsed"] = file.tree["extensionsRequired"] = [name, "KHR_mesh_quantization"]
    return file


@pytest.mark.parametrize("name", MESHOPT)
@pytest.mark.parametrize("version", [0, 1])
@pytest.mark.parametrize("mode", ["TRIANGLES", "INDICES"])
@pytest.mark.parametrize("wide", [True, False])
def test_meshoptimizer_holds_every_view(name: str, version: int, mode: str, wide: bool, tmp_path: Path) -> None:
    file = packed_file(name, version, mode=mode, wide=wide)
    require_same(file, tmp_path, reach=1e-4)
    del file.tree["extensionsRequired"]
    require_same(file, tmp_path, reach=1e-4)


def test_meshoptimizer_filters(tmp_path: Path) -> None:
    """Floats as mantissa and exponent, and colours as YCoCg, as gltfpack writes them."""
    file = GltfFile()
    attributes = {"POSITION": file.accessor(VERTICES), "COLOR_0": file.accessor(BYTES, 5121, fractions=True)}
    file.primitive(attributes, indices=file.accessor(FACES.ravel(), 5123))
    floats = meshopt.encode_filter_exp(VERTICES, 20)
    colours = meshopt.encode_filter_color(BYTES / 255.0, 4, 8)
    for view, rows, kind in ((0, floats, "EXPONENTIAL"), (1, colours, "COLOR")):
        packed = meshopt.encode_gltf_buffer(rows, "ATTRIBUTES", 1)
        place = {"buffer": 0, "byteOffset": len(file.data), "byteLength": len(packed), "byteStride": rows.shape[1]}
        place |= {"count": len(rows), "mode": "ATTRIBUTES", "filter": kind}
        file.tree["bufferViews"][view]["extensions"] = {"KHR_meshopt_compression": place}
        file.data += packed + b"\0" * (-len(packed) % 4)
    found = read_coloured_mesh(file.save(tmp_path / "x.glb"))
    np.testing.assert_allclose(found.mesh.vertices, VERTICES, atol=1e-5)
    assert found.colours is not None
    light = BYTES[:, :3] > 20  # darker ones are far apart in sRGB
    assert np.abs(found.colours.astype(int) - COLOURS)[light].max() <= 6


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"mode": "LINES"}, "expected a mode and a filter of EXT_meshopt_compression"),
        ({"filter": "SHARPEN"}, "expected a mode and a filter of EXT_meshopt_compression"),
        ({"byteLength": 5}, "not readable as EXT_meshopt_compression, damaged"),
        ({"count": 143}, "not readable as EXT_meshopt_compression, damaged|expected 1150 bytes"),
        ({"count": 10**9}, r"not readable as EXT_meshopt_compression, \d+ bytes that claim to be 8000000000"),
        ({"count": "x"}, "count: expected a whole number"),
        ({"byteStride": 7}, "not readable as EXT_meshopt_compression, damaged"),
        ({"byteStride": 0}, "not readable as EXT_meshopt_compression, damaged"),
        ({"buffer": 1}, r"buffers\[1\]: expected bytes, found none"),
        ({"filter": "QUATERNION", "byteStride": 4}, "not readable as EXT_meshopt_compression, damaged"),
    ],
)
def test_a_damaged_view_is_one_line(change: dict[str, Any], said: str, tmp_path: Path) -> None:
    file = packed_file("EXT_meshopt_compression", 0)
    file.tree["bufferViews"][0]["extensions"]["EXT_meshopt_compression"] |= change
    with pytest.raises(InputError, match=said) as caught:
        read_mesh(file.save(tmp_path / "x.glb"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["flat", "breaker", "EXT_meshopt_compression", "KHR_meshopt_compression"])
def test_damaged_bytes_are_a_mesh_or_one_line(kind: str, tmp_path: Path) -> None:
    """The decoders are native: a fault of theirs would end the process."""
    payloads = {"flat": FLAT, "breaker": BREAKER}
    file = draco_file(payloads[kind], ids_of(payloads[kind])) if kind in payloads else packed_file(kind, 1)
    whole, said = bytes(file.data), []
    for _ in range(300):
        data = bytearray(whole)
        for place in RNG.integers(0, len(data), RNG.integers(1, 4)):
            data[place] = RNG.integers(256)
        file.data = data
        try:
            read_coloured_mesh(file.save(tmp_path / "x.glb"))
        except InputError as error:
            said.append(str(error))
    assert said, "some of it is noticed"
    assert all("\n" not in line and line.startswith(str(tmp_path)) for line in said)
