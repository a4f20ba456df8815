"""Limbs that have turned about themselves: an arm is as round as it is long, and only its hand tells which way it lies.

A limb that swung far from the template's pose may lie on the scan with its hand turned away, and nearest points will
not turn it back. The end of every limb is laid on the scan turned by every so many degrees; where another turn fits far
better than the one it has, the limb is twisted there, all at its end and less towards its root.

Limbs end where ways along the surface from its middle do: hands, feet, a head, the ends of sleeves. A round sleeve fits
whichever way it is turned, and stays.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.sparse import csgraph
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from registration.alignment import fit_similarity
from registration.approach import spread_evenly
from registration.correspondences import ScanSurface, mesh_normals
from registration.deformation_graph import surface_graph
from registration.template import TemplateAnalysis

__all__ = ["untwisted"]

LIMBS = 6
"""Ends that are looked for, the farthest first."""
LEAST_WAY = 0.5
"""A limb's end is farther from the middle than this share of the farthest one's."""
REACH = 0.55
"""Share of the way from its end to the middle that is a limb."""
END = 0.3
"""Share of the limb that is its end, which is laid on the scan."""
TURNS_DEG = tuple(range(0, 360, 30))
STEPS = 5
"""Of the end onto the scan, rigidly, from each turn."""
NORMAL_LENGTH = 0.03
"""What a normal turned by 60 degrees counts as among distances, metres."""
AROUND = 0.035
"""What of the scan is this near to the end, metres, belongs to it."""
FARTHEST = 0.03
"""Beyond this, metres, one point is as far off as another."""
FEWEST = 25
"""Of each without which there is nothing to compare."""
POINTS = 250
"""Vertices and scan points of an end that are compared."""
BETTER = 0.95
"""Another turn fits far better that brings the distances down to this share."""
RINGS = 12
"""Places along a limb at which its axis is measured."""


@dataclass(frozen=True, slots=True, eq=False)
class _Limb:
    """A limb of the template."""

    members: np.ndarray
    """Its vertices."""
    way: Float64[np.ndarray, " members"]
    """From its end along the surface, metres."""
    reach: float
    """Its length, metres."""

    @property
    def end(self) -> np.ndarray:
        """The vertices of its end."""
        return self.members[self.way < END * self.reach]


def untwisted(
    analysis: TemplateAnalysis, surface: ScanSurface, vertices: Float64[np.ndarray, "verts 3"]
) -> Float64[np.ndarray, "verts 3"] | None:
    """The template with its limbs turned as their ends fit; None where all of them do already.

    Args:
        vertices: where the template lies on the scan, metres.
    """
    turned, changed = vertices.copy(), False
    normals = mesh_normals(analysis.rest, analysis.faces)
    for limb in _limbs(analysis):
        angle = _angle(analysis, limb, surface, vertices, normals)
        if angle != 0.0:
            turned[limb.members] = _twisted(limb, vertices[limb.members], angle)
            changed = True
    return turned if changed else None


def _limbs(analysis: TemplateAnalysis) -> Iterator[_Limb]:
    """The farther ends of the template, each with what is nearer to it than the middle is."""
    graph = surface_graph(analysis.rest, analysis.faces)

    def ways(source: int) -> np.ndarray:
        """To every vertex; 0 where none leads."""
        found = csgraph.dijkstra(graph, directed=False, indices=source)
        return np.where(np.isfinite(found), found, 0.0)

    one = ways(int(analysis.faces[0, 0]))
    one = ways(int(np.argmax(one)))
    other = ways(int(np.argmax(one)))
    reached = np.maximum(one, other)
    from_middle = ways(int(np.argmin(np.where(reached > 0.0, reached, np.inf))))
    left, farthest = from_middle.copy(), float(from_middle.max())
    for _ in range(LIMBS):
        tip = int(np.argmax(left))
        length = float(left[tip])
        if length <= LEAST_WAY * farthest:
            return
        way = ways(tip)
        reach = REACH * length
        members = np.flatnonzero((way < reach) & (from_middle > 0.0))
        left[way < 1.2 * reach] = 0.0
        yield _Limb(members, way[members], reach)


def _angle(
    analysis: TemplateAnalysis, limb: _Limb, surface: ScanSurface, vertices: np.ndarray, normals: np.ndarray
) -> float:
    """By how much the end has to be turned about the limb's axis, radians; 0 where another turn is hardly better."""
    end = limb.end
    if len(end) < FEWEST:
        return 0.0
    lying = fit_similarity(analysis.rest[end], vertices[end], with_scale=False)  # with the shape of the template
    end = end[spread_evenly(vertices[end], POINTS)]
    points, facing = lying.apply(analysis.rest[end]), normals[end] @ lying.rotation.T
    near = np.flatnonzero(KDTree(points).query(surface.points, distance_upper_bound=AROUND)[0] < np.inf)
    owner = KDTree(vertices).query(surface.points[near])[1]
    near = near[np.isin(owner, limb.members)]
    if len(near) < FEWEST:
        return 0.0
    near = near[spread_evenly(surface.points[near], POINTS)]
    shown, looks = surface.points[near], surface.normals[near]
    centres = _centres(limb, vertices[limb.members])
    axis = centres[0] - centres[min(RINGS - 1, round(2 * END * RINGS))]
    axis /= max(float(np.linalg.norm(axis)), 1e-9)
    tried = [_laid(points, facing, shown, looks, axis, np.radians(turn)) for turn in TURNS_DEG]
    misfit, angle = min(tried)
    return angle if misfit < BETTER * tried[0][0] else 0.0


def _laid(
    points: np.ndarray, facing: np.ndarray, shown: np.ndarray, looks: np.ndarray, axis: np.ndarray, turn: float
) -> tuple[float, float]:
    """Misfit of the end after it is turned and brought to the scan rigidly, metres; and its turn about the axis then,
    radians."""
    centre = points.mean(axis=0)
    start = Rotation.from_rotvec(turn * axis).as_matrix()
    turning, place = start, centre
    scan = np.concatenate([shown, NORMAL_LENGTH * looks], axis=1)
    tree = KDTree(scan)

    def features() -> np.ndarray:
        return np.concatenate([(points - centre) @ turning.T + place, NORMAL_LENGTH * facing @ turning.T], axis=1)

    for _ in range(STEPS):
        now = features()
        there = tree.query(now)[1]
        back = KDTree(now).query(scan)[1]
        own = np.concatenate([np.arange(len(points)), back])
        fitted = fit_similarity(points[own], np.concatenate([shown[there], shown]), with_scale=False)
        turning, place = fitted.rotation, fitted.apply(centre[None])[0]
    now = features()
    forth, back = tree.query(now)[0], KDTree(now).query(scan)[0]
    misfit = float(np.minimum(forth, FARTHEST).mean() + np.minimum(back, FARTHEST).mean())
    return misfit, _about(turning, axis)


def _about(rotation: np.ndarray, axis: np.ndarray) -> float:
    """The part of a rotation that is about an axis, radians (swing and twist)."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    angle = 2.0 * float(np.arctan2(np.array([x, y, z]) @ axis, w))
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _centres(limb: _Limb, points: np.ndarray) -> Float64[np.ndarray, "rings 3"]:
    """Middles of the limb's rings, from its end to its root."""
    ring = np.minimum((RINGS * limb.way / limb.reach).astype(int), RINGS - 1)
    count = np.bincount(ring, minlength=RINGS)
    sums = np.stack([np.bincount(ring, axis, minlength=RINGS) for axis in points.T], axis=1)
    filled = np.flatnonzero(count)
    middles = sums[filled] / count[filled, None]
    return np.stack([np.interp(np.arange(RINGS), filled, axis) for axis in middles.T], axis=1)


def _twisted(limb: _Limb, points: np.ndarray, angle: float) -> np.ndarray:
    """The limb turned about its own, maybe bent, axis: by the angle at its end, by nothing at its root."""
    centres = _centres(limb, points)
    place = np.clip(RINGS * limb.way / limb.reach - 0.5, 0.0, RINGS - 1.0)
    along = np.gradient(centres, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    rings = np.arange(RINGS)
    middle, axis = (
        np.stack([np.interp(place, rings, part) for part in values.T], axis=1) for values in (centres, along)
    )
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
    share = np.clip((1.0 - limb.way / limb.reach) / (1.0 - END), 0.0, 1.0)
    turn = Rotation.from_rotvec((-angle * share)[:, None] * axis)  # the axis of the rings runs from the end to the root
    return middle + turn.apply(points - middle)
