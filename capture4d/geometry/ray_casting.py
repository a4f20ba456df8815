"""Rays and nearest points against triangles, by open3d's tree: exact, and the one door to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Integer

from capture4d.heavy_imports import import_open3d
from capture4d.types import Mesh

__all__ = ["Hits", "Nearest", "TriangleScene", "barycentric", "closest_points", "surface_distances"]


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """The nearest point of the triangles to each of many points."""

    points: Float32[np.ndarray, "points 3"]
    surfaces: Int32[np.ndarray, " points"]
    """Which of the scene's surfaces it is on."""
    faces: Int32[np.ndarray, " points"]
    """Counted from 0 in each surface."""
    uv: Float32[np.ndarray, "points 2"]
    """Its second and third barycentric coordinate."""
    normals: Float32[np.ndarray, "points 3"]
    """Unit normals of the faces."""


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What each of many rays meets first."""

    distance: Float32[np.ndarray, " rays"]
    """In lengths of the ray's direction; infinite where it meets nothing."""
    surfaces: Int32[np.ndarray, " rays"]
    """-1 where it meets nothing."""
    faces: Int32[np.ndarray, " rays"]
    """-1 where it meets nothing."""
    uv: Float32[np.ndarray, "rays 2"]
    normals: Float32[np.ndarray, "rays 3"]
    """Unit normals of the faces; they may look either way along the ray."""


class TriangleScene:
    """Triangles that are looked up as often as one likes.

    Args:
        surfaces: vertices and faces of each, at least one face in all.
        threads: that build the tree and answer; 0 for one a core.
    """

    def __init__(
        self, *surfaces: tuple[Float[np.ndarray, "_ 3"], Integer[np.ndarray, "_ 3"]], threads: int = 1
    ) -> None:
        self._threads = threads
        self._scene: Any = import_open3d().t.geometry.RaycastingScene(nthreads=threads)
        for vertices, faces in surfaces:
            self._scene.add_triangles(_tensor(vertices, np.float32), _tensor(faces, np.uint32))

    def nearest(self, points: Float[np.ndarray, "points 3"]) -> Nearest:
        found = self._scene.compute_closest_points(_tensor(points, np.float32), nthreads=self._threads)
        return Nearest(
            found["points"].numpy(),
            found["geometry_ids"].numpy().view(np.int32),
            found["primitive_ids"].numpy().view(np.int32),
            found["primitive_uvs"].numpy(),
            found["primitive_normals"].numpy(),
        )

    def cast(self, rays: Float[np.ndarray, "rays 6"]) -> Hits:
        """Args: rays: where each starts, and its direction."""
        found = self._scene.cast_rays(_tensor(rays, np.float32), nthreads=self._threads)
        return Hits(
            found["t_hit"].numpy(),
            found["geometry_ids"].numpy().view(np.int32),
            found["primitive_ids"].numpy().view(np.int32),
            found["primitive_uvs"].numpy(),
            found["primitive_normals"].numpy(),
        )

    def is_met(self, rays: Float[np.ndarray, "rays 6"], *, far: float = np.inf) -> Bool[np.ndarray, " rays"]:
        """Whether each ray meets anything nearer than `far` lengths of its direction."""
        return self._scene.test_occlusions(_tensor(rays, np.float32), tfar=far, nthreads=self._threads).numpy()

    def signed_distances(self, points: Float[np.ndarray, "points 3"]) -> Float32[np.ndarray, " points"]:
        """Distance to closed surfaces, metres, negative inside."""
        return self._scene.compute_signed_distance(_tensor(points, np.float32), nthreads=self._threads).numpy()


def barycentric(uv: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 3"]:
    """All three coordinates from the second and third."""
    return np.column_stack([1 - uv.sum(axis=1), uv])


def closest_points(
    mesh: Mesh, points: Float[np.ndarray, "points 3"]
) -> tuple[Float32[np.ndarray, "points 3"], Int32[np.ndarray, " points"], Float32[np.ndarray, "points 3"]]:
    """The nearest point of a surface to each point: its position, face and barycentric coordinates. Exact."""
    found = TriangleScene((mesh.vertices, mesh.faces), threads=0).nearest(points)
    return found.points, found.faces, barycentric(found.uv)


def surface_distances(mesh: Mesh, points: Float[np.ndarray, "points 3"]) -> Float64[np.ndarray, " points"]:
    """Distance of points to a surface, metres."""
    return np.linalg.norm(closest_points(mesh, points)[0].astype(float) - points, axis=1)


def _tensor(array: np.ndarray, dtype: type) -> Any:
    return import_open3d().core.Tensor(np.ascontiguousarray(array, dtype))
