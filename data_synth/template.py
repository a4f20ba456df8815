"""The registration template of a synthetic take, as a lab's artist would make it: a smooth, evenly meshed shirt of
about 5,000 vertices in the body's rest pose, bound to the body."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from capture4d.body import PosedBody, unskin
from capture4d.mesh import vertex_adjacency
from capture4d.open3d_loading import import_open3d
from capture4d.types import Garment, Mesh
from data_synth.patterns import PanelMesh, locate

__all__ = ["bind_template", "carry"]

WEIGHT_SMOOTHING = 12
"""Diffusion steps on the skin weights: nearest body points jump from trunk to arm under a sleeve."""


def carry(source: PanelMesh, target: PanelMesh, positions: np.ndarray) -> np.ndarray:
    """Positions (V, 3) of the target's vertices on a mesh of the same pattern."""
    faces, weights = locate(source, target.vertex_uv)
    return np.einsum("vk,vkc->vc", weights, positions[source.faces[faces]])


def bind(mesh: PanelMesh, dressed: np.ndarray, body: PosedBody) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nearest body point of each vertex, (V,) faces and (V, 3) barycentrics, and smooth skin weights (V, J).

    Args:
        dressed: (V, 3) vertices in a pose where the limbs are well apart.
    """
    scene = import_open3d().t.geometry.RaycastingScene(nthreads=1)
    body_faces = body.shaped.body.template.faces
    scene.add_triangles(body.vertices().astype(np.float32), body_faces.astype(np.uint32))
    closest = scene.compute_closest_points(dressed.astype(np.float32))
    faces, uv = closest["primitive_ids"].numpy().astype(np.int32), closest["primitive_uvs"].numpy()
    barycentric = np.column_stack([1 - uv.sum(axis=1), uv]).astype(np.float32)
    weights = np.einsum("vk,vkj->vj", barycentric, body.shaped.body.skin_weights[body_faces[faces]])
    return faces, barycentric, _diffuse(weights, mesh)


def bind_template(
    mesh: PanelMesh, dressed: np.ndarray, dressed_body: PosedBody, settled: np.ndarray, settled_body: PosedBody
) -> Garment:
    """Bind to the body where the limbs are well apart, and take the shape from where the cloth has settled.

    Args:
        dressed: (V, 3) vertices in the dressing pose, arms held out.
        settled: (V, 3) vertices in the pose the clip starts with.
    """
    faces, barycentric, weights = bind(mesh, dressed, dressed_body)
    rest, flagged = unskin(settled, weights, settled_body.transforms)
    assert not flagged.any(), "the clip's first pose cannot be unposed"
    return Garment(
        template=Mesh(rest.astype(np.float32), mesh.faces, mesh.uv.astype(np.float32)),
        loops={name: loop.astype(np.int32) for name, loop in mesh.loops.items()},
        embedding_faces=faces,
        embedding_barycentric=barycentric,
        skin_weights=weights.astype(np.float32),
    )


def _diffuse(weights: np.ndarray, mesh: PanelMesh) -> np.ndarray:
    adjacency = vertex_adjacency(mesh.faces, mesh.vertex_count)
    degree = np.diff(adjacency.indptr)
    mean = csr_array((np.repeat(1 / degree, degree), adjacency.indices, adjacency.indptr), shape=adjacency.shape)
    for _ in range(WEIGHT_SMOOTHING):
        weights = 0.5 * (weights + mean @ weights)
    return weights / weights.sum(axis=1, keepdims=True)
