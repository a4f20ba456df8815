"""A surface for scans without faces: triangles between neighbouring points, none across a hole.

Normals come from each point's neighbours and are turned alike along the surface, then outwards. A ball then rolls over
the points (ball pivoting) and leaves a triangle wherever it rests on three of them; through a hole that is wider than
the ball it falls. The points themselves stay where they are.

References: Hoppe et al., Surface Reconstruction from Unorganized Points (SIGGRAPH 1992); Bernardini et al., The
Ball-Pivoting Algorithm for Surface Reconstruction (IEEE TVCG 1999). Both as open3d has them.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, Int32, Int64
from scipy.spatial import KDTree

from capture4d.errors import InputError
from capture4d.geometry.mesh import doubled_area_vectors
from capture4d.heavy_imports import import_open3d

__all__ = ["faces_between"]

LEAST_POINTS = 100
"""Fewer are no scan of anything."""
NEIGHBOURS = 16
"""Points that tell a normal."""
SPACING_NEIGHBOUR = 6
"""A sample's distance to this neighbour is the spacing of the samples: on a surface six lie around each."""
PASSES = 2
"""How often points are drawn to the plane of their neighbours before the ball rolls. It falls through noise: of a
sphere whose points are off by a quarter of their distance a quarter is left out without, one in 6,000 after two."""
BALL_RADII = (1.0, 1.5)
"""Of the ball, in spacings, one after the other."""
UNEVEN = 1e-3
"""Points are moved by so many spacings before the ball rolls: on an even grid it touches four at once, and stops."""
CROWD = 300
"""Points within the largest ball's width, in the mean, beyond which those that share a cell of one spacing are left
out: a surface has 60 there. The ball tries every two of them, which took minutes for 50,000 points around a few places.
"""
_AT_ONCE = 100_000


def faces_between(points: Float[np.ndarray, "V 3"]) -> Int32[np.ndarray, "F 3"]:
    """Triangles between the points of a cloud, seen counter-clockwise from outside; points may be left over.

    Raises:
        InputError: the points are too few, or lie on no surface.
    """
    places, first = np.unique(points, axis=0, return_index=True)
    if len(places) < LEAST_POINTS:
        raise InputError(
            f"expected a mesh, or a cloud of at least {LEAST_POINTS} points; found no faces, and {len(places)} points"
        )
    places = places.astype(np.float64)
    reach = KDTree(places).query(places, k=SPACING_NEIGHBOUR + 1)[0][:, -1]
    spacing = float(np.median(reach))
    size = float(np.linalg.norm(np.ptp(places, axis=0)))
    if not spacing > 1e-9 * size:
        raise InputError(f"expected the points of a surface, found most of {len(places)} in one place")
    places = (places - places.mean(axis=0)) / spacing
    spread = _spread(places)
    places, first = places[spread], first[spread]
    geometry, utility = import_open3d().geometry, import_open3d().utility
    extents = np.linalg.svd(places[:: max(1, len(places) // 1000)], compute_uv=False)
    if extents[1] < 1e-3 * extents[0]:
        raise InputError(f"expected the points of a surface, found {len(places)} in a line")
    shaken = _smoothed(places) + UNEVEN * np.random.default_rng(0).standard_normal(places.shape)
    cloud = geometry.PointCloud(utility.Vector3dVector(shaken))
    cloud.estimate_normals(geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    cloud.orient_normals_consistent_tangent_plane(NEIGHBOURS)
    surface = geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, utility.DoubleVector(BALL_RADII))
    faces = np.asarray(surface.triangles).reshape(-1, 3)
    if not len(faces):
        raise InputError(f"expected the points of a surface, found {len(places)} that lie on none")
    if _outwardness(places, faces) < 0:
        faces = faces[:, ::-1]
    return first[faces].astype(np.int32)


def _spread(points: Float64[np.ndarray, "V 3"]) -> Int64[np.ndarray, " kept"]:
    """All points, or one in each cell where they crowd."""
    some = points[:: max(1, len(points) // 1000)]
    near = KDTree(points).query_ball_point(some, 2 * max(BALL_RADII), return_length=True)
    if np.mean(near) <= CROWD:
        return np.arange(len(points))
    return np.sort(np.unique(np.floor(points), axis=0, return_index=True)[1])


def _outwardness(points: np.ndarray, faces: np.ndarray) -> float:
    """Positive where most of the area looks away from the middle: people are convex enough for that."""
    corners = points[faces]
    centres, areas = corners.mean(axis=1), doubled_area_vectors(points, faces)
    size = np.linalg.norm(areas, axis=1, keepdims=True)
    middle = (size * centres).sum(axis=0) / max(float(size.sum()), 1e-300)
    return float(((centres - middle) * areas).sum())


def _smoothed(points: Float64[np.ndarray, "V 3"]) -> Float64[np.ndarray, "V 3"]:
    """Each point on the plane through its neighbours."""
    for _ in range(PASSES):
        tree, moved = KDTree(points), np.empty_like(points)
        for start in range(0, len(points), _AT_ONCE):
            own = points[start : start + _AT_ONCE]
            near = points[tree.query(own, k=NEIGHBOURS)[1]]
            middle = near.mean(axis=1)
            offset = near - middle[:, None]
            normal = np.linalg.eigh(np.einsum("pni,pnj->pij", offset, offset))[1][:, :, 0]
            height = np.einsum("pi,pi->p", own - middle, normal)
            moved[start : start + _AT_ONCE] = own - height[:, None] * normal
        points = moved
    return points
