"""Where each border vertex of the template should go: DeepWrinkles (ECCV 2018) Eq. 2 and three variants.

Every painted scan point votes for its nearest template border vertex; C(t) are the voters of border vertex t. The
paper prints s_t = max over C(t) of |t - s|, where a point is needed: the argmax. C(t) may be empty, then t has no
target and no term. C changes as the template moves, so targets are asked for anew before every Gauss-Newton step.

    argmax   the farthest voter: reaches into folds that the nearest point ignores, but slides vertices along the
             curve, because the farthest point of a cell is on average off its centre
    nearest  the nearest painted point, voters or not: the strategy the paper compares with
    mean     the mean of C(t)

`tangent_free_metric` drops the residual's component along the border ("line"), which cures the sliding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, assert_never

import numpy as np
from jaxtyping import Bool, Float64, Int32

from capture4d.geometry.point_grid import PointGrid

__all__ = ["BorderTargets", "border_targets", "tangent_free_metric"]

CURVE_POINTS = 6.0
"""A search cell is as long as so many points of a curve, if they lay on a line: some three times that on a loop."""


@dataclass(frozen=True, slots=True, eq=False)
class BorderTargets:
    """One target per border vertex."""

    points: Float64[np.ndarray, "border 3"]
    """Targets, metres; the vertex itself where it has none."""
    valid: Bool[np.ndarray, " border"]


def border_targets(
    border: Float64[np.ndarray, "border 3"],
    loops: Int32[np.ndarray, " border"],
    scan_points: Float64[np.ndarray, "points 3"],
    scan_loops: Int32[np.ndarray, " points"],
    *,
    rule: Literal["argmax", "nearest", "mean", "none"],
    gate: float,
) -> BorderTargets:
    """Targets of the template's border vertices.

    Args:
        border: template border vertices, metres.
        loops: the loop of each border vertex.
        scan_loops: the loop of each painted point where the paint tells, else -1; then it votes among the loops that no
            point names.
        gate: farthest voter, metres.
    """
    points = border.copy()
    valid = np.zeros(len(border), bool)
    if rule == "none" or not len(scan_points) or not len(border):
        return BorderTargets(points, valid)
    for template_part, scan_part in _groups(loops, scan_loops):
        targets, found = _one_group(border[template_part], scan_points[scan_part], rule, gate)
        points[template_part[found]] = targets[found]
        valid[template_part[found]] = True
    return BorderTargets(points, valid)


def tangent_free_metric(
    tangents: Float64[np.ndarray, "border 3"], weights: Float64[np.ndarray, " border"]
) -> Float64[np.ndarray, "border 3 3"]:
    """w (I - t t^T): distance to the line along the border through the target."""
    return weights[:, None, None] * (np.eye(3) - tangents[:, :, None] * tangents[:, None, :])


def _groups(loops: np.ndarray, scan_loops: np.ndarray) -> Sequence[tuple[np.ndarray, np.ndarray]]:
    """Template border vertices and the painted points that may vote for them.

    Points whose paint does not tell vote among the loops that no point names.
    """
    points_of = np.bincount(scan_loops[scan_loops >= 0], minlength=int(loops.max()) + 1)
    told = np.flatnonzero(points_of)
    parts = [(np.flatnonzero(loops == loop), np.flatnonzero(scan_loops == loop)) for loop in told]
    parts.append((np.flatnonzero(points_of[loops] == 0), np.flatnonzero(scan_loops < 0)))
    return [(template, scan) for template, scan in parts if len(template) and len(scan)]


def _one_group(
    border: np.ndarray, scan_points: np.ndarray, rule: Literal["argmax", "nearest", "mean"], gate: float
) -> tuple[np.ndarray, np.ndarray]:
    if rule == "nearest":
        distance, index = _nearest(scan_points, border, gate)
        found = np.isfinite(distance)
        return scan_points[np.where(found, index, 0)], found
    all_distances, nearest = _nearest(border, scan_points, gate)
    voter = np.flatnonzero(np.isfinite(all_distances))
    voted, distance = nearest[voter], all_distances[voter]
    targets, found = border.copy(), np.zeros(len(border), bool)
    found[voted] = True
    if rule == "argmax":
        order = np.argsort(distance, kind="stable")
        targets[voted[order]] = scan_points[voter[order]]
    elif rule == "mean":
        count = np.bincount(voted, minlength=len(border))[:, None]
        total = np.column_stack(
            [np.bincount(voted, scan_points[voter, axis], minlength=len(border)) for axis in range(3)]
        )
        targets[found] = (total / np.maximum(count, 1))[found]
    else:
        assert_never(rule)
    return targets, found


def _nearest(points: np.ndarray, queries: np.ndarray, gate: float) -> tuple[np.ndarray, np.ndarray]:
    """Distance to the nearest of some points along curves, infinite beyond the gate, and its index."""
    extent = float((points.max(axis=0) - points.min(axis=0)).max())
    cell = np.clip(CURVE_POINTS * extent / len(points), gate / 8, gate)
    return PointGrid.build(points, float(cell)).query(queries, gate)
