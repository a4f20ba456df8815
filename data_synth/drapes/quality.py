"""Is a drape fit to be learned from?

References: area limits as Jin et al., A Pixel-Based Framework for Data-Driven Clothing (SCA 2020), prune their samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture4d.body.skinning import with_pose
from capture4d.geometry.mesh import edge_lengths, face_areas
from capture4d.geometry.ray_casting import TriangleScene
from capture4d.geometry.triangles import self_intersections
from data_synth.drapes.draping import Drape, Draper

__all__ = ["DrapeQuality", "face_area_ratios", "measure_drape"]

AREA_LIMITS = (0.25, 2.0)
"""A face smaller or larger than these shares of its area on the pattern is crushed or overstretched."""
STRETCH_LIMIT = 1.2
INSIDE_LIMIT_PERCENT = 0.1
CUT_LIMIT_PERCENT = 15.0
"""Faces that cut the garment's own: cloth does not collide with cloth, and folds at armpit, groin and knee run through
each other in every strongly bent pose; beyond this share something is turned inside out."""
INSIDE_M = 1e-3


@dataclass(frozen=True, slots=True)
class DrapeQuality:
    """Measures of one drape."""

    smallest_area: float
    """Of a face, over that on the pattern."""
    largest_area: float
    stretch_p99: float
    """Edge length over rest length, 99th percentile."""
    inside_percent: float
    """Vertices more than a millimetre inside the part of the body that they meet."""
    cut_percent: float
    """Faces that cut another face of the garment."""
    frames: int
    """Sixtieths of a second until it was at rest."""
    motion_mm: float
    """Mean motion in the last of them."""
    reasons: tuple[str, ...]
    """Why it is not to be learned from; empty for a good one."""


def face_area_ratios(draper: Draper, vertices: np.ndarray) -> np.ndarray:
    """(F,) area of each face over that on the pattern."""
    return face_areas(vertices, draper.mesh.faces) / draper.sheet.areas


def measure_drape(draper: Draper, rotations: np.ndarray, drape: Drape) -> DrapeQuality:
    """Measure a drape against its pattern and the body in its pose, (J, 3, 3)."""
    areas = face_area_ratios(draper, drape.vertices)
    stretch = edge_lengths(drape.vertices, draper.sheet.edges) / draper.sheet.lengths
    p99 = float(np.percentile(stretch, 99))
    inside = _inside_percent(draper, rotations, drape.vertices)
    cut = 100 * float(self_intersections(drape.vertices, draper.mesh.faces).mean())
    reasons = []
    crushed, over = int((areas < AREA_LIMITS[0]).sum()), int((areas > AREA_LIMITS[1]).sum())
    if crushed or over:
        reasons.append(f"area: {crushed} faces crushed, {over} overstretched")
    if p99 > STRETCH_LIMIT:
        reasons.append(f"stretched: 99 % of the edges within {p99:.2f} of their length")
    if inside > INSIDE_LIMIT_PERCENT:
        reasons.append(f"{inside:.2f} % of the vertices inside the body")
    if cut > CUT_LIMIT_PERCENT:
        reasons.append(f"{cut:.0f} % of the faces cut others")
    if drape.motion_mm >= draper.config.solver.still_mm:
        reasons.append(f"not at rest: {drape.motion_mm:.2f} mm in the last 1/60 s")
    return DrapeQuality(
        float(areas.min()), float(areas.max()), p99, inside, cut, drape.frames, drape.motion_mm, tuple(reasons)
    )


def _inside_percent(draper: Draper, rotations: np.ndarray, vertices: np.ndarray) -> float:
    """Share of the vertices inside the closed body, over whose nearest skin their own part lies as well.

    A vertex of the trunk inside an arm is not counted: it meets the trunk alone.
    """
    body = with_pose(draper.person, rotations, np.zeros(3))
    faces, surface = body.shaped.body.template.faces, body.vertices()
    scene = TriangleScene((surface, faces))
    suspects = np.flatnonzero(scene.signed_distances(vertices) < -INSIDE_M)
    if not len(suspects):
        return 0.0
    under = faces[scene.nearest(vertices[suspects]).faces]
    masks = draper.part_masks
    meets = np.zeros((len(masks), len(vertices)), bool)
    meets[draper.contacts[1], draper.contacts[0]] = True
    counted = (masks[:, under].all(axis=2) & meets[:, suspects]).any(axis=0)
    return 100 * float(counted.sum()) / len(vertices)
