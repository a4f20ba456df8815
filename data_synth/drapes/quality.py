"""Is a drape fit to be learned from?

References: area limits as Jin et al., A Pixel-Based Framework for Data-Driven Clothing (SCA 2020), prune their samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture4d.body.skinning import PosedBody, with_pose
from capture4d.geometry.mesh import edge_lengths, face_areas, vertex_normals
from capture4d.geometry.ray_casting import TriangleScene, barycentric
from capture4d.geometry.triangles import self_intersections
from data_synth.drapes.collision import BESIDE_COSINE
from data_synth.drapes.draping import Drape, Draper

__all__ = ["DrapeQuality", "face_area_ratios", "inside_parts", "measure_drape"]

AREA_LIMITS = (0.25, 2.0)
"""A face smaller or larger than these shares of its area on the pattern is crushed or overstretched."""
STRETCH_LIMIT = 1.2
INSIDE_LIMIT_PERCENT = 0.1
CUT_LIMIT_PERCENT = 15.0
"""Faces that cut the garment's own: cloth does not collide with cloth, and folds at armpit, groin and knee run through
each other in every strongly bent pose; beyond this share something is turned inside out."""
INSIDE_M = 1e-3
ROOM_M = 5e-3
"""Between skin and other skin nearer than this there is no room for cloth, which lies 1 to 5 mm over either: thigh and
calf of a squat touch and run through each other, and what is between them cannot be outside both."""


@dataclass(frozen=True, slots=True)
class DrapeQuality:
    """Measures of one drape."""

    smallest_area: float
    """Of a face, over that on the pattern."""
    largest_area: float
    stretch_p99: float
    """Edge length over rest length, 99th percentile."""
    inside_percent: float
    """Vertices more than a millimetre inside the part of the body that they meet, but for those between skins that
    touch."""
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


def measure_drape(draper: Draper, rotations: np.ndarray, drape: Drape) -> tuple[DrapeQuality, np.ndarray]:
    """Measure a drape against its pattern and the body in its pose, (J, 3, 3); and which faces, (F,), cut another."""
    areas = face_area_ratios(draper, drape.vertices)
    stretch = edge_lengths(drape.vertices, draper.sheet.edges) / draper.sheet.lengths
    p99 = float(np.percentile(stretch, 99))
    body = with_pose(draper.person, rotations, np.zeros(3))
    inside = 100 * float(inside_parts(body, draper.part_masks, draper.contacts, drape.vertices).mean())
    cuts = self_intersections(drape.vertices, draper.mesh.faces)
    cut = 100 * float(cuts.mean())
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
    quality = DrapeQuality(
        float(areas.min()), float(areas.max()), p99, inside, cut, drape.frames, drape.motion_mm, tuple(reasons)
    )
    return quality, cuts


def inside_parts(
    body: PosedBody, masks: np.ndarray, contacts: tuple[np.ndarray, np.ndarray], points: np.ndarray
) -> np.ndarray:
    """(V,) bool: vertices of a garment, (V, 3), more than a millimetre inside a part of the body that they meet.

    Inside the closed body, and behind the nearest skin of the part. A vertex of the trunk inside an arm is not counted:
    it meets the trunk alone. Nor is one at skin with other skin so near before it that there is no room for it.

    Args:
        masks: (P, B) bool, which vertices of the body belong to each part.
        contacts: the garment's vertices, and the part each meets, both (C,).
    """
    faces, surface = body.shaped.body.template.faces, body.vertices()
    scene = TriangleScene((surface, faces))
    deep = scene.signed_distances(points) < -INSIDE_M
    inside, normals = np.zeros(len(points), bool), vertex_normals(surface, faces)
    for part, mask in enumerate(masks):
        chosen = contacts[0][contacts[1] == part]
        chosen = chosen[deep[chosen]]
        if not len(chosen):
            continue
        own = faces[mask[faces].all(axis=1)]
        near = TriangleScene((surface, own)).nearest(points[chosen])
        normal = np.einsum("nk,nkx->nx", barycentric(near.uv), normals[own[near.faces]])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        offsets = points[chosen] - near.points
        depth = -np.einsum("nx,nx->n", offsets, normal)
        own_inside = depth > np.maximum(INSIDE_M, BESIDE_COSINE * np.linalg.norm(offsets, axis=1))
        touching = scene.signed_distances(near.points + ROOM_M * normal) < 0
        inside[chosen] |= own_inside & ~touching
    return inside
