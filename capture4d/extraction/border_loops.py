"""Border points as curves: noise across them removed, loops told apart, ordered along, and named by their shape.

Known are shirts (neck, hem, two cuffs), trousers (waist, two legs) and skirts (waist, hem).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, Int64
from scipy import sparse
from scipy.spatial import KDTree

__all__ = ["SHIRT", "SKIRT", "TROUSERS", "loop_order", "name_loops", "separate_loops", "straighten"]

SHIRT = ("neck", "hem", "cuff_left", "cuff_right")
TROUSERS = ("waist", "leg_left", "leg_right")
SKIRT = ("waist", "hem")
GAPS_M = (0.012, 0.02, 0.03, 0.045, 0.06)
"""Gaps in a border that are bridged, tried in turn."""
MIN_EXTENT_M = 0.08
"""Smaller groups of points are no loop of a garment."""
MAX_STRAYS = 0.1
"""Share of the points beside the loops above which the loops are pieces of loops."""
MAX_GAP_DEG = 100.0
"""Largest opening of a loop, seen from its middle; half a circle has 115."""
WAIST_OVER_LEG = 1.25
"""Least ratio of a waist's length to that of the longer leg of trousers, by which it is known."""
SEAT_BAND_M = (0.08, 0.24)
"""Where the seat of trousers is, below the waist."""
MIN_SEAT_M = 0.012
"""By how much the seat has to stand out farther than the belly to tell front from back."""
STANDING = 0.5
"""Trousers that reach farther to front and back, as a share of their height, are those of bent legs: they tell neither
front nor back."""
MIN_DROP_M = 0.1
"""A skirt's hem is at least so far below its waist."""
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


def name_loops(
    points: Float[np.ndarray, "points 3"],
    names: Sequence[str],
    surface: Float[np.ndarray, "verts 3"] | None = None,
) -> Int32[np.ndarray, " points"]:
    """The index in `names` of the loop that each point is on, -1 where its shape does not tell.

    All loops have to be there nearly whole: where arms hide pieces of them, what is left has other shapes.

    Args:
        points: border points of one garment, Y up.
        surface: vertices of its scan, by whose seat the legs of trousers are told; without them they are not.
    """
    unknown = np.full(len(points), -1, np.int32)
    kind = next((kind for kind in (SHIRT, TROUSERS, SKIRT) if sorted(kind) == sorted(names)), None)
    if kind is None or not len(points):
        return unknown
    loop = separate_loops(points, len(kind))
    members: list[Bool[np.ndarray, " points"]] = [loop == index for index in range(len(kind))]
    if (loop < 0).mean() > MAX_STRAYS or max(_opening_deg(points[own]) for own in members) > MAX_GAP_DEG:
        return unknown
    loops = [points[own] for own in members]
    if kind == SHIRT:
        found = _shirt_names(loops)
    elif kind == TROUSERS:
        found = _trousers_names(loops, surface)
    else:
        found = _skirt_names(loops)
    for own, name in zip(members, found, strict=True):
        if name is not None:
            unknown[own] = names.index(name)
    return unknown


def _shirt_names(loops: Sequence[np.ndarray]) -> list[str | None]:
    """Of four loops, the longest first: that is the hem, the two of the others farthest apart are the cuffs. The
    neckline is lower in front, which tells left from right."""
    middles = [loop.mean(axis=0) for loop in loops]
    pairs = [(1, 2, 3), (1, 3, 2), (2, 3, 1)]
    one, other, neck = max(pairs, key=lambda pair: float(np.linalg.norm(middles[pair[0]] - middles[pair[1]])))
    found: list[str | None] = ["hem", None, None, None]
    found[neck] = "neck"
    upward = middles[neck] - middles[0]
    upward /= np.linalg.norm(upward)
    across = middles[one] - middles[other]
    forward = np.cross(across, upward)  # if `one` is the left cuff
    forward /= np.linalg.norm(forward)
    neckline = loops[neck] - middles[neck]
    depth = neckline @ forward
    slope = float((depth @ (neckline @ upward)) / (depth @ depth))
    if abs(slope) > MIN_TILT:
        left, right = (one, other) if slope < 0 else (other, one)
        found[left], found[right] = "cuff_left", "cuff_right"
    return found


def _trousers_names(loops: Sequence[np.ndarray], surface: np.ndarray | None) -> list[str | None]:
    """Of three loops, the longest first: that is the waist, if it is longer by far. The seat stands out behind, which
    tells left from right while the legs are straight."""
    if _length(loops[0]) < WAIST_OVER_LEG * _length(loops[1]):
        return [None, None, None]
    found: list[str | None] = ["waist", None, None]
    if surface is None:
        return found
    waist, one, other = (loop.mean(axis=0) for loop in loops)
    upward = waist - (one + other) / 2
    height = float(np.linalg.norm(upward))
    upward /= height
    across = one - other
    forward = np.cross(across - (across @ upward) * upward, upward)  # if `one` is the left leg
    forward /= np.linalg.norm(forward)
    depth, below = (surface - waist) @ forward, (waist - surface) @ upward
    seat = depth[(below > SEAT_BAND_M[0]) & (below < SEAT_BAND_M[1])]
    if np.ptp(depth) > STANDING * height or not len(seat):
        return found
    front, back = np.percentile(seat, 99), -np.percentile(seat, 1)
    if abs(back - front) > MIN_SEAT_M:
        found[1:] = ("leg_left", "leg_right") if back > front else ("leg_right", "leg_left")
    return found


def _skirt_names(loops: Sequence[np.ndarray]) -> list[str | None]:
    """Of two loops the lower is the hem: a skirt hangs, whatever the pose."""
    heights = [float(loop[:, 1].mean()) for loop in loops]
    if abs(heights[0] - heights[1]) < MIN_DROP_M:
        return [None, None]
    return ["waist", "hem"] if heights[0] > heights[1] else ["hem", "waist"]
