"""Seams: what a file splits comes back whole, and nothing else is joined."""

import io

import numpy as np
import pytest
import trimesh

from capture4d.geometry.mesh import boundary_loops, edge_uses
from capture4d.geometry.seams import weld, welded_mesh
from capture4d.types import Mesh
from tests.shapes import plane, tube


def split(mesh: Mesh, chart: np.ndarray) -> Mesh:
    """Every chart of faces gets vertices of its own."""
    keys = mesh.faces.astype(np.int64) * (chart.max() + 1) + chart[:, None]
    kept, corners = np.unique(keys, return_inverse=True)
    return Mesh(mesh.vertices[kept // (chart.max() + 1)], corners.reshape(-1, 3).astype(np.int32), mesh.uv)


def charts(mesh: Mesh, kind: str) -> np.ndarray:
    count, rng = len(mesh.faces), np.random.default_rng(0)
    height = mesh.vertices[mesh.faces].mean(axis=1)
    match kind:
        case "none":
            return np.zeros(count, np.int64)
        case "every face":
            return np.arange(count)
        case "front and back":
            return (height[:, 2] > 0).astype(np.int64)
        case "at random":
            return rng.integers(0, 7, count)
        case _:
            return rng.integers(0, 2, count) * (height[:, 1] > 0.2)


@pytest.mark.parametrize("kind", ["none", "every face", "front and back", "at random", "half"])
def test_a_split_mesh_is_what_it_was(kind: str):
    mesh = tube(24, 16)
    parts = split(mesh, charts(mesh, kind))
    found, welded = welded_mesh(parts)
    assert len(found.vertices) == len(mesh.vertices)
    np.testing.assert_array_equal(found.vertices[found.faces], mesh.vertices[mesh.faces])
    assert sorted(map(len, boundary_loops(found.faces))) == [24, 24]
    assert (edge_uses(found.faces)[1] <= 2).all()
    np.testing.assert_array_equal(found.uv, mesh.uv)
    np.testing.assert_array_equal(found.vertices[welded.of_vertex], parts.vertices)
    np.testing.assert_array_equal(welded.of_vertex[welded.first], np.arange(len(welded.first)))
    assert (np.diff(welded.first) > 0).all(), "vertices keep their turn"
    assert welded.against == 0


@pytest.mark.parametrize("kind", ["every face", "front and back", "at random"])
def test_trimesh_merges_the_same(kind: str):
    mesh = tube(20, 9)
    parts = split(mesh, charts(mesh, kind))
    theirs = trimesh.Trimesh(parts.vertices, parts.faces, process=False)
    theirs.merge_vertices()
    ours, _ = welded_mesh(parts)
    assert len(ours.vertices) == len(theirs.vertices)
    assert len(edge_uses(ours.faces)[0]) == len(theirs.edges_unique)


def test_an_stl_of_trimesh_is_whole_again():
    mesh = tube(18, 10)
    data = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="stl")
    read = trimesh.load(io.BytesIO(data), file_type="stl", process=False)
    found = weld(np.asarray(read.vertices), np.asarray(read.faces))
    assert len(found.first) == len(mesh.vertices)
    assert len(boundary_loops(found.faces)) == 2


def both(one: Mesh, other: Mesh) -> Mesh:
    return Mesh(
        np.concatenate([one.vertices, other.vertices]),
        np.concatenate([one.faces, other.faces + len(one.vertices)]).astype(np.int32),
    )


def turned_over(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]))


@pytest.mark.parametrize(
    "other",
    [
        pytest.param(plane(), id="the same cloth twice"),
        pytest.param(turned_over(plane()), id="cloth that is seen from both sides"),
        pytest.param(plane(height=1e-5), id="cloth a hundredth of a millimetre above"),
        pytest.param(Mesh(plane().vertices + np.float32([1, 0, 1]), plane().faces), id="touching in a corner"),
    ],
)
def test_cloth_that_touches_is_not_fused(other: Mesh):
    mesh = both(plane(), other)
    found, welded = welded_mesh(mesh)
    assert found is mesh
    assert not welded.is_split
    assert len(boundary_loops(found.faces)) == 2


def test_a_lining_wound_as_its_cloth_keeps_its_borders():
    """Two tubes, one in the other, whose hems coincide."""
    outer, inner = tube(24, 5), tube(24, 5)
    shrunk = inner.vertices.copy()
    shrunk[24:, [0, 2]] *= np.float32(0.9)
    found, welded = welded_mesh(both(outer, Mesh(shrunk, inner.faces)))
    assert len(boundary_loops(found.faces)) == 4
    assert welded.against == 24


def test_three_sheets_at_an_edge_stay_apart():
    mesh = plane(cells=1)
    sheets = mesh
    for angle in (2.1, 4.2):
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
        sheets = both(sheets, Mesh((mesh.vertices @ turn.T).astype(np.float32), mesh.faces))
    assert not welded_mesh(sheets)[1].is_split


@pytest.mark.parametrize("scale", [0.01, 1.0, 1000.0])
def test_pieces_that_were_rounded_apart_are_joined(scale: float):
    mesh = tube(24, 16)
    parts = split(mesh, charts(mesh, "front and back"))
    vertices = (scale * parts.vertices).astype(np.float32)
    steps = np.random.default_rng(1).integers(-1, 2, vertices.shape)
    rounded = np.where(steps > 0, np.nextafter(vertices, np.float32(9e9)), vertices)
    rounded = np.where(steps < 0, np.nextafter(vertices, np.float32(-9e9)), rounded).astype(np.float32)
    found = weld(rounded, parts.faces)
    assert len(found.first) == len(mesh.vertices)


def test_minus_zero_is_zero():
    mesh = plane(cells=2)
    parts = split(mesh, np.arange(len(mesh.faces)))
    signed = np.where((parts.vertices == 0) & (np.arange(len(parts.vertices)) % 2 == 0)[:, None], -0.0, parts.vertices)
    assert len(weld(signed.astype(np.float32), parts.faces).first) == len(mesh.vertices)


def test_vertices_in_no_face_stay():
    mesh = both(Mesh(np.zeros((2, 3), np.float32), np.zeros((0, 3), np.int32)), plane())
    found = weld(mesh.vertices, mesh.faces)
    assert not found.is_split
    assert len(found.first) == len(mesh.vertices)
    assert len(weld(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)).first) == 0
