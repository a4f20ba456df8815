"""GLB files: the scene as trimesh reads it, where that is right, and hostile files that end in one line."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from capture4d.errors import InputError
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh, write_mesh
from capture4d.types import Mesh
from tests.gltf_files import glb

RNG = np.random.default_rng(4)


def square() -> tuple[dict[str, Any], bytes]:
    """Two triangles, each vertex with a place and a UV."""
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]], "<f4")
    binary = points.tobytes() + np.array([0, 1, 2, 0, 2, 3], "<u2").tobytes() + points[:, :2].tobytes()
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": 4, "type": "VEC2"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 12},
            {"buffer": 0, "byteOffset": 60, "byteLength": 32},
        ],
        "buffers": [{"byteLength": len(binary)}],
    }
    return tree, binary


def placed_scene() -> trimesh.Scene:
    """A tree of nodes with turned, scaled and mirrored meshes, one of them in two places."""
    scene = trimesh.Scene()
    for name in ("a", "b"):
        mesh = trimesh.Trimesh(RNG.random((6, 3)), RNG.integers(0, 6, (5, 3)), process=False)
        turn = trimesh.transformations.random_rotation_matrix(RNG.random(3))
        turn[:3, :3] *= 2.0
        turn[:3, 3] = RNG.random(3)
        scene.add_geometry(mesh, node_name=f"{name}1", geom_name=name, transform=turn)
    scene.add_geometry(scene.geometry["a"], node_name="a2", geom_name="a", parent_node_name="b1",
                       transform=np.diag([-1.0, 1, 1, 1]))  # fmt: skip
    return scene


def test_a_scene_is_the_mesh_that_trimesh_makes_of_it(tmp_path: Path) -> None:
    path = tmp_path / "scene.glb"
    path.write_bytes(placed_scene().export(file_type="glb"))
    expected = trimesh.load_scene(path, process=False).to_mesh()
    found = read_mesh(path).mesh
    np.testing.assert_allclose(found.vertices, expected.vertices, atol=1e-6)
    np.testing.assert_array_equal(found.faces, expected.faces)


@pytest.mark.parametrize("indexed", [True, False])
def test_strips_and_fans(indexed: bool, tmp_path: Path) -> None:
    tree, binary = square()
    primitive = tree["meshes"][0]["primitives"][0]
    tree["accessors"][1]["count"] = 4
    binary = binary[:48] + np.array([0, 1, 3, 2, 0, 0], "<u2").tobytes() + binary[60:]
    if not indexed:
        del primitive["indices"]
    corners = [0, 1, 3, 2] if indexed else [0, 1, 2, 3]
    a, b, c, d = corners
    for mode, expected in ((5, [[a, b, c], [c, b, d]]), (6, [[a, b, c], [a, c, d]])):
        primitive["mode"] = mode
        (tmp_path / "x.glb").write_bytes(glb(tree, binary))
        faces = read_mesh(tmp_path / "x.glb").mesh.faces
        assert [sorted(face) for face in faces.tolist()] == [sorted(face) for face in expected]
        if mode == 5:
            expected = trimesh.load_scene(tmp_path / "x.glb", process=False).to_mesh().faces
        turned = [[np.roll(face, shift).tolist() for shift in range(3)] for face in np.asarray(expected)]
        assert all(face in same for face, same in zip(faces.tolist(), turned, strict=True)), "wound alike"


def test_uvs_are_kept_with_v_up(tmp_path: Path) -> None:
    tree, binary = square()
    tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = 2
    (tmp_path / "x.glb").write_bytes(glb(tree, binary))
    mesh = read_mesh(tmp_path / "x.glb").mesh
    assert mesh.uv is not None
    np.testing.assert_array_equal(mesh.uv, (mesh.vertices[:, :2] * [1, -1] + [0, 1]).astype(np.float32)[mesh.faces])


def test_each_material_colours_its_own_surface(tmp_path: Path) -> None:
    """Three squares: two with textures of their own, one with a plain base colour."""
    scene = trimesh.Scene()
    materials = [
        trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (4, 4), colour))
        for colour in ((200, 10, 20), (30, 210, 40))
    ]
    materials.append(trimesh.visual.material.PBRMaterial(baseColorFactor=[0, 0, 255, 255]))
    for index, material in enumerate(materials):
        mesh = trimesh.Trimesh(RNG.random((3, 3)), [[0, 1, 2]], process=False)
        mesh.visual = trimesh.visual.TextureVisuals(RNG.random((3, 2)), material=material)
        scene.add_geometry(mesh, geom_name=str(index), node_name=str(index))
    (tmp_path / "x.glb").write_bytes(scene.export(file_type="glb"))
    colours = read_coloured_mesh(tmp_path / "x.glb").colours
    assert colours is not None
    assert sorted(map(tuple, colours[::3].tolist())) == [(0, 0, 255), (30, 210, 40), (200, 10, 20)]


def test_sparse_and_quantised_places(tmp_path: Path) -> None:
    tree, binary = square()
    more = np.array([2], "<u2").tobytes() + b"\0\0" + np.array([7, 8, 9], "<f4").tobytes()
    tree["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(more)})
    tree["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": 3, "componentType": 5123},
        "values": {"bufferView": 3, "byteOffset": 4},
    }
    (tmp_path / "x.glb").write_bytes(glb(tree, binary + more))
    assert read_mesh(tmp_path / "x.glb").mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [7, 8, 9], [0, 1, 0.5]]

    tree, binary = square()
    tree["accessors"][0] = {"bufferView": 0, "componentType": 5122, "normalized": True, "count": 4, "type": "VEC3"}
    tree["nodes"][0]["scale"] = [0.5, 0.5, 0.5]
    short = np.array([[0, 0, 0], [32767, 0, 0], [32767, 32767, 0], [0, -32767, 0]], "<i2").tobytes()
    (tmp_path / "x.glb").write_bytes(glb(tree, short.ljust(48, b"\0") + binary[48:]))
    assert read_mesh(tmp_path / "x.glb").mesh.vertices.tolist() == [[0, 0, 0], [0.5, 0, 0], [0.5, 0.5, 0], [0, -0.5, 0]]


def _set(*path: Any) -> Callable[[dict[str, Any]], None]:
    """A change of one entry of the JSON; the last of the path is the value."""
    *steps, name, value = path

    def change(tree: Any) -> None:
        for step in steps:
            tree = tree[step]
        tree[name] = value

    return change


HOSTILE = {
    "more elements than bytes": (_set("accessors", 1, "count", 4_000_000_000), r"accessors\[1\]: expected 8000000000"),
    "nothing but zeros, many": (
        _set("accessors", 0, {"componentType": 5126, "count": 10**12, "type": "VEC3"}), "expected a buffer view"
    ),
    "a view beyond the buffer": (_set("bufferViews", 0, "byteLength", 10**15), "expected 1000000000000000 bytes"),
    "a negative offset": (_set("bufferViews", 0, "byteOffset", -4), "byteOffset: expected a whole number"),
    "indices that are numbers": (_set("accessors", 1, "componentType", 5126), r"accessors\[1\]: expected 24 bytes"),
    "an index too high": (_set("accessors", 0, "count", 2), "expected vertex indices from 0 to 1, found 3"),
    "a cycle": (_set("nodes", [{"children": [1], "mesh": 0}, {"children": [0]}]), "expected a tree of nodes"),
    "two to the thirtieth nodes": (
        _set("nodes", [*({"children": [i + 1, i + 1]} for i in range(30)), {"mesh": 0}]), "expected a tree of nodes"
    ),
    "a parent of itself": (_set("nodes", [{"mesh": 0, "children": [0]}]), "expected a tree of nodes"),
    "a device as a buffer": (_set("buffers", 0, "uri", "/dev/zero"), "expected the buffer beside it"),
    "a buffer elsewhere": (_set("buffers", 0, "uri", "../%2e%2e/x.bin"), "expected the buffer beside it"),
    "no matrix": (_set("nodes", 0, "matrix", [1, 2, "x"]), "matrix: expected 16 finite numbers"),
    "an infinite scale": (_set("nodes", 0, "scale", [1, 2, float("inf")]), "scale: expected 3 finite numbers"),
    "a huge scale": (_set("nodes", 0, "scale", [1e300, 1e300, 1]), "expected finite numbers"),
    "nodes that are a number": (_set("nodes", 3), "expected one of 0 nodes"),
    "of another kind": (_set("extensionsRequired", ["VENDOR_voxels"]), "found VENDOR_voxels"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_one_line(name: str, tmp_path: Path) -> None:
    change, said = HOSTILE[name]
    tree, binary = square()
    change(tree)
    path = tmp_path / "x.glb"
    path.write_bytes(glb(tree, binary))
    with pytest.raises(InputError, match=said) as caught:
        read_coloured_mesh(path)
    assert caught.value.where == str(path)
    assert "\n" not in str(caught.value)


def test_a_mesh_in_very_many_places_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("capture4d.mesh_files.gltf.primitives.MOST", 100)
    tree, binary = square()
    for count, allowed in ((25, True), (26, False)):
        tree["nodes"] = [{"mesh": 0}] * count
        tree["scenes"][0]["nodes"] = list(range(count))
        (tmp_path / "x.glb").write_bytes(glb(tree, binary))
        if allowed:
            assert len(read_mesh(tmp_path / "x.glb").mesh.vertices) == 100
        else:
            with pytest.raises(InputError, match="at most 100 vertices"):
                read_mesh(tmp_path / "x.glb")


def test_a_texture_lies_beside_the_file_and_is_an_image(tmp_path: Path) -> None:
    folder = tmp_path / "inner"
    folder.mkdir()
    tree, binary = square()
    tree["meshes"][0]["primitives"][0] |= {"material": 0}
    tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = 2
    tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    tree["textures"], tree["images"] = [{"source": 0}], [{}]
    path = folder / "x.glb"
    stream = io.BytesIO()
    Image.new("RGB", (4, 4), (9, 8, 7)).save(stream, "png")
    for place in (tmp_path / "t.png", folder / "a t.png"):
        place.write_bytes(stream.getvalue())
    (folder / "e.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n")

    def read(uri: str) -> Any:
        tree["images"][0]["uri"] = uri
        path.write_bytes(glb(tree, binary))
        return read_coloured_mesh(path)

    assert read("a%20t.png").colours.tolist() == 4 * [[9, 8, 7]]
    with pytest.raises(InputError, match="expected the texture beside it or in a folder below"):
        read("../t.png")
    with pytest.raises(InputError, match="not a readable image"):
        read("e.png")
    with pytest.raises(InputError, match="no such file, the texture of"):
        read("none.png")


def test_what_is_written_is_read_by_trimesh(tmp_path: Path) -> None:
    mesh = Mesh(RNG.random((5, 3), np.float32), RNG.integers(0, 5, (4, 3)).astype(np.int32))
    write_mesh(tmp_path / "x.glb", mesh)
    assert trimesh.load_scene(tmp_path / "x.glb", process=False).to_mesh().faces.tolist() == mesh.faces.tolist()
    assert read_mesh(tmp_path / "x.glb").colours is None
