"""The nearest point of a surface to each of many points: exact, by ray casting's own tree."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32

from capture4d.geometry.ray_casting import TriangleScene, barycentric
from capture4d.types import Mesh

__all__ = ["closest_points", "surface_distances"]


def closest_points(
    mesh: Mesh, points: Float[np.ndarray, "points 3"]
) -> tuple[Float32[np.ndarray, "points 3"], Int32[np.ndarray, " points"], Float32[np.ndarray, "points 3"]]:
    """The nearest point of a surface to each point: its position, face and barycentric coordinates. Exact."""
    found = TriangleScene((mesh.vertices, mesh.faces), threads=0).nearest(points)
    return found.points, found.faces, barycentric(found.uv)


def surface_distances(mesh: Mesh, points: Float[np.ndarray, "points 3"]) -> Float64[np.ndarray, " points"]:
    """Distance of points to a surface, metres."""
    return np.linalg.norm(closest_points(mesh, points)[0].astype(float) - points, axis=1)
