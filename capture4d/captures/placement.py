"""How file coordinates become metres with Y up and the floor at 0."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64

from capture4d.types import Mesh, Rig

__all__ = ["Placement", "place", "place_rig"]


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """How file coordinates become metres with Y up and the floor at 0."""

    scale: float = 1.0
    axes: Float64[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    """Signed permutation of the axes; determinant -1 mirrors."""
    flip: bool = False
    """The faces wind the wrong way round in the file's own axes."""
    lift_m: float = 0.0

    @property
    def mirrors(self) -> bool:
        return bool(np.linalg.det(self.axes) < 0)

    @property
    def moves(self) -> bool:
        """Anything changes but the scale."""
        return bool(self.flip or self.lift_m or (self.axes != np.eye(3)).any())


def place(mesh: Mesh, placement: Placement) -> Mesh:
    """The mesh in metres, Y up, its faces wound as seen from outside."""
    transform = (placement.scale * placement.axes).astype(np.float32)
    vertices = mesh.vertices @ transform.T + np.array([0, placement.lift_m, 0], np.float32)
    if not placement.flip:
        return Mesh(vertices, mesh.faces, mesh.uv)
    uv = None if mesh.uv is None else np.ascontiguousarray(mesh.uv[:, ::-1])
    return Mesh(vertices, np.ascontiguousarray(mesh.faces[:, ::-1]), uv)


def place_rig(rig: Rig, placement: Placement, *, scale: float = 1.0) -> Rig:
    """The rig moved with its scans: `scale` is that of the coordinates of the rig, metres if 1.

    A mirrored world has no cameras, so a mirroring placement leaves the rig alone.
    """
    if placement.mirrors:
        return rig
    T = rig.T_camera_world.copy()
    rotation = T[:, :3, :3] @ placement.axes.T
    moved = scale * rig.centres @ placement.axes.T + (0, placement.lift_m, 0)
    T[:, :3, :3] = rotation
    T[:, :3, 3] = -np.einsum("cab,cb->ca", rotation, moved)
    return replace(rig, T_camera_world=T)
