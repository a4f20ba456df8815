"""Labels at the edges between colours, where the colours of a scan blend.

By its angle, a blend of a bright paint and a dark cloth counts as paint until little of it is left, which widens a
painted band by a millimetre. Here a vertex at an edge takes the colour that makes up more than half of it, judged by
the pure colours near it, which are under the same light.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, UInt8
from scipy.spatial import KDTree

from capture4d.types import Mesh

__all__ = ["sharpen_labels"]

RINGS = 2
"""Edges on both sides of a change of label that may blend."""
SAMPLES = 12
"""Pure vertices whose mean colour is the pure colour there."""
FARTHEST_M = 0.04
"""Pure vertices farther away say nothing."""


def sharpen_labels(
    mesh: Mesh, colours: UInt8[np.ndarray, "verts 3"], labels: UInt8[np.ndarray, " verts"]
) -> UInt8[np.ndarray, " verts"]:
    """Move the edges between labels to where the colours on both sides have equal shares.

    A vertex near an edge chooses among the labels of that edge; one whose label has no pure vertices nearby stays.
    """
    reached, mixed = _labels_within_reach(mesh, labels)
    edge = np.flatnonzero(reached.sum(axis=1) > 1)
    own = colours[edge].astype(np.float64)
    distance = np.full((len(edge), reached.shape[1]), np.inf)
    for label in range(reached.shape[1]):
        pure, asking = np.flatnonzero((labels == label) & ~mixed), np.flatnonzero(reached[edge, label])
        if len(pure) < SAMPLES or not len(asking):
            continue
        apart, near = KDTree(mesh.vertices[pure]).query(mesh.vertices[edge[asking]], SAMPLES)
        middle = colours[pure[near]].mean(axis=1)
        known = apart[:, -1] < FARTHEST_M
        distance[asking[known], label] = np.linalg.norm(own[asking] - middle, axis=1)[known]
    judged = np.isfinite(distance[np.arange(len(edge)), labels[edge]])
    result = labels.copy()
    result[edge[judged]] = distance[judged].argmin(axis=1)
    return result


def _labels_within_reach(
    mesh: Mesh, labels: np.ndarray
) -> tuple[Bool[np.ndarray, "verts labels"], Bool[np.ndarray, " verts"]]:
    """The labels within `RINGS` edges of each vertex, and whether it has more than one within a single edge."""
    sides = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    start, end = np.concatenate([sides, sides[:, ::-1]]).T
    reached = labels[:, None] == np.arange(int(labels.max(initial=0)) + 1)
    changes = labels[start] != labels[end]
    reached[start[changes], labels[end[changes]]] = True
    mixed = reached.sum(axis=1) > 1
    front = mixed
    for _ in range(RINGS - 1):
        near = front[end]
        before, front = reached.copy(), front.copy()
        for label in range(reached.shape[1]):
            reached[start[near & before[end, label]], label] = True
        front[start[near]] = True
    return reached, mixed
