"""Is a simulated frame fit to be ground truth? Measures, and the reasons to flag a frame.

References: area limits as Jin et al. prune their samples, appendix (below 25 % or above 200 % of the rest area).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture4d.geometry.mesh import face_areas
from capture4d.geometry.ray_casting import TriangleScene
from data_synth.cloth.patterns import PanelMesh
from data_synth.cloth.stencils import rest_areas
from data_synth.cloth.wrinkle_relaxation import WrinkleMesh

__all__ = ["ClothQuality", "measure_cloth", "principal_stretches"]

AREA_LIMITS = (0.25, 2.0)
STRETCH_LIMIT = 1.2
INSIDE_LIMIT_PERCENT = 0.1


@dataclass(frozen=True, slots=True)
class ClothQuality:
    """One frame of simulated cloth."""

    stretch_p99: float
    """Edge length over rest length, 99th percentile."""
    crushed_faces: int
    overstretched_faces: int
    """Faces outside `AREA_LIMITS`."""
    inside_body_percent: float
    """Vertices inside the body."""
    reasons: tuple[str, ...]
    """Why the frame should not be trusted; empty for a good one."""


def measure_cloth(
    mesh: PanelMesh, wrinkles: WrinkleMesh, vertices: np.ndarray, surface: np.ndarray, body_faces: np.ndarray
) -> ClothQuality:
    """Measure a fine frame, (V, 3) metres, against its pattern and the body surface, (B, 3)."""
    ends = vertices[wrinkles.edges]
    stretch = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / wrinkles.rest_lengths
    area = face_areas(vertices.astype(np.float64), mesh.faces) / rest_areas(mesh)
    depth = -TriangleScene((surface, body_faces)).signed_distances(vertices)
    p99 = float(np.percentile(stretch, 99))
    crushed, over = int((area < AREA_LIMITS[0]).sum()), int((area > AREA_LIMITS[1]).sum())
    inside = 100 * float((depth > 0).mean())
    reasons = []
    if p99 > STRETCH_LIMIT:
        reasons.append(f"stretched: 99 % of edges within {p99:.2f} of their length")
    if inside > INSIDE_LIMIT_PERCENT:
        reasons.append(f"{inside:.2f} % of the vertices inside the body")
    if crushed + over > 0.001 * len(area):
        reasons.append(f"{crushed} faces crushed and {over} overstretched")
    return ClothQuality(p99, crushed, over, inside, tuple(reasons))


def principal_stretches(mesh: PanelMesh, vertices: np.ndarray) -> np.ndarray:
    """How much each face of a frame, (V, 3) metres, is longer than on the pattern: least and most over all directions.

    Returns:
        (F, 2), 1 where the face has its own size; the first column below 1 is compression in the cloth's plane.
    """
    rest = np.stack([mesh.uv[:, 1] - mesh.uv[:, 0], mesh.uv[:, 2] - mesh.uv[:, 0]], axis=2)
    corners = vertices.astype(np.float64)[mesh.faces]
    sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
    gradient = sides @ np.linalg.inv(rest)
    squared = np.linalg.eigvalsh(np.einsum("fca,fcb->fab", gradient, gradient))
    return np.sqrt(np.maximum(squared, 0))
