"""Taking a surface out of a closed one: a garment out of the body it is on.

What is moved is chosen here: vertices behind the body's surface, and, where the body pokes through a face whose corners
are all outside, those corners. The rest follows by sparse least squares over the displacement d,

    min |L d|^2 + stay * sum_out |d|^2 + leave * sum_in |d - (target - x)|^2,

L being the uniform Laplacian. A few rounds search again, add what is inside by then, and double `leave`; what is left
at the end is moved straight to the outside.

References: the least squares of TailorNet's published code (CVPR 2020), with weights 1 and 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32
from scipy import sparse
from scipy.sparse.linalg import splu

from capture4d.geometry.mesh import vertex_adjacency, vertex_normals
from capture4d.geometry.ray_casting import TriangleScene, barycentric

__all__ = ["ClosedSurface", "IntersectionRemoval", "Penetration", "RemovalSettings", "Removed"]

EDGE_MIDDLES = np.array([[1, 1, 0], [0, 1, 1], [1, 0, 1], [2 / 3, 2 / 3, 2 / 3]]) / 2
"""Where a face is probed: the middles of its edges, and its own."""
THINNEST_M, SLACK_M = 0.03, 0.001
"""A limb of this radius bulges through a face by its longest edge squared over eight radii, and some slack. Deeper, the
face spans a crease, of an arm against the trunk, and pushing its corners out would blow it up."""
TOLERANCE, MOST_STEPS = 1e-6, 200
"""Relative residual at which conjugate gradients stop; the preconditioner leaves them a condition of `leave`/`stay`."""


@runtime_checkable
class RemovalSettings(Protocol):
    """What a stage's own settings have to say."""

    @property
    def enabled(self) -> bool:
        """Off, nothing moves, and what is inside is only measured."""
        ...

    @property
    def margin_mm(self) -> float:
        """How far outside vertices are put."""
        ...

    @property
    def stay(self) -> float: ...

    @property
    def leave(self) -> float: ...

    @property
    def rounds(self) -> int: ...

    @property
    def faces(self) -> bool:
        """Also where the closed surface pokes through a face whose corners are all outside."""
        ...


@dataclass(frozen=True, slots=True)
class Penetration:
    """How much of the garment is inside the body."""

    inside_percent: float
    """Vertices behind the surface."""
    depth_max_mm: float
    """Of the deepest; 0 if there are none."""

    @staticmethod
    def of(heights_m: Float[np.ndarray, " verts"]) -> Penetration:
        depths = -1e3 * heights_m[heights_m < 0]
        return Penetration(100.0 * len(depths) / max(len(heights_m), 1), float(depths.max(initial=0.0)))


class ClosedSurface:
    """A posed body, say, to measure heights over. Normals are interpolated, so that they do not jump at edges."""

    def __init__(self, vertices: Float[np.ndarray, "skin 3"], faces: Int32[np.ndarray, "faces 3"]) -> None:
        self._scene = TriangleScene((vertices, faces))
        self._faces, self._normals = faces, vertex_normals(vertices.astype(np.float64), faces)

    def heights(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float64[np.ndarray, " points"], Float64[np.ndarray, "points 3"]]:
        """Height over the nearest point of the surface, metres, negative inside; and the normal there."""
        nearest = self._scene.nearest(points)
        corners = self._normals[self._faces[nearest.faces]]
        normals = np.einsum("pk,pkx->px", barycentric(nearest.uv.astype(np.float64)), corners)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        apart = points - nearest.points.astype(np.float64)
        return np.linalg.norm(apart, axis=1) * np.sign(np.einsum("px,px->p", apart, normals)), normals


@dataclass(frozen=True, slots=True, eq=False)
class Removed:
    """A garment outside the body."""

    vertices: Float64[np.ndarray, "verts 3"]
    before: Penetration
    after: Penetration
    moved_m: Float64[np.ndarray, " verts"]
    was_inside: Bool[np.ndarray, " verts"]

    @property
    def rest_moved_mm(self) -> float:
        """Mean displacement of the vertices that were outside."""
        kept = self.moved_m[~self.was_inside]
        return 1e3 * float(kept.mean()) if len(kept) else 0.0


class IntersectionRemoval:
    """The least squares of one topology, factorised once; one call a frame."""

    def __init__(self, faces: Int32[np.ndarray, "faces 3"], count: int, config: RemovalSettings) -> None:
        self._faces, self._config = faces, config
        adjacency = vertex_adjacency(faces, count).astype(np.float64)
        degree = np.asarray(adjacency.sum(axis=1)).ravel()
        connected = (degree > 0).astype(np.float64)
        laplacian = sparse.diags_array(connected) - sparse.diags_array(1.0 / np.maximum(degree, 1.0)) @ adjacency
        self._stiffness = (laplacian.T @ laplacian).tocsr()
        self._factor = splu((self._stiffness + config.stay * sparse.eye_array(count)).tocsc())

    def __call__(self, vertices: Float[np.ndarray, "verts 3"], body: ClosedSurface) -> Removed:
        """Move a garment, metres, out of a body."""
        config, margin = self._config, 1e-3 * self._config.margin_mm
        start = vertices.astype(np.float64)
        heights, normals = body.heights(start)
        before, was_inside = Penetration.of(heights), heights < 0
        wanted, leaving = np.zeros_like(start), np.zeros(len(start), bool)
        edges = start[np.roll(self._faces, -1, axis=1)] - start[self._faces]
        bulge = SLACK_M + np.linalg.norm(edges, axis=2).max(axis=1) ** 2 / (8 * THINNEST_M)
        moved, leave = np.zeros_like(start), config.leave
        for _ in range(config.rounds if config.enabled else 0):
            push = np.where((heights < 0)[:, None], (margin - heights)[:, None] * normals, 0.0)
            if config.faces:
                push = self._push_faces(start + moved, heights, push, body, margin, bulge)
            pushed = np.any(push != 0, axis=1)
            if not pushed.any():
                break
            wanted[pushed] = moved[pushed] + push[pushed]
            leaving |= pushed
            moved = self._solve(wanted, leaving, leave)
            heights, normals = body.heights(start + moved)
            leave *= 2
        if config.enabled:
            left = heights < 0
            moved[left] += (margin - heights[left])[:, None] * normals[left]
        result = start + moved
        after = Penetration.of(body.heights(result)[0])
        return Removed(result, before, after, np.linalg.norm(moved, axis=1), was_inside)

    def _push_faces(
        self,
        points: np.ndarray,
        heights: np.ndarray,
        push: np.ndarray,
        body: ClosedSurface,
        margin: float,
        bulge: np.ndarray,
    ) -> np.ndarray:
        """The same for the corners of faces that the body pokes through, by less than `bulge` (F,); (V, 3), the longest
        push of each."""
        chosen = (heights[self._faces] >= 0).all(axis=1) & (heights[self._faces].min(axis=1) < 0.02)
        near, bulge = self._faces[chosen], bulge[chosen]
        if not len(near):
            return push
        probes = np.einsum("pk,fkx->fpx", EDGE_MIDDLES, points[near]).reshape(-1, 3)
        below, normals = (each.reshape(len(near), len(EDGE_MIDDLES), -1) for each in body.heights(probes))
        deepest = np.argmin(below[..., 0], axis=1)
        rows = np.arange(len(near))
        depth, normal = below[rows, deepest, 0], normals[rows, deepest]
        result = push.copy()
        for corner in range(3):
            for row in np.flatnonzero((depth < 0) & (depth > -bulge)):
                vertex = near[row, corner]
                if np.linalg.norm(result[vertex]) < margin - depth[row]:
                    result[vertex] = (margin - depth[row]) * normal[row]
        return result

    def _solve(self, wanted: np.ndarray, leaving: np.ndarray, leave: float) -> np.ndarray:
        """Displacements, (V, 3), by conjugate gradients; the factor without `leaving` is nearly the inverse."""
        diagonal = np.where(leaving, leave, self._config.stay)
        matrix = (self._stiffness + sparse.diags_array(diagonal)).tocsr()
        right = np.where(leaving[:, None], leave * wanted, 0.0)
        return _conjugate_gradients(matrix, right, self._factor.solve)


def _conjugate_gradients(
    matrix: sparse.csr_array, right: Float64[np.ndarray, "verts 3"], precondition: Callable[[np.ndarray], np.ndarray]
) -> Float64[np.ndarray, "verts 3"]:
    """Solve for each column of a positive definite system, all columns at once."""
    found, residual = np.zeros_like(right), right.copy()
    enough = TOLERANCE * np.linalg.norm(right, axis=0)
    direction = better = precondition(residual)
    product = (residual * better).sum(axis=0)
    for _ in range(MOST_STEPS):
        if np.all(np.linalg.norm(residual, axis=0) <= enough):
            break
        image = matrix @ direction
        step = product / np.maximum((direction * image).sum(axis=0), 1e-300)
        found, residual = found + step * direction, residual - step * image
        better = precondition(residual)
        before, product = product, (residual * better).sum(axis=0)
        direction = better + product / np.maximum(before, 1e-300) * direction
    return found
