"""Splitting a garment into what is smooth and the rest: Laplacian smoothing of unposed vertices.

Letters: V vertices, F faces, N garments (frames), mu an eigenvalue of the random-walk Laplacian.

One step is g_i <- g_i + rate * (Lap g)_i, Lap the umbrella operator: the mean of the neighbours less the vertex. A wave
of eigenvalue mu is left with (1 - rate mu)^steps. A vertex on a border is moved by its two neighbours along the border
alone, so that borders do not shrink inwards. The paper's 80 steps of 0.15 belong to the edges of its meshes, on which a
step's reach depends: here the wavelength of which half is left is what is held, in metres.

References: TailorNet (CVPR 2020), section 4.4, equations 6 and 7; that the operator is uniform, and what borders do, is
in the released code alone. Desbrun et al., Implicit Fairing (SIGGRAPH 1999), for the umbrella operator.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Integer
from scipy.sparse import csr_array

from capture4d.geometry.mesh import boundary_edges, edge_lengths, unique_edges
from retarget.mixture.config import SplitConfig

__all__ = ["Diffusion", "umbrella"]

PRINTED_RATE, PRINTED_STEPS = 0.15, 80
"""Section 4.4."""
AT_ONCE = 64
"""Garments that are smoothed together."""


def umbrella(faces: Integer[np.ndarray, "F 3"], count: int) -> csr_array:
    """The umbrella operator, (count, count): rows sum to 0; on a border along the border alone.

    A vertex without faces has a row of zeros.
    """
    edges, border = unique_edges(faces), boundary_edges(faces)
    on_border = np.zeros(count, bool)
    on_border[border] = True
    both = np.concatenate([edges, edges[:, ::-1]])
    inside = both[~on_border[both[:, 0]]]
    rows, columns = np.concatenate([inside, border, border[:, ::-1]]).T
    adjacency = csr_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    adjacency.data[:] = 1.0  # an edge that is twice in a border counts once
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    mean = csr_array((1 / np.maximum(degree, 1), (np.arange(count), np.arange(count))), shape=(count, count))
    identity = csr_array(((degree > 0).astype(float), (np.arange(count), np.arange(count))), shape=(count, count))
    return csr_array(mean @ adjacency - identity)


@dataclass(frozen=True, slots=True, eq=False)
class Diffusion:
    """Steps of Laplacian smoothing on one mesh."""

    laplacian: csr_array
    rate: float
    steps: int

    @staticmethod
    def create(faces: Integer[np.ndarray, "F 3"], rest: Float[np.ndarray, "V 3"], config: SplitConfig) -> Diffusion:
        """The smoothing of a mesh.

        On a surface a wave of length w has mu = (pi e / w)^2 for edges of length e, as long as w is much longer; the
        steps are as many as leave half of the wave of length `config.half_m`.

        Args:
            rest: where its vertices are at rest, metres: for the length of its edges.
        """
        laplacian = umbrella(faces, len(rest))
        if config.printed:
            return Diffusion(laplacian, PRINTED_RATE, PRINTED_STEPS)
        edge = float(np.sqrt((edge_lengths(rest.astype(np.float64), unique_edges(faces)) ** 2).mean()))
        wanted = float(np.log(2) / (np.pi * edge / config.half_m) ** 2)  # rate * steps
        steps = max(1, int(np.ceil(wanted / PRINTED_RATE)))
        return Diffusion(laplacian, min(wanted / steps, PRINTED_RATE), steps)

    def smooth(self, vertices: Float[np.ndarray, "N V 3"]) -> Float[np.ndarray, "N V 3"]:
        """The smooth part; the rest is what is left of `vertices` without it. Keeps the floating type."""
        result = np.empty_like(vertices)
        for first in range(0, len(vertices), AT_ONCE):
            part = vertices[first : first + AT_ONCE]
            values = np.moveaxis(part, 1, 0).reshape(part.shape[1], -1).astype(np.float64)
            for _ in range(self.steps):
                values = values + self.rate * (self.laplacian @ values)
            result[first : first + AT_ONCE] = np.moveaxis(values.reshape(part.shape[1], len(part), 3), 0, 1)
        return result
