"""Tangent frames of a mesh, after MikkTSpace: what a tangent-space normal map is relative to.

Tangents lie along increasing u. They are averaged over the corners that share vertex, UV and winding, each projected
onto the plane of the vertex normal and weighted by its angle. A renderer interpolates normal and tangent over the
face; here the tangent is then made orthogonal to the normal again, so that every frame is a rotation or a
reflection: bitangent = w * cross(normal, tangent), glTF's rule, with w = -1 on mirrored islands.

References: Mikkelsen, Simulation of wrinkled surfaces revisited, 2008; glTF 2.0, section 3.7.2.1.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32

from capture4d.geometry.mesh import connected_components, normalised, vertex_normals

__all__ = ["TangentLayout", "corner_tangents", "frames_at", "interpolated_frames", "uv_corners"]


def uv_corners(faces: Int32[np.ndarray, "F 3"], uv: Float[np.ndarray, "F 3 2"]) -> Int32[np.ndarray, "F 3"]:
    """Corners numbered so that those that share both vertex and UV are one: the mesh cut open along its seams."""
    keys = np.column_stack([faces.reshape(-1).astype(np.float64), uv.reshape(-1, 2)])
    _, corner = np.unique(keys, axis=0, return_inverse=True)
    return corner.reshape(-1, 3).astype(np.int32)


class TangentLayout:
    """What the tangents of a mesh owe to its faces and UVs alone: analysed once, used for every frame."""

    def __init__(self, faces: Int32[np.ndarray, "F 3"], uv: Float[np.ndarray, "F 3 2"]) -> None:
        along, across = (uv[:, k].astype(np.float64) - uv[:, 0] for k in (1, 2))
        determinant = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
        self.faces = faces
        self.sign = np.where(determinant < 0, -1.0, 1.0)
        safe = np.where(np.abs(determinant) < 1e-16, 1.0, determinant)
        # dP/du = (across_v * edge1 - along_v * edge2) / determinant
        self._of_edges = np.stack([across[:, 1], -along[:, 1]], axis=1) / safe[:, None]
        self._of_edges[np.abs(determinant) < 1e-16] = 0.0
        cut = uv_corners(faces, uv).astype(np.int64) * 2 + (self.sign < 0)[:, None]
        _, group = np.unique(cut, return_inverse=True)
        self._group = group.reshape(-1, 3)
        self._groups = int(group.max(initial=-1)) + 1

    def islands(self) -> Int32[np.ndarray, " F"]:
        """The UV island of each face."""
        return connected_components(self._group.astype(np.int32), self._groups)[self._group[:, 0]]

    def tangents(
        self,
        vertices: Float[np.ndarray, "V 3"],
        normals: Float[np.ndarray, "V 3"],
        *,
        fallback: Float[np.ndarray, "V 3"] | None = None,
    ) -> Float64[np.ndarray, "F 3 3"]:
        """Unit tangents of the face corners, orthogonal to the vertex normals.

        Args:
            fallback: directions across the normals where the faces around a vertex have no area; any if None.
        """
        corners = vertices.astype(np.float64)[self.faces]
        edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1)
        flat = np.einsum("fe,fec->fc", self._of_edges, edges)
        normal = normals[self.faces].astype(np.float64)
        projected = normalised(flat[:, None] - np.einsum("fc,fkc->fk", flat, normal)[..., None] * normal)
        onward = normalised(np.roll(corners, -1, axis=1) - corners)
        back = normalised(np.roll(corners, 1, axis=1) - corners)
        angle = np.arccos(np.clip(np.einsum("fkc,fkc->fk", onward, back), -1, 1))
        total = np.stack(
            [
                np.bincount(self._group.ravel(), (angle * projected[..., axis]).ravel(), minlength=self._groups)
                for axis in range(3)
            ],
            axis=1,
        )
        mean = total[self._group]
        mean -= np.einsum("fkc,fkc->fk", mean, normal)[..., None] * normal
        lost = np.linalg.norm(mean, axis=-1, keepdims=True) < 1e-9
        instead = _some_orthogonal(normal) if fallback is None else fallback[self.faces]
        return normalised(np.where(lost, instead, mean))


def corner_tangents(
    vertices: Float[np.ndarray, "V 3"], faces: Int32[np.ndarray, "F 3"], uv: Float[np.ndarray, "F 3 2"]
) -> Float32[np.ndarray, "F 3 4"]:
    """Tangent (x, y, z) and handedness w of every face corner, as glTF's TANGENT."""
    layout = TangentLayout(faces, uv)
    tangent = layout.tangents(vertices, vertex_normals(np.asarray(vertices, np.float64), faces))
    sign = np.broadcast_to(layout.sign[:, None, None], (*faces.shape, 1))
    return np.concatenate([tangent, sign], axis=-1).astype(np.float32)


def frames_at(
    layout: TangentLayout,
    faces: Int32[np.ndarray, " N"],
    barycentric: Float[np.ndarray, "N 3"],
    *,
    normals: Float[np.ndarray, "V 3"],
    tangents: Float[np.ndarray, "F 3 3"],
) -> Float64[np.ndarray, "N 3 3"]:
    """Orthonormal rows tangent, bitangent, normal at points of the surface.

    Args:
        normals: of the vertices.
        tangents: of the face corners, as `layout` has them.
    """
    return interpolated_frames(
        np.einsum("nk,nkc->nc", barycentric, normals[layout.faces[faces]]),
        np.einsum("nk,nkc->nc", barycentric, tangents[faces]),
        layout.sign[faces],
    )


def interpolated_frames(
    normals: Float[np.ndarray, "N 3"], tangents: Float[np.ndarray, "N 3"], signs: Float[np.ndarray, " N"]
) -> Float64[np.ndarray, "N 3 3"]:
    """Frames from interpolated normals and tangents: rows tangent, bitangent, normal."""
    normal = normalised(np.asarray(normals, np.float64))
    tangent = tangents - np.einsum("nc,nc->n", tangents, normal)[:, None] * normal
    lost = np.linalg.norm(tangent, axis=-1, keepdims=True) < 1e-9
    tangent = normalised(np.where(lost, _some_orthogonal(normal), tangent))
    return np.stack([tangent, signs[:, None] * np.cross(normal, tangent), normal], axis=1)


def _some_orthogonal(normals: np.ndarray) -> np.ndarray:
    """A vector across each normal, where UVs give no direction."""
    axis = np.where(np.abs(normals[..., :1]) < 0.9, np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    return axis - np.sum(axis * normals, axis=-1, keepdims=True) * normals
