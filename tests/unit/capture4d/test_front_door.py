"""`import capture4d`: every name is there, typed, and nothing is loaded before it is used."""

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

import capture4d
from capture4d import one_shot
from capture4d.errors import InputError
from capture4d.mesh_files.polygons import MeshFile
from capture4d.types import Mesh

ROOT = Path(__file__).parents[3]


def test_importing_it_loads_nothing_heavy():
    script = (
        "import sys, capture4d\n"
        "heavy = {'numpy', 'scipy', 'torch', 'open3d', 'numba', 'warp', 'trimesh', 'jaxtyping'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)


@pytest.mark.parametrize("name", capture4d.__all__)
def test_every_name_is_there(name: str):
    assert getattr(capture4d, name) is not None
    assert name in dir(capture4d)


def test_type_checkers_see_the_same_names():
    tree = ast.parse(Path(capture4d.__file__).read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.asname: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    modules = {"configs", "pipeline"}
    told = {name: getattr(capture4d, name).__module__ for name in seen if name not in modules}
    assert set(seen) == {*capture4d.__all__} - {"__version__"}
    assert {name: module for name, module in seen.items() if name not in modules} == told
    assert (Path(capture4d.__file__).parent / "py.typed").is_file()


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'beauty'"):
        _ = capture4d.beauty


# --- arrays of anybody's


TRIANGLES = [[0, 1, 2], [0, 2, 3]]
CORNERS = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


@pytest.mark.parametrize(
    "value",
    [
        (CORNERS, TRIANGLES),
        (np.array(CORNERS, np.float64), np.array(TRIANGLES, np.int64)),
        (np.array(CORNERS, np.float16), np.array(TRIANGLES, np.uint8)),
        trimesh.Trimesh(CORNERS, TRIANGLES, process=False),
        Mesh(np.array(CORNERS, np.float32), np.array(TRIANGLES, np.int32)),
        MeshFile(Mesh(np.array(CORNERS, np.float32), np.array(TRIANGLES, np.int32))),
    ],
)
def test_whatever_is_a_mesh_is_one(value: object):
    mesh = one_shot.as_mesh(value)
    np.testing.assert_array_equal(mesh.vertices, CORNERS)
    np.testing.assert_array_equal(mesh.faces, TRIANGLES)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (3, "template: expected a mesh, a pair (vertices, faces)"),
        ((CORNERS,), "template: expected a mesh, a pair (vertices, faces)"),
        (([[0, 0]], TRIANGLES), "template: expected vertices of shape (V, 3), found int64 of (1, 2)"),
        ((CORNERS, [[0.5, 1, 2]]), "template: expected faces of shape (F, 3), found float64 of (1, 3)"),
        ((CORNERS, [[0, 1, 4]]), "template: expected faces of 4 vertices, found 0 to 4 in them"),
        ((CORNERS, np.zeros((0, 3), int)), "template: expected a mesh with faces, found none"),
        (([[0, 0, np.nan]] * 3, [[0, 1, 2]]), "template: expected finite vertices, found NaN or infinity"),
    ],
)
def test_what_is_no_mesh_is_told_in_one_line(value: object, said: str):
    with pytest.raises(InputError) as caught:
        one_shot.as_mesh(value, "template")
    assert str(caught.value).startswith(said)


def test_a_mesh_is_registered_in_one_call():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    egg = sphere.vertices * [1.0, 1.2, 0.9]
    found = capture4d.register_mesh(sphere, (egg, sphere.faces))
    assert found.vertices.shape == egg.shape
    assert found.quality.verdict == "good"
    across = np.abs(np.sum((found.vertices / [1.0, 1.2, 0.9]) ** 2, axis=1) - 1)
    assert across.max() < 0.01
