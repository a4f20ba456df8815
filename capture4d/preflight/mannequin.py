"""A rough mannequin that stands into scans, to tell which way is up and where the feet are, without motion capture.

It has a head on top, trunk and legs; arms are wherever they may be. Letters: N points.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import KDTree

from capture4d.geometry.mesh import doubled_area_vectors
from capture4d.preflight.motion import CLIP_M
from capture4d.types import Mesh

__all__ = ["PROBE_POINTS", "UNIT_NORMALS", "MannequinFit", "find_up", "fit_mannequin", "sample_surface", "upright"]

PROBE_POINTS = 200
NORMAL_M = 0.06
"""A unit of difference between normals counts as much as this distance."""
UNIT_NORMALS = np.array([1.0] * 3 + [NORMAL_M] * 3)
SCALE_RANGE = (0.8, 1.2)
"""Sizes of adults relative to the mannequin's 1.72 m."""


def sample_surface(mesh: Mesh, *, outward: bool = True, count: int = PROBE_POINTS) -> Float64[np.ndarray, "N 6"]:
    """Points spread evenly over the area of a surface, the same ones every time, with normals times `NORMAL_M`.

    Args:
        outward: the faces wind counter-clockwise seen from outside.
    """
    vertices = mesh.vertices.astype(np.float64)
    normals = doubled_area_vectors(vertices, mesh.faces)
    size = np.linalg.norm(normals, axis=1)
    area = size.cumsum()
    chosen = np.searchsorted(area, (np.arange(count) + 0.5) / count * area[-1])
    unit = normals[chosen] / np.maximum(size[chosen, None], 1e-12) * (NORMAL_M if outward else -NORMAL_M)
    return np.hstack([vertices[mesh.faces[chosen]].mean(axis=1), unit])


@dataclass(frozen=True, slots=True)
class MannequinFit:
    """How well a mannequin explains a scan."""

    misfit_m: float
    """Mean distance, each point's at most `CLIP_M`."""
    sole_m: float
    """Where the mannequin stands, along the direction that was taken for up."""


def find_up(probes: Sequence[Float[np.ndarray, "N 6"]]) -> dict[int, MannequinFit]:
    """Fit the mannequin for each direction that may be up.

    Args:
        probes: points on scans, metres, with outward normals times `NORMAL_M`, in file axes.
    Returns:
        By axis 0, 1, 2 for x, y, z up and 3, 4, 5 for the same downwards: the mean over the probes.
    """
    fits = {}
    for up in range(6):
        turn = np.kron(np.eye(2), upright(up))
        turned = [fit_mannequin(points @ turn.T) for points in probes]
        fits[up] = MannequinFit(
            float(np.mean([fit.misfit_m for fit in turned])), float(np.median([fit.sole_m for fit in turned]))
        )
    return fits


def upright(up: int) -> Float64[np.ndarray, "3 3"]:
    """The rotation by quarter turns that takes axis `up` (3 to 5: downwards) to Y."""
    axis, sign = up % 3, -1.0 if up >= 3 else 1.0
    if axis == 1:
        return np.diag([1.0, sign, sign])
    other = 2 - axis
    rotation = np.zeros((3, 3))
    rotation[1, axis] = sign
    rotation[axis, 1] = -sign
    rotation[other, other] = 1.0
    return rotation


def fit_mannequin(points: Float[np.ndarray, "N 6"]) -> MannequinFit:
    """Stand a mannequin into oriented points by closest points: turn about the vertical, shift, and scale a little."""
    figure, tree, top = _mannequin()
    points = np.asarray(points, np.float64)
    low, high = np.percentile(points[:, 1], (1, 99))
    shifts = (top - high, -low, 1.15 - points[:, 1].mean())
    best = MannequinFit(np.inf, 0.0)
    for quarter, shift in itertools.product(range(6), shifts):
        pose = _Pose(_about_y(quarter * np.pi / 6), 1.0, np.zeros(3))
        centre = points[:, :3].mean(axis=0) * (1, 0, 1) - (0, shift, 0)
        pose = _Pose(pose.rotation, 1.0, -pose.rotation @ centre)
        for _ in range(8):
            moved = pose.apply(points)
            distance, nearest = tree.query(moved)
            pose = _about_y_pose(points[:, :3], figure[nearest, :3], 1.0 / (1 + (distance / CLIP_M) ** 2) ** 2)
        distance, _ = tree.query(pose.apply(points))
        misfit = float(np.minimum(distance, CLIP_M).mean())
        if misfit < best.misfit_m:
            best = MannequinFit(misfit, float(-pose.shift[1] / pose.scale))
    return best


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    rotation: np.ndarray
    scale: float
    shift: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        moved = self.scale * points[:, :3] @ self.rotation.T + self.shift
        return np.hstack([moved, points[:, 3:] @ self.rotation.T])


def _about_y(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def _about_y_pose(points: np.ndarray, target: np.ndarray, weight: np.ndarray) -> _Pose:
    """The turn about the vertical, scale and shift that bring points nearest to their targets."""
    weight = weight / weight.sum()
    here, there = weight @ points, weight @ target
    a, b = points - here, target - there
    cosine = float(weight @ (a[:, 0] * b[:, 0] + a[:, 2] * b[:, 2]))
    sine = float(weight @ (a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]))
    rotation = _about_y(np.arctan2(sine, cosine))
    scale = float(weight @ np.einsum("na,na->n", b, a @ rotation.T)) / max(float(weight @ (a * a).sum(axis=1)), 1e-12)
    scale = float(np.clip(scale, *SCALE_RANGE))
    return _Pose(rotation, scale, there - scale * rotation @ here)


@lru_cache(maxsize=1)
def _mannequin() -> tuple[np.ndarray, KDTree, float]:
    """Points on a rough person 1.72 m tall facing +Z, feet on y = 0; proportions after Drillis and Contini (1966)."""
    bones = [
        ((0, 1.55, 0.01), (0, 1.63, 0.02), 0.08, 0.09),
        ((0, 1.42, 0), (0, 1.54, 0), 0.06, 0.055),
        ((-0.16, 1.39, 0), (0.16, 1.39, 0), 0.055, 0.055),
        ((0, 0.95, 0), (0, 1.36, 0), 0.12, 0.12),
    ]
    for side in (-1.0, 1.0):
        bones += [
            ((side * 0.09, 0.95, 0), (side * 0.1, 1.33, 0), 0.11, 0.105),
            ((side * 0.09, 0.88, 0), (side * 0.1, 0.48, 0), 0.085, 0.055),
            ((side * 0.1, 0.48, 0), (side * 0.1, 0.08, 0), 0.055, 0.04),
            ((side * 0.1, 0.04, -0.04), (side * 0.12, 0.035, 0.16), 0.035, 0.03),
        ]
        shoulder = np.array([side * 0.18, 1.39, 0])
        for lateral, rise, forward in ((0.15, -1, 0.1), (0.7, -0.7, 0), (1, 0, 0), (0.4, 0.9, 0), (0.1, 0, 1)):
            arm = np.array([side * lateral, rise, forward]) / np.linalg.norm((lateral, rise, forward))
            bones.append((tuple(shoulder), tuple(shoulder + 0.68 * arm), 0.05, 0.03))
    points = np.concatenate([_capsule(np.array(start), np.array(end), r, s) for start, end, r, s in bones])
    return points, KDTree(points), float(points[:, 1].max())


def _capsule(start: np.ndarray, end: np.ndarray, first: float, last: float) -> np.ndarray:
    """Points some 25 mm apart on a cone with round ends, and their normals times `NORMAL_M`."""
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, (0.3, 0.5, 0.81))
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    length = np.linalg.norm(end - start)
    rings = []
    for along in np.arange(-0.8 * first, length + 0.8 * last + 1e-9, 0.025):
        share = np.clip(along / length, 0, 1)
        radius = first + share * (last - first)
        beyond = max(-along, along - length, 0.0)
        radius = np.sqrt(max(radius**2 - beyond**2, 1e-4))
        angle = np.arange(0, 2 * np.pi, 0.025 / max(radius, 0.02))
        ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
        tip = np.sign(along - length / 2) * beyond
        normal = radius * ring + tip * axis
        normal *= NORMAL_M / np.linalg.norm(normal, axis=1, keepdims=True)
        rings.append(np.hstack([start + along * axis + radius * ring, normal]))
    return np.concatenate(rings)
