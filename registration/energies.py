"""Terms of the registration energy, linearised at the current state (DeepWrinkles, ECCV 2018, Eq. 1).

Metrics and residuals for `registration.solver`. Every function takes the weight of the whole term and divides it among
the rows, so that a term is a mean of squares times its weight, in m^2.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int32

from capture4d.heavy_imports import njit
from registration.solver import BlockTerm, EdgeTerm

__all__ = ["edge_vectors", "plane_metric", "rigid_term", "stretch_metric", "stretch_term", "tangential_metric"]


def plane_metric(
    normals: Float64[np.ndarray, "rows 3"], weights: Float64[np.ndarray, " rows"], point_share: float
) -> Float64[np.ndarray, "rows 3 3"]:
    """w ((1 - p) n n^T + p I): distance to the plane, and with p > 0 a share of the distance to the point."""
    metric = ((1.0 - point_share) * weights)[:, None, None] * (normals[:, :, None] * normals[:, None, :])
    if point_share > 0.0:
        metric += (point_share * weights)[:, None, None] * np.eye(3)
    return metric


def tangential_metric(
    normals: Float64[np.ndarray, "rows 3"], weights: Float64[np.ndarray, " rows"]
) -> Float64[np.ndarray, "rows 3 3"]:
    """w (I - n n^T): distance along the surface only."""
    return weights[:, None, None] * (np.eye(3) - normals[:, :, None] * normals[:, None, :])


def rigid_term(nodes: Float64[np.ndarray, "nodes 3 4"], *, weight: float, spacing: float) -> BlockTerm:
    """E_rigid of embedded deformation: |A^T A - I|^2, over the columns of A the six products that a rotation fixes.

    Sumner et al. 2007 count each of the three mixed products once, which makes the energy depend on the axes of the
    world; both of its places in A^T A are counted here.

    Args:
        weight: of the mean over nodes, after multiplication by `spacing` squared.
        spacing: node spacing, metres, which gives the term the unit of the others.
    """
    hessian, gradient = rigid_kernel(nodes, weight * spacing**2 / len(nodes))
    return BlockTerm(hessian, gradient)


def stretch_metric(
    ends: Float64[np.ndarray, "edges 3"],
    rest_lengths: Float64[np.ndarray, " edges"],
    *,
    weight: float,
    compression: float,
) -> tuple[Float64[np.ndarray, "edges 3 3"], Float64[np.ndarray, "edges 3"]]:
    """Edge lengths against the template's: metric w e e^T and residual (|d| - rest) e, e the edge's direction.

    Args:
        ends: end minus start of each edge, metres.
        compression: share of the weight for edges that are shorter than at rest.
    """
    return stretch_kernel(ends, rest_lengths, weight / max(len(ends), 1), compression)


def stretch_term(
    vertices: Float64[np.ndarray, "verts 3"],
    edges: Int32[np.ndarray, "edges 2"],
    rest_lengths: Float64[np.ndarray, " edges"],
    *,
    weight: float,
    compression: float,
) -> EdgeTerm:
    """`stretch_metric` of free vertices, without matrices: edge lengths against the template's."""
    return EdgeTerm(edges, *edges_kernel(vertices, edges, rest_lengths, weight / max(len(edges), 1), compression))


@njit(cache=True)
def edges_kernel(vertices, edges, rest, weight, compression):
    count = len(edges)
    directions, residual = np.zeros((count, 3)), np.zeros(count)
    for e in range(count):
        a, b = edges[e, 0], edges[e, 1]
        x, y, z = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        length = np.sqrt(x * x + y * y + z * z)
        if length == 0.0:
            continue
        excess = length - rest[e]
        root = np.sqrt(weight if excess > 0.0 else weight * compression)
        residual[e] = root * excess
        directions[e, 0], directions[e, 1], directions[e, 2] = root * x / length, root * y / length, root * z / length
    return directions, residual


@njit(cache=True)
def stretch_kernel(ends, rest, weight, compression):
    count = len(ends)
    metric, residual = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for e in range(count):
        length = np.sqrt(ends[e, 0] ** 2 + ends[e, 1] ** 2 + ends[e, 2] ** 2)
        if length == 0.0:
            continue
        excess = length - rest[e]
        w = weight if excess > 0.0 else weight * compression
        for i in range(3):
            residual[e, i] = excess * ends[e, i] / length
            for j in range(3):
                metric[e, i, j] = w * ends[e, i] * ends[e, j] / (length * length)
    return metric, residual


@njit(cache=True)
def rigid_kernel(nodes, weight):
    count = len(nodes)
    hessian, gradient = np.zeros((count, 12, 12)), np.zeros((count, 12))
    jacobian, residual = np.zeros((6, 12)), np.zeros(6)
    left, right = (0, 0, 1, 0, 1, 2), (1, 2, 2, 0, 1, 2)
    for n in range(count):
        a = nodes[n]
        jacobian[:] = 0.0
        for row in range(6):
            c, d = left[row], right[row]
            product = 0.0
            for i in range(3):
                product += a[i, c] * a[i, d]
                jacobian[row, 4 * i + c] += a[i, d]
                jacobian[row, 4 * i + d] += a[i, c]
            residual[row] = product - (1.0 if c == d else 0.0)
            if c != d:
                residual[row] *= np.sqrt(2.0)
                jacobian[row] *= np.sqrt(2.0)
        for row in range(6):
            for i in range(12):
                ji = jacobian[row, i]
                if ji != 0.0:
                    gradient[n, i] += weight * ji * residual[row]
                    for j in range(12):
                        hessian[n, i, j] += weight * ji * jacobian[row, j]
    return hessian, gradient


def edge_vectors(
    vertices: Float64[np.ndarray, "verts 3"], edges: Int32[np.ndarray, "edges 2"]
) -> Float64[np.ndarray, "edges 3"]:
    """End minus start of each edge."""
    return vertices[edges[:, 1]] - vertices[edges[:, 0]]
