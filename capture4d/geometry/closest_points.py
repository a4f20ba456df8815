"""The nearest point of a surface to each of many points: exact, by ray casting's own tree."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32

from capture4d.heavy_imports import import_open3d
from capture4d.types import Mesh

__all__ = ["closest_points", "surface_distances"]


def closest_points(
    mesh: Mesh, points: Float[np.ndarray, "points 3"]
) -> tuple[Float32[np.ndarray, "points 3"], Int32[np.ndarray, " points"], Float32[np.ndarray, "points 3"]]:
    """The nearest point of a surface to each point: its position, face and barycentric coordinates. Exact."""
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    answer = scene.compute_closest_points(o3d.core.Tensor(np.ascontiguousarray(points, np.float32)))
    uv = answer["primitive_uvs"].numpy()
    barycentric = np.column_stack([1 - uv.sum(axis=1), uv]).astype(np.float32)
    return answer["points"].numpy(), answer["primitive_ids"].numpy().astype(np.int32), barycentric


def surface_distances(mesh: Mesh, points: Float[np.ndarray, "points 3"]) -> Float64[np.ndarray, " points"]:
    """Distance of points to a surface, metres."""
    return np.linalg.norm(closest_points(mesh, points)[0].astype(float) - points, axis=1)
