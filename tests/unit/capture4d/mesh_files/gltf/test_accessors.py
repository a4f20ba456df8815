"""Accessors: every component type, layout and kind of index holds the same mesh."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh
from tests.gltf_files import DTYPES, LAYOUTS, GltfFile, Layout, grid

VERTICES, FACES, UV = grid()
COMPONENTS = [(5126, False), *itertools.product([5120, 5121, 5122, 5123], [False, True])]
INDICES = [None, *itertools.product([5121, 5123, 5125], ["plain", "sparse", "over zeros"])]


def stored(values: np.ndarray, component: int, fractions: bool) -> tuple[np.ndarray, np.ndarray]:
    """Numbers from 0 to 1 as they lie in the file, and as they are meant."""
    dtype = DTYPES[component]
    if component == 5126:
        return values, values
    most = np.iinfo(dtype).max
    if fractions:
        held = np.rint(values * most).astype(dtype)
        return held, held / most
    held = np.rint(values * 100).astype(dtype)
    return held, held.astype(np.float64)


def as_mode(mode: int, corners: np.ndarray) -> np.ndarray:
    """Triangles of corners, one by one as the standard lists them; those without an area left out."""
    if mode == 4:
        return corners.reshape(-1, 3)
    faces = []
    for row in range(len(corners) - 2):
        a, b, c = corners[row : row + 3] if mode == 5 else (corners[0], corners[row + 1], corners[row + 2])
        if len({a, b, c}) == 3:
            faces.append([b, a, c] if mode == 5 and row % 2 else [a, b, c])
    return np.array(faces).reshape(-1, 3)


@pytest.mark.parametrize(("component", "fractions"), COMPONENTS)
@pytest.mark.parametrize("mode", [4, 5, 6])
def test_a_mesh_is_the_same_however_it_is_stored(component: int, fractions: bool, mode: int, tmp_path: Path) -> None:
    held, meant = stored(VERTICES[:15], component, fractions)
    corners = FACES[(FACES < 15).all(axis=1)].ravel() if mode == 4 else np.array([0, 1, 4, 5, 5, 5, 6, 2, 10, 3])
    for layout, index in itertools.product(LAYOUTS, INDICES):
        file = GltfFile()
        more = {} if index is None else {"indices": file.accessor(corners, *index)}
        file.primitive({"POSITION": file.accessor(held, component, layout, fractions=fractions)}, mode=mode, **more)
        found = read_mesh(file.save(tmp_path / "x.glb")).mesh
        np.testing.assert_allclose(found.vertices, meant, rtol=1e-6, err_msg=f"{layout} {index}")
        expected = as_mode(mode, np.arange(15) if index is None else corners)
        assert len(found.faces) == len(expected)
        assert all(face in turns(same) for face, same in zip(found.faces.tolist(), expected.tolist(), strict=True))


def turns(face: list[int]) -> list[list[int]]:
    """A face from each of its corners on."""
    return [face[shift:] + face[:shift] for shift in range(3)]


@pytest.mark.parametrize(("component", "fractions"), [(5126, False), (5121, True), (5123, True), (5120, True)])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_uvs_of_any_kind(component: int, fractions: bool, layout: Layout, tmp_path: Path) -> None:
    held, meant = stored(UV, component, fractions)
    file = GltfFile()
    uv = file.accessor(held, component, layout, fractions=fractions)
    file.primitive({"POSITION": file.accessor(VERTICES), "TEXCOORD_0": uv}, indices=file.accessor(FACES.ravel(), 5123))
    found = read_mesh(file.save(tmp_path / "x.glb")).mesh
    assert found.uv is not None
    np.testing.assert_allclose(found.uv, ([0, 1] + meant * [1, -1])[FACES], atol=1e-6)


@pytest.mark.parametrize("component", [5121, 5123, 5126])
@pytest.mark.parametrize("width", [3, 4])
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("fractions", [True, False])
def test_colours_of_any_kind(component: int, width: int, layout: Layout, fractions: bool, tmp_path: Path) -> None:
    """Not to say that they are fractions is a fault of the file, but there is nothing else that they could be."""
    light = np.random.default_rng(component + width).random((16, width))
    held, meant = stored(light, component, True)
    file = GltfFile()
    colours = file.accessor(held, component, layout, fractions=fractions and component != 5126)
    indices = file.accessor(FACES.ravel(), 5123)
    file.primitive({"POSITION": file.accessor(VERTICES), "COLOR_0": colours}, indices=indices)
    found = read_coloured_mesh(file.save(tmp_path / "x.glb")).colours
    assert found is not None
    np.testing.assert_array_equal(found, [[srgb(value) for value in row[:3]] for row in meant])


def srgb(light: float) -> int:
    """IEC 61966-2-1."""
    return round(255 * (12.92 * light if light <= 0.0031308 else 1.055 * light ** (1 / 2.4) - 0.055))


def test_a_whole_number_may_be_written_as_a_fraction(tmp_path: Path) -> None:
    file = GltfFile()
    file.primitive({"POSITION": file.accessor(VERTICES)}, indices=file.accessor(FACES.ravel(), 5123))
    file.tree["accessors"][0]["count"] = 16.0
    assert len(read_mesh(file.save(tmp_path / "x.glb")).mesh.vertices) == 16


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"componentType": 5124}, "expected a component type of glTF, found '5124'"),
        ({"componentType": True}, "expected a component type"),
        ({"type": "VEC5"}, "expected a type of glTF, found 'VEC5'"),
        ({"type": "VEC2"}, "POSITION: expected 3 numbers a vertex, found 2"),
        ({"count": -1}, "count: expected a whole number"),
        ({"count": 1.5}, "count: expected a whole number"),
        ({"count": 17}, r"accessors\[0\]: expected 204 bytes, found 192"),
        ({"byteOffset": 4}, r"accessors\[0\]: expected 196 bytes, found 192"),
        ({"bufferView": None, "count": 10**12}, "expected a buffer view, found none"),
        ({"bufferView": 9}, "expected one of 2 bufferViews"),
        ({"sparse": {"count": 1, "indices": {"bufferView": 1, "componentType": 5126},
                     "values": {"bufferView": 0}}}, r"sparse: expected indices that are whole numbers"),
        ({"sparse": {"count": 10**9, "indices": {"bufferView": 1, "componentType": 5123},
                     "values": {"bufferView": 0}}}, "sparse: expected"),
        ({"sparse": {"count": 16, "indices": {"bufferView": 0, "componentType": 5125},
                     "values": {"bufferView": 0}}}, "sparse: expected indices from 0 to 15, found"),
    ],
)  # fmt: skip
def test_an_accessor_that_lies_is_one_line(change: dict, said: str, tmp_path: Path) -> None:
    file = GltfFile()
    file.primitive({"POSITION": file.accessor(VERTICES)}, indices=file.accessor(FACES.ravel(), 5123))
    file.tree["accessors"][0] |= change
    with pytest.raises(InputError, match=said) as caught:
        read_mesh(file.save(tmp_path / "x.glb"))
    assert "\n" not in str(caught.value)


def test_elements_do_not_overlap(tmp_path: Path) -> None:
    file = GltfFile()
    file.primitive({"POSITION": file.accessor(VERTICES)}, indices=file.accessor(FACES.ravel(), 5123))
    file.tree["bufferViews"][0]["byteStride"] = 4
    with pytest.raises(InputError, match="expected 12 bytes from one element to the next, found 4"):
        read_mesh(file.save(tmp_path / "x.glb"))


def test_zeros_take_no_more_room_than_a_file_can_mean(tmp_path: Path) -> None:
    """A surface may be black or have no UVs of its own, in as many vertices as it has bytes for; more is a lie."""
    file = GltfFile()
    colours = file.add("accessors", {"componentType": 5121, "type": "VEC3", "count": 16, "normalized": True})
    indices = file.accessor(FACES.ravel(), 5123)
    file.primitive({"POSITION": file.accessor(VERTICES), "COLOR_0": colours}, indices=indices)
    found = read_coloured_mesh(file.save(tmp_path / "x.glb")).colours
    assert found is not None
    assert not found.any()
    file.tree["accessors"][colours]["count"] = 90_000_000
    with pytest.raises(InputError, match="expected a buffer view, found none for 90000000 elements"):
        read_coloured_mesh(file.save(tmp_path / "x.glb"))


def test_a_large_surface_may_be_zeros_but_for_some_rows(tmp_path: Path) -> None:
    """Beside a file whose JSON is small."""
    count = 70_000
    points = np.zeros((count, 3), np.float32)
    points[-3:] = np.eye(3)
    file = GltfFile()
    position = file.accessor(points, layout="over zeros")
    indices = file.accessor(np.arange(count - 3, count), 5125)
    file.primitive({"POSITION": position}, indices=indices)
    sparse = file.tree["accessors"][position]["sparse"]["indices"]
    sparse |= {"bufferView": file.view(np.arange(count - 3, count).astype("<u4").tobytes()), "byteOffset": 0}
    sparse["componentType"] = 5125
    (tmp_path / "x.bin").write_bytes(bytes(file.data) + bytes(2000))
    found = read_mesh(file.save(tmp_path / "x.gltf", uri="x.bin")).mesh
    np.testing.assert_array_equal(found.vertices, points)
