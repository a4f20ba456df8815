"""What the browser is sent is what is shown: read back by trimesh, and by our own reader."""

import io
import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from capture4d.app.viewer.surfaces import Surface, corner_vertices, surface_glb
from capture4d.geometry.mesh import vertex_normals
from capture4d.mesh_files.meshes import read_coloured_mesh
from capture4d.types import Mesh
from tests.moving_garment import cloth
from tests.shapes import tube


def tree(data: bytes) -> dict:
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length])


@pytest.mark.parametrize("seed", range(3))
def test_positions_colours_and_faces_come_back(seed: int, tmp_path: Path):
    rng = np.random.default_rng(seed)
    mesh = tube(12, 7, 0.15)
    mesh = mesh.with_vertices((mesh.vertices * rng.uniform(0.5, 3, 3) + rng.uniform(-2, 2, 3)).astype(np.float32))
    colours = rng.integers(0, 256, (len(mesh.vertices), 3)).astype(np.uint8)
    (tmp_path / "a.glb").write_bytes(surface_glb(Surface(mesh, colours)))
    found = read_coloured_mesh(tmp_path / "a.glb")
    np.testing.assert_array_equal(found.mesh.faces, mesh.faces)
    np.testing.assert_array_equal(found.colours, colours)
    step = np.ptp(mesh.vertices, axis=0).max() / 65535
    assert np.abs(found.mesh.vertices - mesh.vertices).max() < step


def test_normals_are_those_of_the_mesh():
    mesh = tube(12, 7, 0.15)
    scene = trimesh.load(io.BytesIO(surface_glb(Surface(mesh, (10, 20, 30)))), file_type="glb", process=False)
    (found,) = scene.geometry.values()
    np.testing.assert_allclose(found.vertex_normals, vertex_normals(mesh.vertices, mesh.faces), atol=1e-5)


def test_a_map_and_its_uvs():
    mesh = cloth()
    assert mesh.uv is not None
    png = cv2.imencode(".png", np.full((8, 8, 3), 128, np.uint8))[1].tobytes()
    corners = corner_vertices(mesh)
    data = surface_glb(Surface(mesh, (10, 20, 30), png), corners)
    assert data == surface_glb(Surface(mesh, (10, 20, 30), png))
    said = tree(data)
    assert said["materials"][0]["normalTexture"] == {"index": 0}
    assert png in data
    np.testing.assert_array_equal(corners.vertex[corners.faces], mesh.faces)
    np.testing.assert_array_equal(corners.uv[corners.faces], mesh.uv)
    accessor = said["accessors"][said["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]]
    assert accessor["count"] == len(corners.vertex)


@pytest.mark.parametrize("vertices", [0, 3])
def test_nothing_to_show_is_an_empty_scene(vertices: int):
    mesh = Mesh(np.zeros((vertices, 3), np.float32), np.zeros((0, 3), np.int32))
    assert tree(surface_glb(Surface(mesh, (1, 2, 3))))["scenes"] == [{}]


def test_more_vertices_than_sixteen_bits_name(tmp_path: Path):
    mesh = tube(300, 250, 0.15)
    assert len(mesh.vertices) > 65536
    (tmp_path / "a.glb").write_bytes(surface_glb(Surface(mesh, (1, 2, 3))))
    np.testing.assert_array_equal(read_coloured_mesh(tmp_path / "a.glb").mesh.faces, mesh.faces)


def test_glass_is_blended():
    said = tree(surface_glb(Surface(tube(6, 4, 0.1), (1, 2, 3), opacity=0.5)))
    assert said["materials"][0]["alphaMode"] == "BLEND"
    assert said["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"][3] == 0.5
