"""Weights that sum to one, maps that are exact, and nodes that do not reach through the air."""

from collections.abc import Callable

import numpy as np
import pytest

from capture4d.types import Mesh
from registration.deformation_graph import (
    build_graph,
    identity_nodes,
    node_edge_rows,
    rows_of_vertices,
    smooth_rows,
)


@pytest.fixture
def mesh(tube: Callable[[int, int], Mesh]) -> Mesh:
    return tube(24, 12)


def affine_nodes(rest: np.ndarray, matrix: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Nodes of one global affine map: A (v - g) + g + t = matrix v + shift."""
    nodes = np.empty((len(rest), 3, 4))
    nodes[:, :, :3] = matrix
    nodes[:, :, 3] = rest @ matrix.T + shift - rest
    return nodes


def test_weights_are_a_partition_of_unity(mesh: Mesh) -> None:
    graph = build_graph(mesh.vertices.astype(float), mesh.faces, nodes=30, nodes_per_vertex=5)
    np.testing.assert_allclose(graph.vertex_weights.sum(axis=1), 1, atol=1e-12)
    assert graph.vertex_weights.min() >= 0
    assert len(np.unique(graph.nodes)) == 30


def test_affine_maps_are_reproduced_exactly(mesh: Mesh) -> None:
    vertices = mesh.vertices.astype(float)
    graph = build_graph(vertices, mesh.faces, nodes=25, nodes_per_vertex=6)
    rng = np.random.default_rng(0)
    matrix, shift = np.eye(3) + 0.3 * rng.standard_normal((3, 3)), rng.standard_normal(3)
    rows = rows_of_vertices(graph, vertices, np.arange(len(vertices)))
    constant = vertices - rows.apply(identity_nodes(25))
    moved = rows.apply(affine_nodes(vertices[graph.nodes], matrix, shift)) + constant
    np.testing.assert_allclose(moved, vertices @ matrix.T + shift, atol=1e-12)


def test_a_global_affine_map_is_smooth(mesh: Mesh) -> None:
    vertices = mesh.vertices.astype(float)
    graph = build_graph(vertices, mesh.faces, nodes=25, nodes_per_vertex=6)
    rows, constant = smooth_rows(graph, vertices)
    matrix = np.array([[1.0, 0.2, 0.0], [0.0, 0.9, 0.1], [0.3, 0.0, 1.1]])
    nodes = affine_nodes(vertices[graph.nodes], matrix, np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(rows.apply(nodes) + constant, 0, atol=1e-12)


def test_node_pairs_give_the_change_of_their_distance(mesh: Mesh) -> None:
    graph = build_graph(mesh.vertices.astype(float), mesh.faces, nodes=10, nodes_per_vertex=4)
    rows, pairs = node_edge_rows(graph)
    nodes = identity_nodes(10)
    nodes[:, :, 3] = np.random.default_rng(0).standard_normal((10, 3))
    np.testing.assert_allclose(rows.apply(nodes), nodes[pairs[:, 1], :, 3] - nodes[pairs[:, 0], :, 3])


def test_nodes_do_not_reach_across_the_gap_of_a_fold() -> None:
    """A strip folded like a U: its two arms are 1 cm apart in space and far apart along the surface."""
    along, across = 40, 4
    s = np.linspace(0, 1, along)
    profile = np.column_stack([0.005 * np.sign(s - 0.5), np.abs(s - 0.5)])
    vertices = np.array([[x, y, z] for x, y in profile for z in np.linspace(0, 0.05, across)])
    index = np.arange(along * across).reshape(along, across)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    graph = build_graph(vertices, faces.astype(np.int32), nodes=16, nodes_per_vertex=3)
    arm_of_vertex, arm_of_node = vertices[:, 0] > 0, vertices[graph.nodes][:, 0] > 0
    far = vertices[:, 1] > 0.25
    crossing = (arm_of_node[graph.vertex_nodes] != arm_of_vertex[:, None]) & (graph.vertex_weights > 0)
    assert not crossing[far].any()


def test_every_part_gets_a_node(mesh: Mesh) -> None:
    count = len(mesh.vertices)
    vertices = np.concatenate([mesh.vertices, mesh.vertices + 5]).astype(float)
    faces = np.concatenate([mesh.faces, mesh.faces + count]).astype(np.int32)
    graph = build_graph(vertices, faces, nodes=8, nodes_per_vertex=6)
    first = graph.nodes < count
    assert 0 < first.sum() < 8
    crossing = (graph.nodes[graph.vertex_nodes] < count) != (np.arange(2 * count) < count)[:, None]
    assert not (crossing & (graph.vertex_weights > 0)).any()
