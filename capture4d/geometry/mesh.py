"""Geometry of triangle meshes: normals, edges, open borders, neighbours, parts.

Letters used throughout: V vertices, F faces, E edges. Everything takes and returns plain arrays; `faces` are (F, 3)
integer vertex indices, counter-clockwise seen from outside.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, Int64, Integer
from scipy import sparse
from scipy.sparse import csgraph

from capture4d.types import Mesh

__all__ = [
    "angle_weighted_normals",
    "boundary_edges",
    "boundary_loops",
    "connected_components",
    "doubled_area_vectors",
    "edge_lengths",
    "edge_stretch",
    "edge_uses",
    "edges_of_faces",
    "face_areas",
    "flat_edge_lengths",
    "half_edges",
    "normalised",
    "stretch_p99",
    "submesh",
    "unique_edges",
    "vertex_adjacency",
    "vertex_normals",
]


def doubled_area_vectors(
    vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"]
) -> Float[np.ndarray, "F 3"]:
    """Normals of the faces, each as long as twice its area."""
    corner, along, across = (vertices[faces[:, k]] for k in range(3))
    return np.cross(along - corner, across - corner)


def normalised(vectors: np.ndarray) -> np.ndarray:
    """Vectors along the last axis at unit length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def face_areas(vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"]) -> Float[np.ndarray, " F"]:
    """Areas in the square of the vertices' unit."""
    return np.linalg.norm(doubled_area_vectors(vertices, faces), axis=1) / 2


def vertex_normals(vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    """Unit normals, averaged over the faces around a vertex by area; zero where there is no face with area."""
    weighted = doubled_area_vectors(vertices, faces)
    corners = faces.reshape(-1)
    total = np.empty_like(vertices)
    for axis in range(3):
        total[:, axis] = np.bincount(corners, np.repeat(weighted[:, axis], 3), minlength=len(vertices))
    return normalised(total)


def angle_weighted_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V 3"]:
    """Unit normals, averaged over the faces around a vertex by their angles there, as Blender does; zero where there is
    no face with area."""
    corners = vertices[faces]
    flat = normalised(doubled_area_vectors(vertices, faces))
    total = np.zeros_like(vertices)
    for corner in range(3):
        along, across = (corners[:, (corner + step) % 3] - corners[:, corner] for step in (1, 2))
        angle = np.arctan2(np.linalg.norm(np.cross(along, across), axis=1), np.einsum("fx,fx->f", along, across))
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, corner], angle * flat[:, axis], minlength=len(vertices))
    return normalised(total)


def half_edges(faces: Integer[np.ndarray, "F 3"]) -> Integer[np.ndarray, "sides 2"]:
    """All directed edges (3F, 2), in the winding of their faces: face 0's three, then face 1's."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _edge_keys(edges: np.ndarray) -> np.ndarray:
    """One int64 per undirected edge; sorts like the pair (smaller, larger)."""
    return (edges.min(axis=1).astype(np.int64) << 32) | edges.max(axis=1)


def unique_edges(faces: Integer[np.ndarray, "F 3"]) -> Int32[np.ndarray, "E 2"]:
    """Undirected edges, each once, the smaller index first, in ascending order."""
    keys = np.unique(_edge_keys(half_edges(faces)))
    return _edges_of_keys(keys)


def _edges_of_keys(keys: np.ndarray) -> np.ndarray:
    return np.column_stack([keys >> 32, keys & 0xFFFFFFFF]).astype(np.int32)


def edge_uses(faces: Integer[np.ndarray, "F 3"]) -> tuple[Int32[np.ndarray, "E 2"], Int64[np.ndarray, " E"]]:
    """Undirected edges, as `unique_edges` has them, and how many faces each belongs to."""
    keys, uses = np.unique(_edge_keys(half_edges(faces)), return_counts=True)
    return _edges_of_keys(keys), uses


def edge_lengths(vertices: Float[np.ndarray, "V 3"], edges: Integer[np.ndarray, "E 2"]) -> Float[np.ndarray, " E"]:
    """In the vertices' unit."""
    return np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)


def edge_stretch(
    vertices: Float[np.ndarray, "V 3"], edges: Integer[np.ndarray, "E 2"], template_lengths: Float[np.ndarray, " E"]
) -> Float64[np.ndarray, " E"]:
    """How long each edge is, over its length in the template.

    Args:
        template_lengths: those of the template graded to the person who wears it.
    """
    return edge_lengths(vertices.astype(np.float64), edges) / np.maximum(template_lengths, 1e-12)


def stretch_p99(stretch: Float[np.ndarray, " E"]) -> float:
    """A frame's stretch, wherever one is told: the 99th percentile over its edges of `edge_stretch`; NaN without
    edges."""
    return float(np.percentile(stretch, 99)) if len(stretch) else float("nan")


def edges_of_faces(faces: Integer[np.ndarray, "F 3"], edges: Integer[np.ndarray, "E 2"]) -> Int64[np.ndarray, "F 3"]:
    """Which of the edges the side behind each corner is.

    Args:
        edges: of these faces, as `unique_edges` returns them.
    """
    return np.searchsorted(_edge_keys(edges), _edge_keys(half_edges(faces))).reshape(-1, 3)


def flat_edge_lengths(
    flat: Float[np.ndarray, "F 3 2"], faces: Integer[np.ndarray, "F 3"], edges: Integer[np.ndarray, "E 2"]
) -> Float64[np.ndarray, " E"]:
    """Lengths on a pattern, in its unit; the mean of both sides where two panels are sewn together.

    Args:
        flat: the faces' corners on it.
        edges: of these faces, as `unique_edges` returns them.
    """
    corners = flat.astype(np.float64)
    lengths = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).reshape(-1)
    edge_of = edges_of_faces(faces, edges).reshape(-1)
    return np.bincount(edge_of, lengths) / np.bincount(edge_of)


def boundary_edges(faces: Integer[np.ndarray, "F 3"]) -> Int32[np.ndarray, "B 2"]:
    """Edges that belong to one face only, directed as that face winds."""
    edges = half_edges(faces)
    _, first, uses = np.unique(_edge_keys(edges), return_index=True, return_counts=True)
    return edges[first[uses == 1]].astype(np.int32)


def boundary_loops(faces: Integer[np.ndarray, "F 3"]) -> list[Int32[np.ndarray, " loop"]]:
    """Closed curves of boundary edges, as vertex indices in walking order, the first not repeated at the end.

    The longest loop (in vertices) comes first. Where two loops touch in a vertex they are returned apart; a chain that
    does not close, which only faces of inconsistent winding produce, is left out.
    """
    onward: dict[int, list[int]] = {}
    for start, end in boundary_edges(faces).tolist():
        onward.setdefault(start, []).append(end)

    loops: list[list[int]] = []
    for start, ends in onward.items():
        while ends:
            path, place = [start], {start: 0}
            while choices := onward.get(path[-1]):
                vertex = choices.pop()
                if vertex in place:
                    cut = place[vertex]
                    loops.append(path[cut:])
                    for passed in path[cut + 1 :]:
                        del place[passed]
                    del path[cut + 1 :]
                else:
                    place[vertex] = len(path)
                    path.append(vertex)
    return [np.array(loop, np.int32) for loop in sorted(loops, key=lambda loop: (-len(loop), loop))]


def vertex_adjacency(faces: Integer[np.ndarray, "F 3"], count: int) -> sparse.csr_array:
    """Symmetric (count, count) matrix with a one for every edge, and no diagonal."""
    edges = unique_edges(faces)
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    return sparse.csr_array((np.ones(len(rows), np.float32), (rows, columns)), shape=(count, count))


def connected_components(faces: Integer[np.ndarray, "F 3"], count: int) -> Int32[np.ndarray, " count"]:
    """Number of the part each vertex belongs to, from 0; a vertex without faces is a part of its own."""
    _, labels = csgraph.connected_components(vertex_adjacency(faces, count), directed=False)
    return labels.astype(np.int32)


def submesh(mesh: Mesh, face_mask: Bool[np.ndarray, " F"]) -> tuple[Mesh, Int32[np.ndarray, " kept"]]:
    """The faces where `face_mask` holds, on the vertices they use, and those vertices' indices in `mesh`.

    Faces and vertices keep their order.
    """
    faces = mesh.faces[face_mask]
    kept, renumbered = np.unique(faces, return_inverse=True)
    uv = None if mesh.uv is None else mesh.uv[face_mask]
    return Mesh(mesh.vertices[kept], renumbered.reshape(-1, 3).astype(np.int32), uv), kept.astype(np.int32)
