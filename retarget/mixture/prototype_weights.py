"""How much each prototype says to a garment: by how alike the two are in the A-pose.

Letters: K prototypes, V vertices.

    dist = 1000 * mean over the vertices of the squared distance, metres
    psi_k = exp(-dist_k / bandwidth), over their sum

References: TailorNet (CVPR 2020), equation 9. That it is normalised follows from the paper's "convex combination"; the
distance and the bandwidth of 0.01 are in the released code alone. A bandwidth of 0.01 is one of 3.2 mm: prototypes lie
30 mm apart, so that it lets the nearest speak alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64

__all__ = ["RELEASED_BANDWIDTH", "effective_number", "left_out_bandwidth", "prototype_weights", "squared_distances"]

RELEASED_BANDWIDTH = 0.01
SCALE = 1000.0
CANDIDATES = 2.0 ** np.arange(-8, 5)
"""Bandwidths to choose from, over the median distance of a prototype to its nearest neighbour."""


def squared_distances(
    garments: Float[np.ndarray, "N V 3"], prototypes: Float[np.ndarray, "K V 3"]
) -> Float64[np.ndarray, "N K"]:
    """`dist` of each garment to each prototype, of displacements over the body in the A-pose, metres."""
    return np.array(
        [
            [SCALE * ((one.astype(np.float64) - other) ** 2).sum(axis=1).mean() for other in prototypes]
            for one in garments
        ]
    ).reshape(len(garments), len(prototypes))


def prototype_weights(
    distances: Float64[np.ndarray, " K"], bandwidth: float, *, normalised: bool = True
) -> Float64[np.ndarray, " K"]:
    """psi of each prototype.

    Args:
        distances: `squared_distances` of one garment.
        normalised: False as equation 9 is printed; they sum to anything then.
    """
    if not normalised:
        return np.exp(-distances / bandwidth)
    found = np.exp(-(distances - distances.min()) / bandwidth)  # the nearest speaks however far it is
    return found / found.sum()


def effective_number(weights: Float64[np.ndarray, " K"]) -> float:
    """How many prototypes have a say: the exponential of the entropy of weights that sum to 1."""
    spoken = weights[weights > 0]
    return float(np.exp(-(spoken * np.log(spoken)).sum()))


def left_out_bandwidth(
    distances: Float64[np.ndarray, "K K"],
    said: Sequence[Float[np.ndarray, "K drapes numbers"]],
    truth: Sequence[Float[np.ndarray, "drapes numbers"]],
) -> tuple[float, list[tuple[float, float]]]:
    """The bandwidth with which every prototype is foretold best by the others.

    Args:
        distances: of the prototypes to each other.
        said: for each prototype, what the networks of all say to its poses.
        truth: what its drapes are in these poses.
    Returns:
        The bandwidth, and each candidate with its mean squared error. With fewer than three prototypes all candidates
        are as good, and the bandwidth is the median distance of neighbours.
    """
    count = len(distances)
    if count < 2:
        return RELEASED_BANDWIDTH, []
    apart = distances + np.diag(np.full(count, np.inf))
    neighbours = float(np.median(apart.min(axis=1)))
    if count < 3:
        return max(neighbours, 1e-12), []
    errors = []
    for bandwidth in max(neighbours, 1e-12) * CANDIDATES:
        total, rows = 0.0, 0
        for k in range(count):
            others = np.arange(count) != k
            weights = prototype_weights(distances[k, others], float(bandwidth))
            total += float(((np.tensordot(weights, said[k][others], axes=1) - truth[k]) ** 2).sum())
            rows += len(truth[k])
        errors.append((float(bandwidth), total / max(rows, 1)))
    return min(errors, key=lambda each: each[1])[0], errors
