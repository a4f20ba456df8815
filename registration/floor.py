"""A floor or a wall that was scanned with the thing: the largest plane, if the thing is on one side of it and the plane
ends outside of what stands on it. The seat of a sofa and the front of a shirt do not."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Integer
from scipy.spatial import ConvexHull, Delaunay, KDTree, QhullError

from registration.approach import spread_evenly
from registration.correspondences import mesh_normals

__all__ = ["find_floor"]

SAMPLES = 4000
TRIED = 100
"""Places whose surroundings are tried as the plane. All miss one with a twentieth of the surface once in 170 times."""
AROUND_M = 0.1
"""Radius of such surroundings, of a template of 1.2 m; and how near a plane what stands on it is."""
FLAT_M = 0.008
"""What lies this near a plane belongs to it: noise, and the warp of a real floor."""
FACING = 0.8
"""Least cosine between the normal of a point of the plane and the plane's."""
LEAST_SHARE, MOST_SHARE = 0.05, 0.8
"""Of the scan's surface that a floor is. The thing has to be there as well."""
ONE_SIDE = 0.98
"""Share of the thing that is on the side that the plane faces."""
OUTSIDE = 0.5
"""Share of the plane outside of what stands on it."""


def find_floor(
    vertices: Float64[np.ndarray, "verts 3"], faces: Integer[np.ndarray, "faces 3"]
) -> Bool[np.ndarray, " verts"] | None:
    """Which vertices lie on the floor or beyond it; None where there is none.

    Args:
        vertices: brought to the size of a template of 1.2 m.
    """
    normals = mesh_normals(vertices, np.asarray(faces, np.int32))
    chosen = spread_evenly(vertices, SAMPLES)
    chosen = chosen[np.linalg.norm(normals[chosen], axis=1) > 0.5]  # vertices without faces have no normal
    points, facing = vertices[chosen], normals[chosen]
    if len(points) < 10:
        return None
    centre, normal = _largest_plane(points, facing)
    height = (points - centre) @ normal
    on_plane = (np.abs(height) < FLAT_M) & (facing @ normal > FACING)
    thing = np.abs(height) >= FLAT_M
    if not LEAST_SHARE <= on_plane.mean() <= MOST_SHARE or not thing.any():
        return None
    if (height[thing] > 0.0).mean() < ONE_SIDE or not _ends_outside(points, height, on_plane, thing, normal):
        return None
    return (vertices - centre) @ normal < FLAT_M


def _largest_plane(
    points: Float64[np.ndarray, "points 3"], facing: Float64[np.ndarray, "points 3"]
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """A point and the unit normal of the plane that most points lie on, and look along."""
    picked = np.random.default_rng(0).permutation(len(points))[:TRIED]
    best, most = (points[0], facing[0]), -1
    for place, near in zip(picked, KDTree(points).query_ball_point(points[picked], AROUND_M), strict=True):
        around = np.array(near)
        own = around[facing[around] @ facing[place] > 0.5]
        for _ in range(3):  # the surroundings, then all that lies on the plane, which tells it better
            if len(own) < 3:
                break
            centre = points[own].mean(axis=0)
            normal = np.linalg.eigh(np.cov((points[own] - centre).T))[1][:, 0]
            normal *= np.sign(normal @ facing[own].mean(axis=0)) or 1.0
            own = np.flatnonzero((np.abs((points - centre) @ normal) < FLAT_M) & (facing @ normal > FACING))
            if len(own) > most:
                best, most = (centre, normal), len(own)
    return best


def _ends_outside(
    points: np.ndarray, height: np.ndarray, on_plane: np.ndarray, thing: np.ndarray, normal: np.ndarray
) -> bool:
    """Whether most of the plane is not under what stands on it, nor between its feet."""
    across = np.linalg.svd(normal[None])[2][1:]
    feet = points[thing & (np.abs(height) < AROUND_M)] @ across.T
    floor = points[on_plane] @ across.T
    if len(feet) < 4:
        return True  # nothing stands on it: a wall
    try:
        inside = Delaunay(feet[ConvexHull(feet).vertices]).find_simplex(floor) >= 0
    except QhullError:  # the feet are one line
        return True
    return float((~inside).mean()) > OUTSIDE
