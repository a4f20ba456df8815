"""How noisy a scan is, and how stiffly a template that ends on it should be held for that.

Each template vertex sees one point of the scan. Where points are a millimetre off, one by one, the template's own shape
knows better between them, and its bending is held so much more stiffly; where they are not, stiffness costs detail.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Integer

from capture4d.geometry.mesh_kernels import laplacian_pass, open_vertices, vertex_normals_kernel
from registration.config import RegistrationConfig

__all__ = ["held_against_noise", "roughness"]

OF_INDEPENDENT = 1.36
"""Standard deviation of heights over their neighbours, taken twice, where vertices with six neighbours each are off by
1 independently of each other."""
OF_MEDIAN = 1.4826
"""Standard deviation of a normal distribution over its median absolute value."""
STIFFER = 16e6
"""Weight of bending at the end, per square metre of noise. Chosen on four dressed people with 1 mm of it."""


def roughness(vertices: Float[np.ndarray, "verts 3"], faces: Integer[np.ndarray, "faces 3"]) -> float:
    """How far vertices are off their neighbours along the normal, standard deviation, metres: noise, and detail as fine
    as the mesh.

    Each height over the mean of the neighbours is taken over the neighbours' own such heights, so that what is evenly
    curved counts nothing. Vertices on open edges are left out. 0 where there are no others.
    """
    positions, triangles = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32)
    rim, used = open_vertices(triangles, len(positions))
    inside = used & ~rim
    if not inside.any():
        return 0.0
    nowhere = np.zeros(len(positions), bool)
    normals = vertex_normals_kernel(positions, triangles)
    height = 2.0 * np.einsum("va,va->v", positions - laplacian_pass(positions, triangles, nowhere), normals)
    height[~inside] = 0.0
    column = height[:, None].repeat(3, axis=1)
    over = 2.0 * (column - laplacian_pass(column, triangles, nowhere))[inside, 0]
    return OF_MEDIAN * float(np.median(np.abs(over))) / OF_INDEPENDENT


def held_against_noise(config: RegistrationConfig, scan: float, template: float) -> RegistrationConfig:
    """The same with the template's bending held more stiffly at the end of the dense stage.

    Args:
        scan, template: roughness of each, metres. What the template has of it is detail.
    """
    schedule = config.dense.cold
    first, last = schedule.smooth
    stiff = last + STIFFER * max(scan**2 - template**2, 0.0)
    cold = replace(schedule, smooth=(max(first, stiff), stiff))
    return replace(config, dense=replace(config.dense, cold=cold))
