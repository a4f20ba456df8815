"""What is written follows the standard, and comes back as it was."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from capture4d.errors import EmptyMeshError
from capture4d.mesh_files.gltf.writing import glb_bytes
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh, write_mesh
from capture4d.types import Mesh

RNG = np.random.default_rng(7)


def test_all_bytes_come_back(tmp_path: Path) -> None:
    mesh = Mesh(RNG.normal(size=(256, 3)).astype(np.float32), RNG.integers(0, 256, (300, 3)).astype(np.int32))
    colours = np.column_stack([np.arange(256), np.arange(256)[::-1], np.roll(np.arange(256), 77)]).astype(np.uint8)
    write_mesh(tmp_path / "x.glb", mesh, colours=colours)
    for found in (read_mesh(tmp_path / "x.glb"), read_coloured_mesh(tmp_path / "x.glb")):
        np.testing.assert_array_equal(found.mesh.vertices, mesh.vertices)
        np.testing.assert_array_equal(found.mesh.faces, mesh.faces)
        np.testing.assert_array_equal(found.colours, colours)
    write_mesh(tmp_path / "x.glb", mesh)
    assert read_coloured_mesh(tmp_path / "x.glb").colours is None


def test_colours_are_linear_fractions(tmp_path: Path) -> None:
    """3.7.2.1 of the standard, read without our reader."""
    triangle = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    data = glb_bytes(triangle, np.array([[0, 128, 255], [1, 2, 3], [9, 9, 9]], np.uint8))
    size = struct.unpack_from("<I", data, 12)[0]
    tree, binary = json.loads(data[20 : 20 + size]), data[28 + size :]
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
    values = np.frombuffer(binary, "<u2", 4, tree["bufferViews"][accessor["bufferView"]]["byteOffset"]) / 65535
    np.testing.assert_allclose(values, [0, 0.21586, 1, 1], atol=1e-5)


def test_a_file_is_whole(tmp_path: Path) -> None:
    """Lengths, alignment and limits, which other readers insist on; and trimesh has the same mesh of it."""
    mesh = Mesh(RNG.normal(size=(5, 3)).astype(np.float32), RNG.integers(0, 5, (4, 3)).astype(np.int32))
    data = glb_bytes(mesh, RNG.integers(0, 256, (5, 3)).astype(np.uint8))
    size = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + size])
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    assert len(data) % 4 == size % 4 == 0
    assert tree["buffers"][0]["byteLength"] == struct.unpack_from("<I", data, 20 + size)[0]
    assert all(view["byteOffset"] % 4 == 0 for view in tree["bufferViews"])
    assert tree["accessors"][0]["min"] == mesh.vertices.min(axis=0).tolist()
    (tmp_path / "x.glb").write_bytes(data)
    found = trimesh.load_scene(tmp_path / "x.glb", process=False).to_mesh()
    np.testing.assert_array_equal(found.vertices, mesh.vertices)
    np.testing.assert_array_equal(found.faces, mesh.faces)


@pytest.mark.parametrize("count", [0, 3])
def test_a_mesh_without_faces_is_written_and_refused(count: int, tmp_path: Path) -> None:
    mesh = Mesh(np.zeros((count, 3), np.float32), np.zeros((0, 3), np.int32))
    write_mesh(tmp_path / "x.glb", mesh, colours=np.zeros((count, 3), np.uint8))
    with pytest.raises(EmptyMeshError):
        read_mesh(tmp_path / "x.glb")
