"""The deformation graph: affine nodes on the template, and what they do to its vertices (checklist B5).

    v' = sum_k w_k(v) [A_k (v - g_k) + g_k + t_k]

Nodes g_k are template vertices spread by farthest point sampling along the surface, never through the air, so that a
sleeve's nodes do not move the torso it touches. Weights (1 - d/d_max)^2 of the nearest nodes are normalised: constants
and affine maps are reproduced exactly. Everything here is made once per template.

References: Sumner, Schmid, Pauly 2007 (embedded deformation); DeepWrinkles (ECCV 2018), section 3.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32, Integer
from scipy import sparse
from scipy.sparse import csgraph

from capture4d.geometry.mesh import connected_components, unique_edges
from registration.solver import Rows

__all__ = [
    "DeformationGraph",
    "build_graph",
    "identity_nodes",
    "node_edge_rows",
    "rows_of_vertices",
    "smooth_rows",
    "surface_graph",
]


@dataclass(frozen=True, slots=True, eq=False)
class DeformationGraph:
    """Nodes of a template, and the nodes of each vertex; rest positions enter only when rows are made."""

    nodes: Int32[np.ndarray, " nodes"]
    """Template vertex each node sits on."""
    vertex_nodes: Int32[np.ndarray, "verts per_vertex"]
    """Nearest nodes along the surface, nearest first."""
    vertex_weights: Float64[np.ndarray, "verts per_vertex"]
    """Rows sum to 1."""
    edges: Int32[np.ndarray, "edges 2"]
    """Directed pairs of nodes that share vertices."""
    spacing: float
    """Mean distance between a node and its nearest node, metres, on the template."""


def build_graph(
    vertices: Float64[np.ndarray, "verts 3"],
    faces: Integer[np.ndarray, "faces 3"],
    *,
    nodes: int,
    nodes_per_vertex: int,
) -> DeformationGraph:
    """Sample nodes along the surface and weigh them at every vertex.

    Every part of a template in several parts gets at least one node. Vertices without faces follow the nearest node in
    space.
    """
    distances_between = surface_graph(vertices, faces)
    parts = connected_components(faces, len(vertices)) if len(faces) else np.zeros(len(vertices), np.int32)
    sampled = _farthest_points(distances_between, _part_seeds(parts, faces), min(nodes, len(vertices)))
    distance = csgraph.dijkstra(distances_between, directed=False, indices=sampled)
    per_vertex = min(nodes_per_vertex, len(sampled))
    kept = min(per_vertex + 1, len(sampled))
    nearest = np.argpartition(distance, kept - 1, axis=0)[:kept]
    order = np.argsort(np.take_along_axis(distance, nearest, axis=0), axis=0, kind="stable")
    nearest = np.take_along_axis(nearest, order, axis=0).T
    near = np.take_along_axis(distance, nearest.T, axis=0).T
    lost = ~np.isfinite(near[:, 0])
    if lost.any():
        away = np.linalg.norm(vertices[lost, None] - vertices[None, sampled], axis=2)
        nearest[lost, 0], near[lost, 0] = np.argmin(away, axis=1), 0.0
    finite = np.where(np.isfinite(near), near, -1.0)
    reach = np.maximum(finite.max(axis=1, keepdims=True), 1e-12)
    if kept == per_vertex:
        reach = reach * 1.5
    weights = np.where(finite >= 0, (1.0 - np.minimum(finite / reach, 1.0)) ** 2, 0.0)[:, :per_vertex]
    weights[weights.sum(axis=1) <= 0, 0] = 1.0
    weights /= weights.sum(axis=1, keepdims=True)
    vertex_nodes = nearest[:, :per_vertex].astype(np.int32)
    between = distance[:, sampled]
    np.fill_diagonal(between, np.inf)
    closest = between.min(axis=1)
    spacing = float(closest[np.isfinite(closest)].mean()) if np.isfinite(closest).any() else 1.0
    edges = _node_edges(vertex_nodes, weights, len(sampled))
    return DeformationGraph(sampled.astype(np.int32), vertex_nodes, weights, edges, spacing)


def identity_nodes(count: int) -> Float64[np.ndarray, "nodes 3 4"]:
    """[A | t] of nodes that move nothing."""
    return np.tile(np.eye(3, 4), (count, 1, 1))


def rows_of_vertices(
    graph: DeformationGraph, vertices: Float64[np.ndarray, "verts 3"], subset: Integer[np.ndarray, " subset"]
) -> Rows:
    """Rows with v' = sum_k X_k [w_k (v - g_k); w_k] + sum_k w_k g_k for the vertices in `subset`, X_k = [A_k | t_k]."""
    nodes, weights = graph.vertex_nodes[subset], graph.vertex_weights[subset]
    offset = vertices[subset, None] - vertices[graph.nodes[nodes]]
    coefficients = np.concatenate([offset, np.ones((*nodes.shape, 1))], axis=2) * weights[:, :, None]
    count = nodes.shape[1]
    offsets = np.arange(0, len(subset) * count + 1, count, dtype=np.int32)
    return Rows(offsets, nodes.reshape(-1), coefficients.reshape(-1, 4))


def smooth_rows(
    graph: DeformationGraph, vertices: Float64[np.ndarray, "verts 3"]
) -> tuple[Rows, Float64[np.ndarray, "edges 3"]]:
    """Rows of A_i (g_j - g_i) + g_i + t_i - (g_j + t_j) for every directed node edge, and their constants g_i - g_j."""
    here, there = graph.edges[:, 0], graph.edges[:, 1]
    step = vertices[graph.nodes[there]] - vertices[graph.nodes[here]]
    coefficients = np.zeros((len(graph.edges), 2, 4))
    coefficients[:, 0, :3], coefficients[:, 0, 3], coefficients[:, 1, 3] = step, 1.0, -1.0
    offsets = np.arange(0, 2 * len(graph.edges) + 1, 2, dtype=np.int32)
    return Rows(offsets, graph.edges.reshape(-1).astype(np.int32), coefficients.reshape(-1, 4)), -step


def node_edge_rows(graph: DeformationGraph) -> tuple[Rows, Int32[np.ndarray, "pairs 2"]]:
    """Rows of t_j - t_i for every pair of neighbouring nodes i < j, and the pairs."""
    pairs = graph.edges[graph.edges[:, 0] < graph.edges[:, 1]]
    coefficients = np.zeros((len(pairs), 2, 4))
    coefficients[:, 0, 3], coefficients[:, 1, 3] = -1.0, 1.0
    offsets = np.arange(0, 2 * len(pairs) + 1, 2, dtype=np.int32)
    return Rows(offsets, pairs.reshape(-1).astype(np.int32), coefficients.reshape(-1, 4)), pairs


def surface_graph(vertices: np.ndarray, faces: np.ndarray) -> sparse.csr_array:
    """Edges, and the two corners across each inner edge: shorter detours, so distances closer to the geodesic."""
    count = len(vertices)
    pairs = unique_edges(faces)
    corners = np.concatenate([faces[:, [0, 1, 2]], faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]])
    low, high = np.minimum(corners[:, 0], corners[:, 1]), np.maximum(corners[:, 0], corners[:, 1])
    order = np.lexsort((high, low))
    low, high, across = low[order], high[order], corners[order, 2]
    shared = np.flatnonzero((low[1:] == low[:-1]) & (high[1:] == high[:-1]))
    pairs = np.concatenate([pairs, np.column_stack([across[shared], across[shared + 1]])])
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    length = np.maximum(np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1), 1e-12)
    return sparse.csr_array((length, (pairs[:, 0], pairs[:, 1])), shape=(count, count))


def _part_seeds(parts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The first vertex of every part that has faces, the largest part first."""
    used = np.unique(faces) if len(faces) else np.zeros(1, np.int64)
    labels, first, sizes = np.unique(parts[used], return_index=True, return_counts=True)
    return used[first[np.argsort(-sizes, kind="stable")]] if len(labels) else used[:1]


def _farthest_points(graph: sparse.csr_array, seeds: np.ndarray, count: int) -> np.ndarray:
    sampled = list(seeds)
    distance = csgraph.dijkstra(graph, directed=False, indices=seeds, min_only=True)
    distance[~np.isfinite(distance)] = 0.0
    while len(sampled) < count:
        farthest = int(np.argmax(distance))
        if distance[farthest] <= 0.0:
            break
        sampled.append(farthest)
        limit = float(distance[farthest])
        distance = np.minimum(distance, csgraph.dijkstra(graph, directed=False, indices=farthest, limit=limit))
    return np.array(sampled, np.int64)


def _node_edges(vertex_nodes: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Each node with the nodes that its vertices also listen to, both ways round."""
    rows = np.repeat(np.arange(len(vertex_nodes)), vertex_nodes.shape[1])
    reach = sparse.csr_array(((weights > 0.02).reshape(-1).astype(np.int32), (rows, vertex_nodes.reshape(-1))),
                             shape=(len(vertex_nodes), count))  # fmt: skip
    shared = (reach.T @ reach).tocoo()
    keep = (shared.row != shared.col) & (shared.data > 0)
    edges = np.column_stack([shared.row[keep], shared.col[keep]])
    return edges[np.lexsort((edges[:, 1], edges[:, 0]))].astype(np.int32)
