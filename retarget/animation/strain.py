"""Cloth stretches little: edges that skinning or a regression made too long are drawn together again.

Local and global steps in turn, of the least squares

    min sum_e |x_i - x_j - d_e|^2 + stay * |x - x_0|^2,

x_0 being the garment as it was. Locally, d_e is an edge as it is, no longer than it may be; globally, x follows from
one system that is factorised once.

References: Bouaziz et al., Projective Dynamics: Fusing Constraint Projections for Fast Simulation (SIGGRAPH 2014).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, Int32
from scipy import sparse
from scipy.sparse.linalg import splu

__all__ = ["StrainLimit"]

STAY = 1e-3
"""Weight of staying in place, beside 1 for each edge: the garment as a whole stays where it was skinned to."""
MOST_STEPS = 60
SLACK = 0.005
"""Of an edge's greatest length: what is left over."""


class StrainLimit:
    """The system of one topology, factorised once; one call a frame.

    Args:
        edges: (E, 2) of the garment.
        rest_m: their lengths on the person who wears it, metres.
        most: times that length, the longest an edge may be.
    """

    def __init__(
        self, edges: Int32[np.ndarray, "edges 2"], rest_m: Float64[np.ndarray, " edges"], count: int, most: float
    ) -> None:
        rows = np.repeat(np.arange(len(edges)), 2)
        signs = np.tile([1.0, -1.0], len(edges))
        self._across = sparse.csr_matrix((signs, (rows, edges.reshape(-1))), shape=(len(edges), count))
        system = self._across.T @ self._across + STAY * sparse.identity(count)
        self._solve = splu(system.tocsc())
        self._edges, self._longest = edges, most * np.maximum(rest_m, 1e-9)

    def __call__(self, vertices: Float[np.ndarray, "verts 3"]) -> Float64[np.ndarray, "verts 3"]:
        """The garment with no edge longer than allowed, or nearly so; as it is if none was."""
        start = vertices.astype(np.float64)
        found = start
        for _ in range(MOST_STEPS):
            along = found[self._edges[:, 0]] - found[self._edges[:, 1]]
            lengths = np.linalg.norm(along, axis=1)
            over = lengths > self._longest
            if not (lengths > (1 + SLACK) * self._longest).any():
                break
            shorter = np.where(over, self._longest / np.maximum(lengths, 1e-12), 1.0)
            found = self._solve.solve(self._across.T @ (shorter[:, None] * along) + STAY * start)
        return found
