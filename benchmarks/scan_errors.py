"""A scan against the surface it was made from: distance, normal error, holes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from capture4d.geometry.mesh import face_areas, vertex_normals
from capture4d.geometry.ray_casting import closest_points
from capture4d.types import Mesh

__all__ = ["ScanErrors", "scan_errors"]


@dataclass(frozen=True, slots=True, eq=False)
class ScanErrors:
    """A scan of a sheet against the sheet."""

    distance_m: Float64[np.ndarray, " verts"]
    """Scan vertex to the true surface."""
    normal_deg: Float64[np.ndarray, " verts"]
    """Angle between the scan's and the true normal, of the side that was scanned."""
    hole_share: float
    """Part of the true area that has no scan vertex within the gate."""


def scan_errors(scan: Mesh, truth: Mesh, *, hole_gate_m: float = 0.004, samples: int = 50_000) -> ScanErrors:
    """Measure the scan of an open sheet, which may show either side of it.

    Args:
        scan: the part of the scan that shows the sheet, without a change of its own borders.
        hole_gate_m: farther than this from every scan vertex, the true surface counts as not scanned.
    """
    points, faces, barycentric = closest_points(truth, scan.vertices)
    normals = vertex_normals(truth.vertices, truth.faces)
    expected = np.einsum("vc,vcx->vx", barycentric, normals[truth.faces[faces]])
    expected /= np.maximum(np.linalg.norm(expected, axis=1, keepdims=True), 1e-12)
    cosine = np.einsum("vx,vx->v", vertex_normals(scan.vertices, scan.faces), expected)
    areas = face_areas(truth.vertices, truth.faces).astype(float)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(areas), samples, p=areas / areas.sum())
    weights = rng.dirichlet((1, 1, 1), samples)
    on_truth = np.einsum("vc,vcx->vx", weights, truth.vertices[truth.faces[chosen]])
    nearest, _ = KDTree(scan.vertices).query(on_truth)
    return ScanErrors(
        distance_m=np.linalg.norm(points.astype(float) - scan.vertices, axis=1),
        normal_deg=np.degrees(np.arccos(np.clip(np.abs(cosine.astype(float)), 0, 1))),
        hole_share=float((nearest > hole_gate_m).mean()),
    )
