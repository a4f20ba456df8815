"""A garment mesh bound to a body: the surface point under each vertex, and the skin weights that move it.

Nearest body points jump where a sleeve hangs beside the trunk, so weights are diffused over the garment. A template
that was made on one person is moved to another by how the body points under it move: the cloth keeps its distance.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from capture4d.body.skinning import PosedBody, with_shape
from capture4d.errors import InputError
from capture4d.geometry.mesh import vertex_adjacency
from capture4d.geometry.ray_casting import TriangleScene, barycentric
from capture4d.types import Body, Garment

__all__ = [
    "WEIGHT_SMOOTHING",
    "bind",
    "diffuse",
    "embedded_offset",
    "loose_weights",
    "weights_around",
    "with_body_shape",
]

WEIGHT_SMOOTHING = 12
"""Diffusion steps on the skin weights: nearest body points jump from trunk to arm under a sleeve."""
LOOSE_NEIGHBOURS = 100
"""Body vertices that a vertex of loose cloth follows (TailorNet, section 4.1)."""
OFFSET_SMOOTHING = 12
"""The same on the way to another shape, for the same reason."""


def bind(
    vertices: Float[np.ndarray, "verts 3"],
    faces: Int32[np.ndarray, "faces 3"],
    body: PosedBody,
    *,
    smoothing: int = WEIGHT_SMOOTHING,
) -> tuple[Int32[np.ndarray, " verts"], Float32[np.ndarray, "verts 3"], Float[np.ndarray, "verts joints"]]:
    """The nearest body point of each vertex, as face and barycentric coordinates, and smooth skin weights.

    Args:
        vertices: on the body, best in a pose where the limbs are well apart.
        smoothing: diffusion steps on the weights; 0 moves each vertex exactly as the skin beneath it.
    """
    body_faces = body.shaped.body.template.faces
    nearest = TriangleScene((body.vertices(), body_faces)).nearest(vertices)
    within = barycentric(nearest.uv)
    weights = np.einsum("vk,vkj->vj", within, body.shaped.body.skin_weights[body_faces[nearest.faces]])
    weights = diffuse(weights, faces, smoothing)
    return nearest.faces, within, weights / weights.sum(axis=1, keepdims=True)


def loose_weights(
    points: Float[np.ndarray, "verts 3"],
    body: PosedBody,
    *,
    near: Bool[np.ndarray, " skin"] | None = None,
    follow: Literal["distance", "root"] = "distance",
) -> Float[np.ndarray, "verts joints"]:
    """Skin weights of cloth that hangs free of the limbs, such as a skirt, whose nearest body point jumps between them.

    Args:
        points: the cloth on the body, metres.
        near: the body's vertices that it may follow; all if None.
        follow: the mean of the skin around, weighted by inverse distance, or the root joint alone.
    References: Patel et al., TailorNet (CVPR 2020), section 4.1.
    """
    skin_weights = body.shaped.body.skin_weights
    if follow == "root":
        weights = np.zeros((len(points), skin_weights.shape[1]))
        weights[:, 0] = 1.0
        return weights
    chosen = np.arange(len(skin_weights)) if near is None else np.flatnonzero(near)
    weights = weights_around(points, body.vertices()[chosen], skin_weights[chosen])
    return weights / weights.sum(axis=1, keepdims=True)


def weights_around(
    points: Float[np.ndarray, "verts 3"],
    skin: Float[np.ndarray, "skin 3"],
    skin_weights: Float[np.ndarray, "skin joints"],
) -> Float[np.ndarray, "verts joints"]:
    """Sums of the skin weights around points, by inverse distance; not yet divided by their own sums."""
    distance, nearest = map(np.asarray, KDTree(skin).query(points, k=min(LOOSE_NEIGHBOURS, len(skin))))
    return np.einsum("vk,vkj->vj", 1 / np.maximum(distance, 1e-4), skin_weights[nearest])


def diffuse(
    values: Float[np.ndarray, "verts channels"], faces: Int32[np.ndarray, "faces 3"], steps: int
) -> Float[np.ndarray, "verts channels"]:
    """Half way to the mean of the neighbours, so many times; vertices without neighbours stay."""
    adjacency = vertex_adjacency(faces, len(values))
    degree = np.diff(adjacency.indptr)
    mean = csr_array(
        (np.repeat(1 / np.maximum(degree, 1), degree), adjacency.indices, adjacency.indptr), shape=adjacency.shape
    )
    alone = (degree == 0)[:, None]
    for _ in range(steps):
        values = np.where(alone, values, 0.5 * (values + mean @ values))
    return values


def with_body_shape(garment: Garment, body: Body, shape: Float[np.ndarray, " shapes"]) -> Garment:
    """The garment moved, in the rest pose, from the person it was bound to onto another shape of the same body.

    A garment that does not say whom it was bound to, or to which points, is returned as it is.

    Raises:
        InputError: the garment is bound to faces that the body does not have.
    """
    if garment.body_shape is None or garment.embedding_faces is None or garment.embedding_barycentric is None:
        return garment
    change = with_shape(body, shape).vertices - with_shape(body, garment.body_shape).vertices
    moved = garment.template.vertices + embedded_offset(garment, body, change)
    template = garment.template.with_vertices(moved.astype(np.float32))
    return replace(garment, template=template, body_shape=np.asarray(shape, np.float32))


def embedded_offset(garment: Garment, body: Body, change: Float[np.ndarray, "skin 3"]) -> Float[np.ndarray, "verts 3"]:
    """How the garment moves, in the rest pose, when the body's surface changes: with the points it is bound to.

    Args:
        change: displacement of each body vertex, metres.
    Raises:
        InputError: the garment is not bound, or to faces that the body does not have.
    """
    if garment.embedding_faces is None or garment.embedding_barycentric is None:
        raise InputError("template: expected an embedding in the body, found none; bind it to a body")
    if garment.embedding_faces.max(initial=0) >= len(body.template.faces):
        count = len(body.template.faces)
        raise InputError(f"template: expected an embedding in the body's {count} faces, found face "
                         f"{garment.embedding_faces.max()}")  # fmt: skip
    corners = change[body.template.faces[garment.embedding_faces]]
    offset = np.einsum("vk,vkc->vc", garment.embedding_barycentric, corners)
    return diffuse(offset, garment.template.faces, OFFSET_SMOOTHING)
