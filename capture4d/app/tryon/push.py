"""A garment out of the body as fast as a slider moves: what `geometry.intersection_removal` does in twelve searches and
hundreds of sweeps, in up to four searches with a step each. It keeps no edge to its length; when the pose rests, the
exact removal takes over.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, Int32
from scipy.sparse import csr_array

from capture4d.body.limbs import WornBody
from capture4d.geometry.intersection_removal import NOISE_M, Contacts, Surroundings
from capture4d.geometry.mesh import vertex_adjacency

__all__ = ["LivePush", "laid_on_skin"]

SPREADS = (0.5, 0.25, 0.1, 0.0)
"""Share of the way to its neighbours' mean displacement that each vertex goes, step by step. Without it the cloth is
dented, and in a crease a vertex is sent from one side into the other; with the same share in every step it is drawn
back in (docs/notebook/tryon.md)."""
LEFT_M = 0.0008
"""No step more where nothing is deeper than this."""
LAID_M = 0.0003
"""How far over the skin a vertex is laid that no push has taken out."""
LAYINGS = 4
"""Searches for such vertices, at most."""


def laid_on_skin(
    points: Float64[np.ndarray, "verts 3"], body: Surroundings, deeper_m: float
) -> Float64[np.ndarray, "verts 3"]:
    """Vertices that are deeper than so much laid on the skin nearest to them, all others left as they are.

    Where an arm runs into the trunk there are creases narrower than cloth is pushed out: a vertex that leaves one side
    is inside the other. Both limbs carry it, so neither is told to be in its way.
    """
    best, least = points, np.full(len(points), np.inf)
    for _ in range(LAYINGS):
        found = body.contacts(points)
        better = found.depths < least
        best, least = np.where(better[:, None], points, best), np.minimum(found.depths, least)
        deep = least > deeper_m
        if not deep.any():
            break
        laid = found.feet + np.minimum(LAID_M, found.room / 2)[:, None] * found.normals
        points = np.where(deep[:, None], laid, best)
    return best


class LivePush:
    """A garment on one person.

    Args:
        worn: the garment on that person.
        margin_m: how far over the skin vertices are put.
    """

    def __init__(self, worn: WornBody, faces: Int32[np.ndarray, "faces 3"], count: int, margin_m: float) -> None:
        adjacency = vertex_adjacency(faces, count)
        degree = np.diff(adjacency.indptr)
        share = np.repeat(1.0 / np.maximum(degree, 1), degree)
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
        body, result = self._worn.posed(skin), start
        for step, spread in enumerate(SPREADS):
            found = body.contacts(result)
            if float(found.depths.max(initial=0.0)) <= (LEFT_M if step else NOISE_M):
                break
            displaced = self._held(result, found) - start
            displaced += spread * (self._mean @ displaced - displaced)
            result = self._held(start + displaced, found)
        else:
            result = laid_on_skin(result, body, LEFT_M)
        return result

    def _held(self, points: np.ndarray, found: Contacts) -> np.ndarray:
        """Over the limb that carries them, and not in another, as far as planes at their feet tell."""
        half = found.room / 2
        low = np.minimum(self._margin, half)
        height = np.einsum("vx,vx->v", points - found.feet, found.normals)
        points = points + np.maximum(low - height, 0.0)[:, None] * found.normals
        high = np.where(found.overlapping, np.inf, np.maximum(found.room - self._margin, half))
        away = np.einsum("vx,vx->v", points - found.feet, found.outwards)
        return points - np.maximum(away - high, 0.0)[:, None] * found.outwards
