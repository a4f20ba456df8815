"""Dirichlet forms on triangle meshes, and the smooth functions that given values on a cage extend to.

The form of linear functions f on a flattened mesh is E(f) = f^T L f, with L = sum over faces of A G^T K G: area A,
gradients G of the hat functions, conductivity K. With K = 1 L is the cotangent Laplacian, and the minimum of E under
given values is harmonic; with another K values run farther along one direction, as folds do. L 1 = 0 whatever K is, so
that basis functions, each 1 at one cage vertex and 0 at the others, sum to 1.

Isotropic functions keep within the values they are given where every angle opposite an inner edge adds up to at most
180 degrees with its fellow (Delaunay); anisotropic ones where that holds of the stretched triangles, which it rarely
does: they may undershoot.

Letters: V vertices, F faces, C cage vertices.

References: Pinkall and Polthier, Computing discrete minimal surfaces and their conjugates, 1993; Jin et al., A
pixel-based framework for data-driven clothing, SCA 2020, appendix C.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, Integer
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import splu

from capture4d.errors import InputError

__all__ = ["Extension", "conductivity_along", "dirichlet_form", "flattened"]

NO_AREA = 1e-9
"""A face with a smaller share of the mean area has no usable gradient and counts as an equilateral one."""


def flattened(vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"]) -> Float64[np.ndarray, "F 3 2"]:
    """Every face in a plane of its own, its first edge along x: what a mesh has instead of a pattern."""
    corner, along, across = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    first, second = along - corner, across - corner
    length = np.linalg.norm(first, axis=1)
    safe = np.maximum(length, 1e-300)
    flat = np.zeros((len(faces), 3, 2))
    flat[:, 1, 0] = length
    flat[:, 2, 0] = np.einsum("fa,fa->f", first, second) / safe
    flat[:, 2, 1] = np.linalg.norm(np.cross(first, second), axis=1) / safe
    return flat


def conductivity_along(direction: Float[np.ndarray, "2"], ratio: float) -> Float64[np.ndarray, "2 2"]:
    """Symmetric tensor that conducts so many times better along a direction of the flat faces than across it."""
    along = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    return np.eye(2) + (ratio - 1.0) * np.outer(along, along)


def dirichlet_form(
    faces: Integer[np.ndarray, "F 3"],
    flat: Float[np.ndarray, "F 3 2"],
    count: int,
    *,
    conductivity: Float[np.ndarray, "*F 2 2"] | None = None,
) -> sparse.csc_array:
    """The matrix L of the form, (V, V), symmetric and positive semi-definite.

    Args:
        flat: corners of the faces in the plane, lengths true: UVs of a sewing pattern, or `flattened`.
        count: V.
        conductivity: one symmetric tensor for all faces or one for each, in the axes of `flat`; None is isotropic.
    """
    corners = np.asarray(flat, np.float64)
    doubled = _doubled_areas(corners)
    scale = np.abs(doubled).mean() if len(doubled) else 0.0
    bad = np.abs(doubled) <= NO_AREA * scale
    if bad.any():
        corners = corners.copy()
        corners[bad] = np.sqrt(max(scale, 1e-300)) * np.array([[0.0, 0.0], [1.0, 0.0], [0.5, np.sqrt(0.75)]])
        doubled = _doubled_areas(corners)
    opposite = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
    gradients = np.stack([-opposite[..., 1], opposite[..., 0]], axis=-1) / doubled[:, None, None]
    tensor = np.eye(2) if conductivity is None else np.asarray(conductivity, np.float64)
    tensor = np.broadcast_to(tensor, (len(faces), 2, 2))
    local = np.abs(doubled / 2)[:, None, None] * np.einsum("fia,fab,fjb->fij", gradients, tensor, gradients)
    rows, columns = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, (1, 3)).ravel()
    return sparse.csc_array((local.ravel(), (rows, columns)), shape=(count, count))


class Extension:
    """Values on a cage extended over the surface with the least Dirichlet energy; factorised once.

    Args:
        form: L.
        cage: the vertices whose values are given, each once.
    Raises:
        InputError: a part of the surface holds no cage vertex, so that nothing says what its values are.
    """

    def __init__(self, form: sparse.csc_array, cage: Integer[np.ndarray, " C"]) -> None:
        self.count = len(form.diagonal())
        self.cage = np.asarray(cage, np.int64)
        inside = np.ones(self.count, bool)
        inside[self.cage] = False
        parts = csgraph.connected_components(form, directed=False)[1]
        loose = ~np.isin(parts, parts[self.cage])
        if loose.any():
            raise InputError(f"cage: expected it to touch every part of the surface, found {int(loose.sum())} vertices "
                             "in parts without it")  # fmt: skip
        self.inside = np.flatnonzero(inside)
        rows = form[self.inside]
        self._to_cage = sparse.csc_array(rows[:, self.cage])
        self._solve = splu(sparse.csc_matrix(rows[:, self.inside])).solve if len(self.inside) else None

    def __call__(self, values: Float[np.ndarray, "C channels"]) -> Float64[np.ndarray, "V channels"]:
        """Values at all vertices."""
        filled = np.empty((self.count, values.shape[1]))
        filled[self.cage] = values
        if self._solve is not None:
            filled[self.inside] = self._solve(-(self._to_cage @ np.asarray(values, np.float64)))
        return filled

    def bases(self) -> Float64[np.ndarray, "V C"]:
        """The basis functions: column c is 1 at cage vertex c and 0 at the others. A dense matrix."""
        return self(np.eye(len(self.cage)))


def _doubled_areas(corners: np.ndarray) -> np.ndarray:
    along, across = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
