"""Laws of mesh geometry on shapes whose answers are known."""

import numpy as np
import pytest

from capture4d.geometry.mesh import (
    boundary_edges,
    boundary_loops,
    connected_components,
    doubled_area_vectors,
    edge_uses,
    edges_of_faces,
    face_areas,
    half_edges,
    normalised,
    submesh,
    unique_edges,
    vertex_adjacency,
    vertex_normals,
)
from capture4d.types import Mesh
from tests import shapes


def tube(around: int = 12, along: int = 5) -> Mesh:
    """An open cylinder, 1 across and 1 high: two border loops of `around` vertices."""
    return shapes.tube(around, along, 0.5, 1.0)


def test_area_vectors_are_as_long_as_twice_the_area_and_point_outwards():
    mesh = tube()
    normals = doubled_area_vectors(mesh.vertices, mesh.faces)
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 2 * face_areas(mesh.vertices, mesh.faces), rtol=1e-6)
    assert (np.einsum("fd,fd->f", normals, centres * [1, 0, 1]) > 0).all()


def test_vertex_normals_of_a_tube_are_radial_away_from_its_borders():
    mesh = tube(around=64, along=9)
    inner = slice(64, -64)
    radial = mesh.vertices[inner] * [1, 0, 1] / 0.5
    np.testing.assert_allclose(vertex_normals(mesh.vertices, mesh.faces)[inner], radial, atol=2e-3)


def test_a_face_without_area_has_no_normal():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    assert not normalised(doubled_area_vectors(vertices, faces)).any()
    assert not vertex_normals(vertices, faces).any()
    assert face_areas(vertices, faces) == pytest.approx(0)


def test_area_of_a_finer_tube_tends_to_the_cylinder():
    errors = [abs(face_areas(tube(n).vertices, tube(n).faces).sum() - np.pi) for n in (8, 16, 32)]
    assert errors[0] > 3 * errors[1] > 9 * errors[2]  # second order


def test_edges_satisfy_euler():
    mesh = tube(around=10, along=4)
    edges = unique_edges(mesh.faces)
    assert len(mesh.vertices) - len(edges) + len(mesh.faces) == 0  # a tube
    assert (edges[:, 0] < edges[:, 1]).all()
    assert len(np.unique(edges, axis=0)) == len(edges)


def test_sides_of_faces_are_found_among_the_edges_and_counted():
    mesh = tube(around=10, along=4)
    edges, uses = edge_uses(mesh.faces)
    np.testing.assert_array_equal(edges, unique_edges(mesh.faces))
    found = edges_of_faces(mesh.faces, edges)
    for face, row in zip(mesh.faces.tolist(), found, strict=True):
        for corner in range(3):
            assert set(edges[row[corner]].tolist()) == {face[corner], face[(corner + 1) % 3]}
    np.testing.assert_array_equal(np.bincount(found.ravel()), uses)
    assert sorted(edges[uses == 1].ravel().tolist()) == sorted(2 * [*range(10), *range(30, 40)])
    assert half_edges(mesh.faces)[:3].tolist() == [[0, 1], [1, 11], [11, 0]]


def test_loops_of_a_tube_are_its_two_rings_in_walking_order():
    mesh = tube(around=10, along=4)
    loops = boundary_loops(mesh.faces)
    assert [sorted(loop.tolist()) for loop in loops] == [list(range(10)), list(range(30, 40))]
    directed = {tuple(edge) for edge in boundary_edges(mesh.faces).tolist()}
    for loop in loops:
        assert set(zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True)) <= directed


def test_loops_that_touch_in_a_vertex_come_apart():
    faces = np.array([[0, 1, 2], [2, 3, 4]], np.int32)  # two triangles, tip to tip
    assert sorted(sorted(loop.tolist()) for loop in boundary_loops(faces)) == [[0, 1, 2], [2, 3, 4]]


def test_a_closed_mesh_has_no_border():
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    assert boundary_edges(faces).shape == (0, 2)
    assert boundary_loops(faces) == []


def test_no_faces_at_all():
    none = np.empty((0, 3), np.int32)
    assert unique_edges(none).shape == (0, 2)
    assert boundary_loops(none) == []
    assert connected_components(none, 3).tolist() == [0, 1, 2]


def test_adjacency_agrees_with_the_edges():
    mesh = tube(around=6, along=3)
    adjacency = vertex_adjacency(mesh.faces, len(mesh.vertices)).toarray()
    expected = np.zeros_like(adjacency)
    for a, b in unique_edges(mesh.faces):
        expected[a, b] = expected[b, a] = 1
    np.testing.assert_array_equal(adjacency, expected)


def test_components_of_two_tubes():
    one = tube(around=6, along=3)
    count = len(one.vertices)
    labels = connected_components(np.concatenate([one.faces, one.faces + np.int32(count)]), 2 * count + 1)
    assert len(np.unique(labels)) == 3  # and one vertex on its own
    assert len(np.unique(labels[:count])) == len(np.unique(labels[count:-1])) == 1


def test_submesh_keeps_geometry_and_order():
    mesh = tube(around=8, along=4)
    mesh = Mesh(mesh.vertices, mesh.faces, np.random.default_rng(0).random((len(mesh.faces), 3, 2), np.float32))
    mask = np.arange(len(mesh.faces)) % 3 == 0
    part, kept = submesh(mesh, mask)
    np.testing.assert_array_equal(part.vertices, mesh.vertices[kept])
    np.testing.assert_array_equal(kept[part.faces], mesh.faces[mask])
    assert mesh.uv is not None
    np.testing.assert_array_equal(part.uv, mesh.uv[mask])
