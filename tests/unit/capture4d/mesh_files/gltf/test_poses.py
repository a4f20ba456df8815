"""Morph targets and skins, against the standard's formula one vertex at a time."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.mesh_files.meshes import read_mesh
from tests.gltf_files import GltfFile, grid

VERTICES, FACES, _ = grid()
RNG = np.random.default_rng(6)
OFFSETS = RNG.normal(size=(2, 16, 3)).astype(np.float32)


@pytest.mark.parametrize(
    ("mesh", "node", "meant"),
    [(None, None, (0, 0)), ([0.5, 0], None, (0.5, 0)), ([0.5, 0], [0, 2], (0, 2)), ([1, 1], None, (1, 1))],
)
def test_morph_targets_are_added_as_much_as_they_weigh(mesh, node, meant, tmp_path: Path) -> None:
    file = GltfFile()
    indices = file.accessor(FACES.ravel(), 5123)
    targets = [{"POSITION": file.accessor(OFFSETS[0], layout="over zeros")}, {"POSITION": file.accessor(OFFSETS[1])}]
    file.primitive({"POSITION": file.accessor(VERTICES)}, indices=indices, targets=targets)
    if mesh is not None:
        file.tree["meshes"][0]["weights"] = mesh
    if node is not None:
        file.tree["nodes"][0]["weights"] = node
    found = read_mesh(file.save(tmp_path / "x.glb")).mesh
    np.testing.assert_allclose(found.vertices, VERTICES + meant[0] * OFFSETS[0] + meant[1] * OFFSETS[1], atol=1e-6)
    file.tree["meshes"][0]["weights"] = [1]
    file.tree["nodes"][0].pop("weights", None)
    with pytest.raises(InputError, match="weights: expected 2 finite numbers, found 1"):
        read_mesh(file.save(tmp_path / "x.glb"))


@pytest.mark.parametrize("component", [5121, 5123])
@pytest.mark.parametrize("bound", [True, False])
@pytest.mark.parametrize("groups", [1, 2])
def test_a_skin_hangs_from_its_joints_wherever_its_node_is(
    component: int, bound: bool, groups: int, tmp_path: Path
) -> None:
    world, inverse = np.tile(np.eye(4), (2, 3, 1, 1))
    for matrix in (*world, *inverse):
        matrix[:3] = np.column_stack([Rotation.random(rng=RNG).as_matrix() * RNG.uniform(0.5, 2), RNG.normal(size=3)])
    joints = RNG.integers(0, 3, (16, 4 * groups))
    weights = RNG.dirichlet(np.ones(4 * groups), 16).astype(np.float32)
    file = GltfFile()
    attributes = {"POSITION": file.accessor(VERTICES)}
    for group in range(groups):
        part = slice(4 * group, 4 * group + 4)
        attributes[f"JOINTS_{group}"] = file.accessor(joints[:, part], component)
        attributes[f"WEIGHTS_{group}"] = file.accessor(weights[:, part])
    file.primitive(attributes, indices=file.accessor(FACES.ravel(), 5123))
    nodes = [{"matrix": matrix.T.ravel().tolist()} for matrix in world]
    file.tree["nodes"] = [{"mesh": 0, "skin": 0, "translation": [9, 9, 9], "scale": [7, 7, 7]}, *nodes]
    file.tree["scenes"] = [{"nodes": [0, 1, 2, 3]}]
    skin = {"joints": [1, 2, 3]}
    if bound:
        skin["inverseBindMatrices"] = file.accessor(inverse.transpose(0, 2, 1).reshape(3, 16))
    file.add("skins", skin)
    found = read_mesh(file.save(tmp_path / "x.glb")).mesh
    for vertex, point in enumerate(VERTICES):
        expected = np.zeros(3)
        for joint, weight in zip(joints[vertex], weights[vertex], strict=True):
            matrix = world[joint] @ inverse[joint] if bound else world[joint]
            expected += weight * (matrix @ [*point, 1])[:3]
        np.testing.assert_allclose(found.vertices[vertex], expected, atol=1e-5)
    file.tree["skins"][0]["joints"] = [1, 2]
    with pytest.raises(InputError, match="expected numbers from 0 to 1"):
        read_mesh(file.save(tmp_path / "x.glb"))
    file.tree["skins"][0]["joints"] = [1, 2, 44]
    with pytest.raises(InputError, match=r"skins\[0\]: expected joints in the scene, found \[44\]"):
        read_mesh(file.save(tmp_path / "x.glb"))
