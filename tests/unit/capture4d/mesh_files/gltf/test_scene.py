"""Nodes: trees, transforms, what is hidden, and files that have no scene."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from capture4d.errors import InputError
from capture4d.mesh_files.meshes import read_mesh
from tests.gltf_files import GltfFile, grid

VERTICES, FACES, _ = grid()


def sheet(nodes: list[dict[str, Any]]) -> GltfFile:
    file = GltfFile()
    file.primitive({"POSITION": file.accessor(VERTICES)}, indices=file.accessor(FACES.ravel(), 5123))
    file.tree["nodes"] = nodes
    return file


def node(rng: np.random.Generator, **more: Any) -> dict[str, Any]:
    """Any transform, with its parts or as a matrix."""
    rotation = rng.normal(size=4)
    parts = {
        "translation": rng.normal(size=3).tolist(),
        "rotation": (rotation / np.linalg.norm(rotation)).tolist(),
        "scale": (rng.random(3) * rng.choice([-1, 1], 3) + [0.2, 0.2, 0.2]).tolist(),
    }
    if rng.random() < 0.3:
        parts = {"matrix": [1, 0.5, 0, 0, 0, 1, 0, 0, 0.2, 0, -1, 0, *rng.normal(size=3), 1]}
    return {name: value for name, value in parts.items() if name == "matrix" or rng.random() < 0.8} | more


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = vertices.astype(np.float64)[faces.T]
    return float(np.einsum("fi,fi->", np.cross(a, b), c))


@pytest.mark.parametrize("seed", range(20))
def test_nested_nodes_are_where_trimesh_puts_them(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    nodes = [node(rng, children=[1, 2]), node(rng, mesh=0), node(rng, children=[3], mesh=0), node(rng, mesh=0)]
    path = sheet(nodes).save(tmp_path / "x.glb")
    found = read_mesh(path).mesh
    scene = trimesh.load_scene(path, process=False)
    expected = scene.to_mesh()
    np.testing.assert_allclose(found.vertices.min(axis=0), expected.bounds[0], atol=1e-5)
    np.testing.assert_allclose(found.vertices.max(axis=0), expected.bounds[1], atol=1e-5)
    areas = trimesh.Trimesh(found.vertices, found.faces, process=False).area
    assert areas == pytest.approx(expected.area, rel=1e-5)
    assert signed_volume(found.vertices, found.faces) == pytest.approx(
        signed_volume(expected.vertices, expected.faces), rel=1e-4, abs=1e-4
    ), "mirrored surfaces keep their outside"


def test_a_quarter_turn(tmp_path: Path) -> None:
    """About y, from z to x; scaled before it and moved after."""
    half = np.sqrt(0.5)
    placed = {"mesh": 0, "rotation": [0, half, 0, half], "scale": [1, 2, 3], "translation": [5, 6, 7]}
    x, y, z = VERTICES.T
    found = read_mesh(sheet([placed]).save(tmp_path / "x.glb")).mesh
    np.testing.assert_allclose(found.vertices, np.column_stack([3 * z + 5, 2 * y + 6, -x + 7]), atol=1e-6)


def test_files_without_a_scene_or_with_several(tmp_path: Path) -> None:
    far = {"mesh": 0, "translation": [10, 0, 0]}
    for tree, left in (
        ({"scenes": [{"nodes": [0]}, {"nodes": [1]}], "scene": 1}, [10]),
        ({"scenes": [{"nodes": [0]}, {"nodes": [1]}]}, [0]),
        ({"scenes": []}, [0, 10]),
        ({}, [0, 10]),
    ):
        file = sheet([{"mesh": 0}, far])
        del file.tree["scenes"], file.tree["scene"]
        file.tree |= tree
        vertices = read_mesh(file.save(tmp_path / "x.glb")).mesh.vertices
        assert sorted(vertices[::16, 0].tolist()) == left


def test_meshes_that_no_node_places(tmp_path: Path) -> None:
    file = sheet([])
    del file.tree["scenes"], file.tree["scene"], file.tree["nodes"]
    np.testing.assert_array_equal(read_mesh(file.save(tmp_path / "x.glb")).mesh.vertices, VERTICES)


def test_what_is_hidden_is_not_there(tmp_path: Path) -> None:
    hidden = {"extensions": {"KHR_node_visibility": {"visible": False}}}
    file = sheet([{"mesh": 0}, {"children": [2]} | hidden, {"mesh": 0}])
    file.tree["scenes"] = [{"nodes": [0, 1]}]
    assert len(read_mesh(file.save(tmp_path / "x.glb")).mesh.vertices) == 16


def test_a_mesh_in_many_places_at_once_is_named(tmp_path: Path) -> None:
    file = sheet([{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {}}}}])
    with pytest.raises(InputError, match="found EXT_mesh_gpu_instancing, which is not read"):
        read_mesh(file.save(tmp_path / "x.glb"))


@pytest.mark.parametrize(
    ("tree", "said"),
    [
        ({"nodes": [{"children": [1]}, {"children": [0]}]}, "expected a tree of nodes"),
        ({"nodes": [{"children": [0], "mesh": 0}]}, "expected a tree of nodes"),
        ({"nodes": [{"children": [1, 1]}, {"mesh": 0}]}, "expected a tree of nodes"),
        ({"nodes": [{"children": [1]}, {"children": [0]}], "scenes": []}, "expected a tree of nodes"),
        ({"nodes": [{"children": [7]}]}, "expected one of 1 nodes, found '7'"),
        ({"nodes": [{"children": [-1], "mesh": 0}]}, "expected one of 1 nodes, found '-1'"),
        ({"nodes": [{"mesh": 3}]}, "expected one of 1 meshes, found '3'"),
        ({"nodes": [{"mesh": True}]}, "expected one of 1 meshes"),
        ({"scene": 4}, "expected one of 1 scenes, found '4'"),
        ({"nodes": [{"mesh": 0, "matrix": [1] * 15}]}, "matrix: expected 16 finite numbers"),
        ({"nodes": [{"mesh": 0, "rotation": ["a", 0, 0, 1]}]}, "rotation: expected 4 finite numbers"),
        ({"nodes": {"mesh": 0}}, "nodes"),
        ({"scenes": [{"nodes": []}]}, "empty mesh"),
    ],
)
def test_a_scene_that_is_none_is_one_line(tree: dict[str, Any], said: str, tmp_path: Path) -> None:
    file = sheet([{"mesh": 0}])
    file.tree |= tree
    with pytest.raises(InputError, match=said) as caught:
        read_mesh(file.save(tmp_path / "x.glb"))
    assert "\n" not in str(caught.value)


def test_a_tree_may_be_deep(tmp_path: Path) -> None:
    nodes: list[dict[str, Any]] = [{"children": [index + 1], "translation": [1, 0, 0]} for index in range(5000)]
    found = read_mesh(sheet([*nodes, {"mesh": 0}]).save(tmp_path / "x.glb")).mesh
    np.testing.assert_allclose(found.vertices[:, 0], VERTICES[:, 0] + 5000)
