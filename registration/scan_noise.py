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

PASSES = 6
"""How often heights are taken over their neighbours. Noise stays; folds fall each time by as much as they are longer
than the mesh is coarse: of clean ones, 60 mm long and 6 mm high, two leave 1.0 mm where the spacing is 16 mm, six
0.1."""
OF_INDEPENDENT = 4.5
"""Standard deviation of such heights, where vertices with six neighbours each are off by 1 independently of each
other."""
OF_MEDIAN = 1.4826
"""Standard deviation of a normal distribution over its median absolute value."""
STIFFER = 16e6
"""Weight of bending at the end, per square metre of noise. Chosen on four dressed people with 1 mm of it."""
MOST = 0.0012
"""Noise, metres, beyond which nothing is held more stiffly: it may as well be shape, and the weight was tried up to
here alone."""


def roughness(vertices: Float[np.ndarray, "verts 3"], faces: Integer[np.ndarray, "faces 3"]) -> float:
    """How far vertices are off their neighbours along the normal, standard deviation, metres: noise, and detail as fine
    as the mesh.

    Each height over the mean of the neighbours is taken over the neighbours' own such heights, and so on, so that what
    is curved, or folded, as slowly as the mesh can show counts next to nothing. Vertices on open edges are left out.
    0 where there are no others.
    """
    positions, triangles = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32)
    rim, used = open_vertices(triangles, len(positions))
    inside = used & ~rim
    if not inside.any():
        return 0.0
    nowhere = np.zeros(len(positions), bool)
    normals = vertex_normals_kernel(positions, triangles)
    height = 2.0 * np.einsum("va,va->v", positions - laplacian_pass(positions, triangles, nowhere), normals)
    for _ in range(PASSES - 1):
        height[~inside] = 0.0
        column = height[:, None].repeat(3, axis=1)
        height = 2.0 * (column - laplacian_pass(column, triangles, nowhere))[:, 0]
    return OF_MEDIAN * float(np.median(np.abs(height[inside]))) / OF_INDEPENDENT


def held_against_noise(config: RegistrationConfig, scan: float, template: float) -> RegistrationConfig:
    """The same with the template's bending held more stiffly at the end of the dense stage.

    Args:
        scan, template: roughness of each, metres. What the template has of it is detail.
    """
    schedule = config.dense.cold
    first, last = schedule.smooth
    stiff = last + STIFFER * min(max(scan**2 - template**2, 0.0), MOST**2)
    cold = replace(schedule, smooth=(max(first, stiff), stiff))
    return replace(config, dense=replace(config.dense, cold=cold))
