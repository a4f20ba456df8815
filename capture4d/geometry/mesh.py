"""Geometry of triangle meshes: normals, edges, open borders, neighbours, parts.

Letters used throughout: V vertices, F faces, E edges. Everything takes and returns plain arrays; `faces` are (F, 3)
integer vertex indices, counter-clockwise seen from outside.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int32, Integer
from scipy import sparse
from scipy.sparse import csgraph

from capture4d.types import Mesh

__all__ = [
    "boundary_edges",
    "boundary_loops",
    "connected_components",
    "face_areas",
    "face_normals",
    "normalised",
    "submesh",
    "unique_edges",
    "vertex_adjacency",
    "vertex_normals",
]


def _doubled_area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corner, along, across = (vertices[faces[:, k]] for k in range(3))
    return np.cross(along - corner, across - corner)


def normalised(vectors: np.ndarray) -> np.ndarray:
    """Vectors along the last axis at unit length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def face_normals(vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"]) -> Float[np.ndarray, "F 3"]:
    """Unit normals; zero for a face without area."""
    return normalised(_doubled_area_vectors(vertices, faces))


def face_areas(vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"]) -> Float[np.ndarray, " F"]:
    """Areas in the square of the vertices' unit."""
    return np.linalg.norm(_doubled_area_vectors(vertices, faces), axis=1) / 2


def vertex_normals(vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    """Unit normals, averaged over the faces around a vertex by area; zero where there is no face with area."""
    weighted = _doubled_area_vectors(vertices, faces)
    corners = faces.reshape(-1)
    total = np.empty_like(vertices)
    for axis in range(3):
        total[:, axis] = np.bincount(corners, np.repeat(weighted[:, axis], 3), minlength=len(vertices))
    return normalised(total)


def _half_edges(faces: np.ndarray) -> np.ndarray:
    """All directed edges (3F, 2), in the winding of their faces."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _edge_keys(edges: np.ndarray) -> np.ndarray:
    """One int64 per undirected edge; sorts like the pair (smaller, larger)."""
    return (edges.min(axis=1).astype(np.int64) << 32) | edges.max(axis=1)


def unique_edges(faces: Integer[np.ndarray, "F 3"]) -> Int32[np.ndarray, "E 2"]:
    """Undirected edges, each once, the smaller index first, in ascending order."""
    keys = np.unique(_edge_keys(_half_edges(faces)))
    return np.column_stack([keys >> 32, keys & 0xFFFFFFFF]).astype(np.int32)


def boundary_edges(faces: Integer[np.ndarray, "F 3"]) -> Int32[np.ndarray, "B 2"]:
    """Edges that belong to one face only, directed as that face winds."""
    edges = _half_edges(faces)
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
