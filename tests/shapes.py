"""Meshes that several tests are made on."""

import numpy as np

from capture4d.types import Mesh, Rig


def tube_faces(around: int, along: int) -> np.ndarray:
    """Faces (2 around (along - 1), 3) int32 between rings of vertices, ring after ring, wound outwards where rings rise
    along Y and turn from Z to X."""
    row, column = np.divmod(np.arange(around * (along - 1)), around)
    a, b = row * around + column, row * around + (column + 1) % around
    faces = np.concatenate([np.stack([a, b, b + around], 1), np.stack([a, b + around, a + around], 1)])
    return faces.astype(np.int32)


def tube(around: int, along: int, radius: float = 0.1, height: float = 0.5, start: float = 0.0) -> Mesh:
    """An open tube about Y, wound outwards, with UVs in metres."""
    angle = np.tile(2 * np.pi * np.arange(around) / around, along)
    level = np.repeat(np.linspace(start, start + height, along), around)
    vertices = np.stack([radius * np.sin(angle), level, radius * np.cos(angle)], axis=1)
    faces = tube_faces(around, along)
    uv = np.stack([radius * angle, level], axis=1)[faces]
    return Mesh(vertices.astype(np.float32), faces, uv.astype(np.float32))


def plane(size: float = 1.0, cells: int = 4, height: float = 0.0) -> Mesh:
    """A square in the xz plane, facing +Y."""
    side = np.linspace(0, size, cells + 1)
    x, z = (grid.ravel() for grid in np.meshgrid(side, side, indexing="ij"))
    vertices = np.column_stack([x, np.full(x.shape, height), z]).astype(np.float32)
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"))
    a = i * (cells + 1) + j
    b, c, d = a + 1, a + cells + 1, a + cells + 2
    return Mesh(vertices, np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]).astype(np.int32))


def ring(cameras: int = 12, radius: float = 2.5) -> Rig:
    """Cameras around the origin at shoulder height that look at it; a subject at the middle fills their images."""
    angle = 2 * np.pi * np.arange(cameras) / cameras
    T = np.tile(np.eye(4), (cameras, 1, 1))
    T[:, 0, :3] = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], 1)
    T[:, 1, :3] = (0, -1, 0)
    T[:, 2, :3] = np.stack([-np.sin(angle), 0 * angle, -np.cos(angle)], 1)
    T[:, :3, 3] = (0, 1.2, radius)
    K = np.array([[600.0, 0, 256], [0, 600, 256], [0, 0, 1]])
    sizes = np.full((cameras, 2), 513, np.int32)
    names = tuple(f"cam{index:02d}" for index in range(cameras))
    return Rig(names, np.tile(K, (cameras, 1, 1)), np.zeros((cameras, 5)), T, sizes)


def laid_flat(mesh: Mesh) -> np.ndarray:
    """UVs, (F, 3, 2) metres, in which every face lies by itself, as large as in the mesh."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.linalg.norm(first, axis=1)
    uv = np.zeros((len(corners), 3, 2), np.float32)
    uv[:, 1, 0] = length
    uv[:, 2, 0] = np.einsum("fc,fc->f", first, second) / length
    uv[:, 2, 1] = np.linalg.norm(np.cross(first, second), axis=1) / length
    return uv
