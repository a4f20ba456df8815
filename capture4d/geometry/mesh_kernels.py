"""Compiled loops over the faces of large scans: what `capture4d.geometry.mesh` does clearly, at a tenth of the time.

Plain arrays of float64 positions and int32 faces in, plain arrays out; nothing is checked. Loops run in a fixed order
on one thread, so that results never depend on the machine's load.
"""

from __future__ import annotations

import numpy as np

from capture4d.heavy_imports import njit

__all__ = [
    "face_components",
    "first_in_cells",
    "laplacian_pass",
    "mean_edge_length",
    "normals_of_some",
    "open_vertices",
    "vertex_normals_kernel",
]


@njit(cache=True)
def open_vertices(faces, count):
    """Vertices on an open edge, and vertices that any face uses.

    Around an inner vertex every neighbour is once the next and once the previous corner, so a sum of scrambled indices
    with alternating sign vanishes; no edge list is needed.
    """
    balance = np.zeros(count, np.int64)
    used = np.zeros(count, np.bool_)
    for f in range(len(faces)):
        for k in range(3):
            vertex, onward, back = faces[f, k], faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
            used[vertex] = True
            a = np.int64(onward) * np.int64(2654435761)
            b = np.int64(back) * np.int64(2654435761)
            balance[vertex] += (a ^ (a >> 17)) - (b ^ (b >> 17))
    return balance != 0, used


@njit(cache=True)
def mean_edge_length(positions, faces):
    """Mean length of one side of each face."""
    total = 0.0
    for f in range(len(faces)):
        a, b = faces[f, 0], faces[f, 1]
        square = 0.0
        for axis in range(3):
            square += (positions[b, axis] - positions[a, axis]) ** 2
        total += np.sqrt(square)
    return total / max(len(faces), 1)


@njit(cache=True)
def laplacian_pass(positions, faces, fixed):
    """Half a step towards the mean of the neighbours, each weighted by the faces it shares."""
    total = np.zeros_like(positions)
    weight = np.zeros(len(positions))
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        for axis in range(3):
            pa, pb, pc = positions[a, axis], positions[b, axis], positions[c, axis]
            total[a, axis] += pb + pc
            total[b, axis] += pc + pa
            total[c, axis] += pa + pb
        weight[a] += 2.0
        weight[b] += 2.0
        weight[c] += 2.0
    result = positions.copy()
    for v in range(len(positions)):
        if weight[v] > 0.0 and not fixed[v]:
            for axis in range(3):
                result[v, axis] = 0.5 * (positions[v, axis] + total[v, axis] / weight[v])
    return result


@njit(cache=True)
def vertex_normals_kernel(positions, faces):
    """Area-weighted unit normals; zero where there is no area."""
    result = np.zeros_like(positions)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = (
            positions[b, 0] - positions[a, 0],
            positions[b, 1] - positions[a, 1],
            positions[b, 2] - positions[a, 2],
        )
        wx, wy, wz = (
            positions[c, 0] - positions[a, 0],
            positions[c, 1] - positions[a, 1],
            positions[c, 2] - positions[a, 2],
        )
        nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        for v in (a, b, c):
            result[v, 0] += nx
            result[v, 1] += ny
            result[v, 2] += nz
    for v in range(len(positions)):
        length = np.sqrt(result[v, 0] ** 2 + result[v, 1] ** 2 + result[v, 2] ** 2)
        if length > 0.0:
            result[v, 0] /= length
            result[v, 1] /= length
            result[v, 2] /= length
    return result


@njit(cache=True)
def normals_of_some(positions, faces, some):
    """Area-weighted unit normals of some vertices, (len(some), 3); zero where there is no area."""
    place = np.full(len(positions), -1)
    for n in range(len(some)):
        place[some[n]] = n
    result = np.zeros((len(some), 3))
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if place[a] < 0 and place[b] < 0 and place[c] < 0:
            continue
        ox, oy, oz = np.float64(positions[a, 0]), np.float64(positions[a, 1]), np.float64(positions[a, 2])
        ux, uy, uz = positions[b, 0] - ox, positions[b, 1] - oy, positions[b, 2] - oz
        wx, wy, wz = positions[c, 0] - ox, positions[c, 1] - oy, positions[c, 2] - oz
        nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        for v in (a, b, c):
            n = place[v]
            if n >= 0:
                result[n, 0] += nx
                result[n, 1] += ny
                result[n, 2] += nz
    for n in range(len(some)):
        length = np.sqrt(result[n, 0] ** 2 + result[n, 1] ** 2 + result[n, 2] ** 2)
        if length > 0.0:
            for axis in range(3):
                result[n, axis] /= length
    return result


@njit(cache=True)
def first_in_cells(positions, candidates, size):
    """Of some vertices the first one in every cell of a grid, in their order.

    Args:
        size: edge of a cell. Cells that are 2^21 apart along an axis count as one.
    """
    slots = 16
    while slots < 2 * len(candidates):
        slots *= 2
    keys, taken = np.empty(slots, np.int64), np.zeros(slots, np.bool_)
    kept, count = np.empty(len(candidates), candidates.dtype), 0
    for n in range(len(candidates)):
        v = candidates[n]
        key = np.int64(0)
        for axis in range(3):
            key = (key << 21) | (np.int64(np.floor(np.float64(positions[v, axis]) / size)) & 0x1FFFFF)
        slot = ((key * np.int64(-7046029254386353131)) >> 20) & (slots - 1)
        while taken[slot] and keys[slot] != key:
            slot = (slot + 1) & (slots - 1)
        if not taken[slot]:
            taken[slot], keys[slot] = True, key
            kept[count] = v
            count += 1
    return kept[:count]


@njit(cache=True)
def face_components(faces, count, active):
    """The part each face belongs to, named by its smallest vertex; parts are joined by active faces, others get -1."""
    parent = np.arange(count)
    for f in range(len(faces)):
        if active[f]:
            for k in range(2):
                a, b = faces[f, k], faces[f, k + 1]
                while parent[a] != a:
                    parent[a] = parent[parent[a]]
                    a = parent[a]
                while parent[b] != b:
                    parent[b] = parent[parent[b]]
                    b = parent[b]
                if a < b:
                    parent[b] = a
                else:
                    parent[a] = b
    result = np.full(len(faces), -1)
    for f in range(len(faces)):
        if active[f]:
            a = faces[f, 0]
            while parent[a] != a:
                a = parent[a]
            result[f] = a
    return result
