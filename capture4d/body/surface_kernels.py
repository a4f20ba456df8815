"""Compiled loops of `posed_surface`, whose letters they share: skinning, nearest samples, and rows of derivatives.

Plain arrays in, plain arrays out; nothing is checked. One thread, in a fixed order.
"""

from __future__ import annotations

import numpy as np

from capture4d.heavy_imports import njit

__all__ = ["add_up_rows", "fill_rows", "nearest_samples", "skin_sparse", "spread_samples"]


@njit(cache=True)
def skin_sparse(rest, joints, weights, transforms):
    """Linear blend skinning with the few joints that each vertex has."""
    result = np.zeros((len(rest), 3))
    for v in range(len(rest)):
        for k in range(joints.shape[1]):
            w = weights[v, k]
            if w == 0.0:
                break
            j = joints[v, k]
            for a in range(3):
                result[v, a] += w * (
                    transforms[j, a, 0] * rest[v, 0]
                    + transforms[j, a, 1] * rest[v, 1]
                    + transforms[j, a, 2] * rest[v, 2]
                    + transforms[j, a, 3]
                )
    return result


@njit(cache=True)
def spread_samples(vertices, normals, faces, face_of, barycentric):
    """Points on faces, and the normals of the corners blended there, shorter than one where these differ."""
    places = np.zeros((len(face_of), 3))
    directions = np.zeros((len(face_of), 3))
    for i in range(len(face_of)):
        for corner in range(3):
            v, share = faces[face_of[i], corner], barycentric[i, corner]
            for a in range(3):
                places[i, a] += share * vertices[v, a]
                directions[i, a] += share * normals[v, a]
    return places, directions


@njit(cache=True)
def nearest_samples(points, normals, count, reach, origin, cell, shape, starts, samples, directions):
    """The nearest samples of each point, nearest first, by distance and difference of the normals:
    |p - q|^2 + reach^2 |n - m|^2.

    Args:
        origin, cell, shape, starts, samples: of a `PointGrid` of the samples.
        directions: (samples, 3) normals, in the order of the grid.
    Returns:
        (points, count), places in the order of the grid.
    """
    x, y, z = shape
    nearly = cell * (1.0 - 1e-9)  # a sample may lie beyond its cell by what rounding does
    found = np.zeros((len(points), count), np.int64)
    costs = np.empty(count)
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        nx, ny, nz = normals[n, 0], normals[n, 1], normals[n, 2]
        u, v, w = (px - origin[0]) / cell, (py - origin[1]) / cell, (pz - origin[2]) / cell
        i0, j0, k0 = np.int64(np.floor(u)), np.int64(np.floor(v)), np.int64(np.floor(w))
        inset = min(u - i0, v - j0, w - k0, i0 + 1 - u, j0 + 1 - v, k0 + 1 - w)
        first = max(-i0, i0 - x + 1, -j0, j0 - y + 1, -k0, k0 - z + 1, 0)
        last = max(i0, x - 1 - i0, j0, y - 1 - j0, k0, z - 1 - k0)
        costs[:] = np.inf
        for shell in range(first, last + 1):
            if shell > 0 and ((shell - 1 + inset) * nearly) ** 2 > costs[count - 1]:
                break
            for i in range(max(i0 - shell, 0), min(i0 + shell, x - 1) + 1):
                for j in range(max(j0 - shell, 0), min(j0 + shell, y - 1) + 1):
                    whole = shell == 0 or abs(i - i0) == shell or abs(j - j0) == shell
                    beside = max(i - u, u - i - 1, 0.0) ** 2 + max(j - v, v - j - 1, 0.0) ** 2
                    if beside * nearly**2 > costs[count - 1]:
                        continue
                    for k in range(k0 - shell, k0 + shell + 1, 1 if whole else 2 * shell):
                        if k < 0 or k >= z:
                            continue
                        if (beside + max(k - w, w - k - 1, 0.0) ** 2) * nearly**2 > costs[count - 1]:
                            continue
                        at = (i * y + j) * z + k
                        for s in range(starts[at], starts[at + 1]):
                            cost = (px - samples[s, 0]) ** 2 + (py - samples[s, 1]) ** 2 + (pz - samples[s, 2]) ** 2
                            if cost >= costs[count - 1]:
                                continue
                            apart = (nx - directions[s, 0]) ** 2 + (ny - directions[s, 1]) ** 2
                            cost += reach**2 * (apart + (nz - directions[s, 2]) ** 2)
                            place = count
                            while place > 0 and cost < costs[place - 1]:
                                place -= 1
                            for later in range(count - 1, place, -1):
                                costs[later], found[n, later] = costs[later - 1], found[n, later - 1]
                            if place < count:
                                costs[place], found[n, place] = cost, s
    return found


@njit(cache=True, inline="always")
def one_row(
    i, faces_of, barycentric, normals, faces, rest, joints, weights, directions, transforms, centres, offsets,
    parent_world, parents, members, begin, end, moment, share, shapes, row,
):  # fmt: skip
    """Derivative of n . p of one point: three entries of the translation, those of the shape, three of each joint.

    Args:
        members, begin, end: where the joints above the point stand, children first.
        moment, share: (J, 3) and (J,), zero; they are left so.
        shapes: how many entries of the shape are wanted: all or none.
        row: to be filled.
    """
    nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
    row[0], row[1], row[2] = nx, ny, nz
    for s in range(shapes):
        row[3 + s] = 0.0
    for corner in range(3):
        v = faces[faces_of[i], corner]
        bx, by, bz = 0.0, 0.0, 0.0
        x, y, z = rest[v, 0], rest[v, 1], rest[v, 2]
        for k in range(joints.shape[1]):
            if weights[v, k] == 0.0:
                break
            w = weights[v, k] * barycentric[i, corner]
            j = joints[v, k]
            for a in range(3):
                moment[j, a] += w * (
                    transforms[j, a, 0] * x + transforms[j, a, 1] * y + transforms[j, a, 2] * z + transforms[j, a, 3]
                )
            share[j] += w
            bx += w * (transforms[j, 0, 0] * nx + transforms[j, 1, 0] * ny + transforms[j, 2, 0] * nz)
            by += w * (transforms[j, 0, 1] * nx + transforms[j, 1, 1] * ny + transforms[j, 2, 1] * nz)
            bz += w * (transforms[j, 0, 2] * nx + transforms[j, 1, 2] * ny + transforms[j, 2, 2] * nz)
        for s in range(shapes):
            row[3 + s] += bx * directions[v, 0, s] + by * directions[v, 1, s] + bz * directions[v, 2, s]
    for member in range(begin, end):
        j = members[member]
        if share[j] != 0.0:
            for s in range(shapes):
                row[3 + s] += share[j] * (nx * offsets[j, 0, s] + ny * offsets[j, 1, s] + nz * offsets[j, 2, s])
    at = 3 + shapes
    for member in range(begin, end):
        j = members[member]
        ax = moment[j, 0] - share[j] * centres[j, 0]
        ay = moment[j, 1] - share[j] * centres[j, 1]
        az = moment[j, 2] - share[j] * centres[j, 2]
        tx, ty, tz = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
        for a in range(3):
            row[at + a] = parent_world[j, 0, a] * tx + parent_world[j, 1, a] * ty + parent_world[j, 2, a] * tz
        at += 3
        above = parents[j]
        if above >= 0:
            share[above] += share[j]
            for a in range(3):
                moment[above, a] += moment[j, a]
        share[j] = 0.0
        for a in range(3):
            moment[j, a] = 0.0
    return at


@njit(cache=True)
def columns_of(members, begin, end, shapes, first_shape, columns):
    """Which parameter each entry of a row belongs to."""
    for a in range(3):
        columns[a] = a
    for s in range(shapes):
        columns[3 + s] = first_shape + s
    for n in range(end - begin):
        for a in range(3):
            columns[3 + shapes + 3 * n + a] = 3 + 3 * members[begin + n] + a


@njit(cache=True)
def fill_rows(
    faces_of, barycentric, normals, groups, group_starts, group_joints, faces, rest, joints, weights, directions,
    transforms, centres, offsets, parent_world, parents,
):  # fmt: skip
    """Derivatives of n . p of all points, (N, P)."""
    shapes, first_shape = offsets.shape[2], 3 + 3 * len(parents)
    rows = np.zeros((len(faces_of), first_shape + shapes))
    moment, share = np.zeros((len(parents), 3)), np.zeros(len(parents))
    columns, row = np.zeros(first_shape + shapes, np.int64), np.zeros(first_shape + shapes)
    for i in range(len(faces_of)):
        g = groups[faces_of[i]]
        begin, end = group_starts[g], group_starts[g + 1]
        columns_of(group_joints, begin, end, shapes, first_shape, columns)
        count = one_row(
            i, faces_of, barycentric, normals, faces, rest, joints, weights, directions, transforms, centres, offsets,
            parent_world, parents, group_joints, begin, end, moment, share, shapes, row,
        )  # fmt: skip
        for c in range(count):
            rows[i, columns[c]] = row[c]
    return rows


@njit(cache=True)
def add_up_rows(
    order, weight, residual, with_shape, faces_of, barycentric, normals, groups, group_starts, group_joints, faces,
    rest, joints, weights, directions, transforms, centres, offsets, parent_world, parents,
):  # fmt: skip
    """J^T W J, (P, P), and J^T W r, (P,), of those rows.

    Args:
        order: of the points, those of one group together: their rows have the same columns, and add up to a block.
    """
    shapes, first_shape = offsets.shape[2] if with_shape else 0, 3 + 3 * len(parents)
    size = first_shape + shapes
    halves, descent = np.zeros((size, size)), np.zeros(size)
    moment, share = np.zeros((len(parents), 3)), np.zeros(len(parents))
    columns, row = np.zeros(size, np.int64), np.zeros(size)
    block, drawn, count, before = np.zeros((size, size)), np.zeros(size), 0, -1
    begin, end = 0, 0
    for n in range(len(order) + 1):
        g = groups[faces_of[order[n]]] if n < len(order) else -2
        if g != before:
            for c in range(count):
                descent[columns[c]] += drawn[c]
                drawn[c] = 0.0
                for d in range(c, count):
                    halves[columns[c], columns[d]] += block[c, d]
                    block[c, d] = 0.0
            if g < 0:
                break
            before, begin, end = g, group_starts[g], group_starts[g + 1]
            columns_of(group_joints, begin, end, shapes, first_shape, columns)
        i = order[n]
        count = one_row(
            i, faces_of, barycentric, normals, faces, rest, joints, weights, directions, transforms, centres, offsets,
            parent_world, parents, group_joints, begin, end, moment, share, shapes, row,
        )  # fmt: skip
        for c in range(count):
            scaled = weight[i] * row[c]
            drawn[c] += scaled * residual[i]
            for d in range(c, count):
                block[c, d] += scaled * row[d]
    for a in range(size):  # of each pair one half or the other was added to
        for b in range(a):
            total = halves[a, b] + halves[b, a]
            halves[a, b], halves[b, a] = total, total
    return halves, descent
