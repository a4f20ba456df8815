"""A garment out of the body as fast as a slider moves: what `geometry.intersection_removal` does in twelve searches and
hundreds of sweeps, in one or two searches and two steps. It keeps no edge to its length; when the pose rests, the exact
removal takes over.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, Int32
from scipy.sparse import csr_array

from capture4d.body.limbs import WornBody
from capture4d.geometry.intersection_removal import Contacts
from capture4d.geometry.mesh import vertex_adjacency

__all__ = ["LivePush"]

SPREAD = 0.5
"""Share of the way to its neighbours' mean displacement that each vertex goes: without it the cloth is dented."""
DEEP_M = 0.004
"""What was deeper than this is looked at again: the nearest skin is another one from outside."""


class LivePush:
    """A garment on one person.

    Args:
        worn: the garment on that person.
        margin_m: how far over the skin vertices are put.
    """

    def __init__(self, worn: WornBody, faces: Int32[np.ndarray, "faces 3"], count: int, margin_m: float) -> None:
        adjacency = vertex_adjacency(faces, count)
        degree = np.maximum(np.diff(adjacency.indptr), 1)
        share = np.repeat(1.0 / degree, np.diff(adjacency.indptr))
        self._mean = csr_array((share, adjacency.indices, adjacency.indptr), shape=adjacency.shape)
        self._worn, self._margin = worn, margin_m

    def __call__(
        self, vertices: Float[np.ndarray, "verts 3"], skin: Float[np.ndarray, "skin 3"]
    ) -> Float64[np.ndarray, "verts 3"]:
        """Where the vertices are put, metres.

        Args:
            skin: the posed body's vertices.
        """
        start = np.ascontiguousarray(vertices, np.float64)
        body = self._worn.posed(skin)
        found = body.contacts(start)
        result = self._moved(start, start, found)
        if float(found.depths.max(initial=0.0)) > DEEP_M:
            result = self._moved(result, start, body.contacts(result))
        return result

    def _moved(self, points: np.ndarray, start: np.ndarray, found: Contacts) -> np.ndarray:
        """Between their bounds, their displacements evened out, and between their bounds again."""
        held = self._held(points, found)
        displaced = held - start
        displaced += SPREAD * (self._mean @ displaced - displaced)
        return self._held(start + displaced, found)

    def _held(self, points: np.ndarray, found: Contacts) -> np.ndarray:
        """Over the limb that carries them, and not in another, as far as planes at their feet tell."""
        half = found.room / 2
        low = np.minimum(self._margin, half)
        height = np.einsum("vx,vx->v", points - found.feet, found.normals)
        points = points + np.maximum(low - height, 0.0)[:, None] * found.normals
        high = np.where(found.overlapping, np.inf, np.maximum(found.room - self._margin, half))
        away = np.einsum("vx,vx->v", points - found.feet, found.outwards)
        return points - np.maximum(away - high, 0.0)[:, None] * found.outwards
