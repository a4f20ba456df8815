"""Border points as curves: noise across them removed, loops told apart, ordered along, and a shirt's loops named."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, Int64
from scipy import sparse
from scipy.spatial import KDTree

__all__ = ["SHIRT", "loop_order", "name_shirt_loops", "separate_loops", "straighten"]

SHIRT = ("neck", "hem", "cuff_left", "cuff_right")
GAPS_M = (0.012, 0.02, 0.03, 0.045, 0.06)
"""Gaps in a border that are bridged, tried in turn."""
MIN_EXTENT_M = 0.08
"""Smaller groups of points are no loop of a garment."""
MAX_STRAYS = 0.1
"""Share of the points beside the loops above which the loops are pieces of loops."""
MAX_GAP_DEG = 100.0
"""Largest opening of a loop, seen from its middle; half a circle has 115."""
MIN_TILT = 0.15
"""Sine of the slope of a neckline from back to front below which it does not tell front from back."""


def straighten(points: Float[np.ndarray, "points 3"], reach_m: float) -> Float64[np.ndarray, "points 3"]:
    """Each point on the line through its neighbours, weighted by a Gaussian of half `reach_m`; strays stay."""
    points = np.asarray(points, np.float64)
    if len(points) < 3:
        return points
    tree = KDTree(points)
    pairs = tree.sparse_distance_matrix(tree, reach_m, output_type="coo_matrix")
    weight = np.exp(-2 * (pairs.data / reach_m) ** 2)

    def summed(values: np.ndarray) -> np.ndarray:
        return sparse.csr_array((weight, (pairs.row, np.arange(len(weight)))), (len(points), len(weight))) @ values

    middle = summed(points[pairs.col]) / summed(np.ones((len(weight), 1)))
    offset = points[pairs.col] - middle[pairs.row]
    spread = summed((offset[:, :, None] * offset[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
    strength, axes = np.linalg.eigh(spread)
    along = axes[:, :, 2]
    moved = middle + np.einsum("px,px->p", points - middle, along)[:, None] * along
    is_line = strength[:, 1] < 0.3 * strength[:, 2]
    return np.where(is_line[:, None], moved, points)


def separate_loops(points: Float[np.ndarray, "points 3"], count: int) -> Int64[np.ndarray, " points"]:
    """Which of `count` loops each point is on, the longest first; -1 for strays, or for all points."""
    for gap in GAPS_M:
        links = KDTree(points).query_pairs(gap, output_type="ndarray")
        graph = sparse.coo_array((np.ones(len(links), bool), links.T), shape=(len(points),) * 2)
        _, part = sparse.csgraph.connected_components(graph, directed=False)
        groups = [np.flatnonzero(part == label) for label in np.unique(part)]
        large = [group for group in groups if np.ptp(points[group], axis=0).max() > MIN_EXTENT_M]
        if len(large) == count:
            loop = np.full(len(points), -1)
            for index, group in enumerate(sorted(large, key=lambda group: -_length(points[group]))):
                loop[group] = index
            return loop
    return np.full(len(points), -1)


def _around(points: np.ndarray) -> Float64[np.ndarray, " points"]:
    """Angle of each point about the middle of its loop, seen along its axis, counter-clockwise from above."""
    centred = np.asarray(points, np.float64) - points.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    right, up = axes[0], np.cross(axes[2] * np.sign(axes[2][1] or 1.0), axes[0])
    return np.arctan2(centred @ up, centred @ right)


def _opening_deg(points: np.ndarray) -> float:
    """The largest angle about the middle without a point."""
    angles = np.sort(_around(points))
    return float(np.degrees(np.diff(angles, append=angles[0] + 2 * np.pi).max()))


def loop_order(points: Float[np.ndarray, "points 3"]) -> Int64[np.ndarray, " points"]:
    """Points in order around the middle of their loop, seen along its axis, counter-clockwise from above."""
    return np.argsort(_around(points), kind="stable")


def _length(points: np.ndarray) -> float:
    """Of the closed curve, robust to noise across it: corners are means over a twenty-fourth of the points."""
    corners = np.array([part.mean(axis=0) for part in np.array_split(points[loop_order(points)], 24) if len(part)])
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum())


def name_shirt_loops(points: Float[np.ndarray, "points 3"], names: Sequence[str]) -> Int32[np.ndarray, " points"]:
    """The index in `names` of the loop that each point is on, -1 where its shape does not tell.

    All four loops have to be there nearly whole: where arms hide pieces of them, what is left has other shapes. The hem
    is the longest loop; of the other three the two farthest apart are the cuffs. The neckline is lower in front, which
    tells left from right.
    """
    unknown = np.full(len(points), -1, np.int32)
    if sorted(names) != sorted(SHIRT) or not len(points):
        return unknown
    loop = separate_loops(points, len(SHIRT))
    members: list[Bool[np.ndarray, " points"]] = [loop == index for index in range(len(SHIRT))]
    if (loop < 0).mean() > MAX_STRAYS or max(_opening_deg(points[own]) for own in members) > MAX_GAP_DEG:
        return unknown
    middles = [points[own].mean(axis=0) for own in members]
    pairs = [(1, 2, 3), (1, 3, 2), (2, 3, 1)]
    one, other, neck = max(pairs, key=lambda pair: float(np.linalg.norm(middles[pair[0]] - middles[pair[1]])))
    named = unknown.copy()
    named[members[0]], named[members[neck]] = names.index("hem"), names.index("neck")
    upward = middles[neck] - middles[0]
    upward /= np.linalg.norm(upward)
    across = middles[one] - middles[other]
    forward = np.cross(across, upward)  # if `one` is the left cuff
    forward /= np.linalg.norm(forward)
    neckline = points[members[neck]] - middles[neck]
    depth = neckline @ forward
    slope = float((depth @ (neckline @ upward)) / (depth @ depth))
    if abs(slope) > MIN_TILT:
        left, right = (one, other) if slope < 0 else (other, one)
        named[members[left]], named[members[right]] = names.index("cuff_left"), names.index("cuff_right")
    return named
