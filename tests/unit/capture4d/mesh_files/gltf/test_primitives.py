"""Primitives: strips and fans, what is passed over, and what is refused."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from capture4d.errors import InputError
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh
from tests.gltf_files import GltfFile, grid

VERTICES, FACES, _ = grid()


def strips(side: int = 4) -> np.ndarray:
    """The sheet as one strip: row after row, joined by corners that are there twice."""
    rows = [np.column_stack([np.arange(side) + side, np.arange(side)]).ravel() + side * row for row in range(side - 1)]
    joined = [rows[0]]
    for before, after in itertools.pairwise(rows):
        joined += [before[-1:], after[:1], after]
    return np.concatenate(joined)


def drawn(corners: np.ndarray, mode: int, folder: Path) -> np.ndarray:
    file = GltfFile()
    file.primitive({"POSITION": file.accessor(VERTICES)}, indices=file.accessor(corners, 5125), mode=mode)
    return read_mesh(file.save(folder / "x.glb")).mesh.faces


def test_a_joined_strip_is_the_sheet(tmp_path: Path) -> None:
    """The same area, faced the same way everywhere, and nothing where two rows are joined."""
    faces = drawn(strips(), 5, tmp_path)
    assert len(faces) == 18
    flat = VERTICES * [1, 1, 0]
    normals = np.cross(flat[faces[:, 1]] - flat[faces[:, 0]], flat[faces[:, 2]] - flat[faces[:, 0]])
    np.testing.assert_allclose(normals[:, 2], 1 / 9, atol=1e-6)
    expected = trimesh.load_scene(tmp_path / "x.glb", process=False).to_mesh()
    assert trimesh.Trimesh(VERTICES, faces).area == pytest.approx(expected.area, rel=1e-6)


def test_a_fan_goes_around_its_first_corner(tmp_path: Path) -> None:
    assert drawn(np.array([5, 6, 10, 9, 9, 8]), 6, tmp_path).tolist() == [[5, 6, 10], [5, 10, 9], [5, 9, 8]]


@pytest.mark.parametrize("mode", [5, 6])
@pytest.mark.parametrize("count", [1, 2])
def test_a_strip_of_two_corners_is_nothing(mode: int, count: int, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="empty mesh, found 16 vertices and no faces"):
        drawn(np.arange(count), mode, tmp_path)


def test_points_and_lines_are_passed_over(tmp_path: Path) -> None:
    file = GltfFile()
    attributes = {"POSITION": file.accessor(VERTICES)}
    for mode in range(4):
        file.primitive(attributes, mode=mode)
    file.primitive(attributes, indices=file.accessor(FACES.ravel(), 5123))
    found = read_mesh(file.save(tmp_path / "x.glb")).mesh
    np.testing.assert_array_equal(found.faces, FACES)


def test_each_surface_follows_the_one_before(tmp_path: Path) -> None:
    file = GltfFile()
    indices = file.accessor(FACES.ravel(), 5123)
    for shift in (0, 1, 2):
        file.primitive({"POSITION": file.accessor(VERTICES + np.float32(shift))}, indices=indices)
    found = read_mesh(file.save(tmp_path / "x.glb")).mesh
    np.testing.assert_array_equal(found.faces, np.concatenate([FACES, FACES + 16, FACES + 32]))
    np.testing.assert_allclose(found.vertices[::16, 0], [0, 1, 2])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"mode": 7}, "expected a kind of primitive from 0 to 6, found '7'"),
        ({"mode": "4"}, "expected a kind of primitive from 0 to 6"),
        ({"attributes": None}, "expected attributes of a primitive, found 'None'"),
        ({"attributes": {}}, "expected POSITION in a primitive, found none"),
        ({"attributes": {"POSITION": 1}}, "POSITION: expected 3 numbers a vertex, found 1"),
        ({"attributes": {"POSITION": 0, "COLOR_0": 2}}, "expected COLOR_0 of each of 16 vertices, found 15"),
        ({"attributes": {"POSITION": 0, "TEXCOORD_0": 3}}, "expected TEXCOORD_0 of each of 16 vertices, found 15"),
        ({"attributes": {"POSITION": 0, "TEXCOORD_0": 2}}, "TEXCOORD_0: expected 2 numbers a vertex, found 3"),
        ({"indices": 0}, "indices: expected whole numbers, found float32"),
        ({"indices": 9}, "expected one of 4 accessors, found '9'"),
        ({"material": 5}, "expected one of 0 materials, found '5'"),
        ({"attributes": {"POSITION": 2}}, "expected vertex indices from 0 to 14, found 15"),
    ],
)
def test_a_primitive_that_is_none_is_one_line(change: dict[str, Any], said: str, tmp_path: Path) -> None:
    file = GltfFile()
    position, indices = file.accessor(VERTICES), file.accessor(FACES.ravel(), 5123)
    file.accessor(VERTICES[:15])
    file.accessor(VERTICES[:15, :2])
    primitive = file.primitive({"POSITION": position}, indices=indices)
    primitive |= change
    with pytest.raises(InputError, match=said) as caught:
        read_coloured_mesh(file.save(tmp_path / "x.glb"))
    assert "\n" not in str(caught.value)


def test_corners_that_make_no_whole_triangle_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected three corners a triangle, found 4 in all"):
        drawn(np.arange(4), 4, tmp_path)
