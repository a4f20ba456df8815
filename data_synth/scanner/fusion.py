"""Depth images to a coloured mesh: truncated signed distances on a sparse voxel grid (Open3D's VoxelBlockGrid).

References: Curless and Levoy, A volumetric method for building complex models from range images (SIGGRAPH 1996).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from capture4d.heavy_imports import import_open3d
from capture4d.types import Mesh
from data_synth.scanner.config import FusionConfig

__all__ = ["DepthFusion", "canonical_order", "drop_small_components"]


class DepthFusion:
    """A growing volume of signed distances. Cameras are added one by one; `extract` returns the surface."""

    def __init__(self, voxel_m: float, expected_area_m2: float, *, config: FusionConfig) -> None:
        o3d = import_open3d()
        self._config = config
        # A surface through blocks of edge b touches about 2.5 of them per b^2; too many cost gigabytes of page faults,
        # too few a rehash.
        blocks = int(2.5 * expected_area_m2 / (config.block_resolution * voxel_m) ** 2) + 500
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            (o3d.core.float32,) * 3,
            ((1,), (1,), (3,)),
            voxel_size=voxel_m,
            block_resolution=config.block_resolution,
            block_count=blocks,
        )
        self._seen = False

    def add(
        self,
        depth: Float32[np.ndarray, "h w"],
        colours: Float32[np.ndarray, "h w 3"],
        intrinsics: Float[np.ndarray, "3 3"],
        T_camera_world: Float[np.ndarray, "4 4"],
    ) -> None:
        """Integrate one camera: depth in metres, 0 where there is none; colours 0 to 1; pixel centres at integers."""
        far = float(depth.max(initial=0)) * 1.01
        if far == 0:
            return
        o3d = import_open3d()
        # Open3D truncates projected coordinates to a pixel instead of rounding them: pixel centres at one half. Without
        # this shift the scan lies half a pixel off, which doubles its error.
        centred = intrinsics.copy()
        centred[:2, 2] += 0.5
        depth_image, colour_image, touched = (
            o3d.t.geometry.Image(o3d.core.Tensor.from_numpy(np.ascontiguousarray(image)))
            for image in (depth, colours, _pooled(depth))
        )
        K, T = o3d.core.Tensor(centred), o3d.core.Tensor(np.ascontiguousarray(T_camera_world))
        truncation = float(self._config.truncation_voxels)
        blocks = self._grid.compute_unique_block_coordinates(touched, K, T, 1.0, far, truncation)
        self._grid.integrate(blocks, depth_image, colour_image, K, K, T, 1.0, far, truncation)
        self._seen = True

    def extract(self) -> tuple[Mesh, UInt8[np.ndarray, "verts 3"]]:
        """The surface and its sRGB colours, without small pieces, in an order that depends on nothing but the shape."""
        if not self._seen:
            return Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)), np.zeros((0, 3), np.uint8)
        extracted = self._grid.extract_triangle_mesh(weight_threshold=self._config.min_weight)
        vertices = extracted.vertex.positions.numpy()
        colours = np.clip(extracted.vertex.colors.numpy() * 255 + 0.5, 0, 255).astype(np.uint8)
        faces = extracted.triangle.indices.numpy().astype(np.int32)
        vertices, faces, colours = drop_small_components(vertices, faces, colours, self._config.min_component_faces)
        vertices, faces, colours = canonical_order(vertices, faces, colours)
        return Mesh(vertices, faces), colours


def _pooled(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """The largest depth of each 4x4 cell at its first pixel, the only one Open3D reads when it allocates blocks."""
    height, width = (-(-size // 4) * 4 for size in depth.shape)
    padded = np.zeros((height, width), np.float32)
    padded[: depth.shape[0], : depth.shape[1]] = depth
    rows = np.maximum.reduce([padded[offset::4] for offset in range(4)])
    pooled = np.zeros_like(padded)
    pooled[::4, ::4] = np.maximum.reduce([rows[:, offset::4] for offset in range(4)])
    return pooled


def drop_small_components(
    vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray, min_faces: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mesh without connected pieces of fewer than `min_faces` faces, and without vertices that no face uses."""
    links = (np.ones(2 * len(faces), bool), (faces[:, :2].T.ravel(), faces[:, 1:].T.ravel()))
    _, component = connected_components(coo_array(links, shape=(len(vertices),) * 2), directed=False)
    component = component[faces[:, 0]]
    faces = faces[np.bincount(component, minlength=1)[component] >= min_faces]
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    return vertices[used], (np.cumsum(used) - 1).astype(np.int32)[faces], colours[used]


def canonical_order(
    vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices sorted by position; faces rotated to start at their smallest vertex, then sorted.

    The voxel grid is a concurrent hash map, so the order in which it yields vertices and faces changes from run to
    run; their values do not.
    """
    order = np.lexsort((*colours.T, *vertices.T[::-1]))
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    faces = rank[faces]
    start = faces.argmin(axis=1)[:, None]
    faces = np.take_along_axis(faces, (start + np.arange(3)) % 3, axis=1)
    return vertices[order], faces[np.lexsort(faces.T[::-1])], colours[order]
