"""Sweeps that project cloth onto its bends and its lengths; and the last of a frame's relaxation, in which it gets its
lengths back, nearly unbent, over-relaxed.

References: successive over-relaxation, Young (1954); for position-based constraints, Macklin et al., Unified Particle
Physics for Real-Time Applications (SIGGRAPH 2014).
"""

from __future__ import annotations

import numpy as np

from capture4d.heavy_imports import njit

__all__ = ["flatten", "lengthen", "tighten"]


@njit(cache=True, fastmath=True, nogil=True)
def flatten(x, hinges, weights, bend, forward):
    """One sweep over the inner edges, (Q, 4), of points x, (V, 3) float32: each is bent less by a gain, in place."""
    for q in range(len(hinges)):
        e = q if forward else len(hinges) - 1 - q
        a, b, c, d = hinges[e, 0], hinges[e, 1], hinges[e, 2], hinges[e, 3]
        wa, wb, wc, wd = weights[e, 0], weights[e, 1], weights[e, 2], weights[e, 3]
        gain = bend * weights[e, 4]
        for k in range(3):
            bent = gain * (wa * x[a, k] + wb * x[b, k] + wc * x[c, k] + wd * x[d, k])
            x[a, k] -= wa * bent
            x[b, k] -= wb * bent
            x[c, k] -= wc * bent
            x[d, k] -= wd * bent


@njit(cache=True, fastmath=True, nogil=True)
def lengthen(x, edges, lengths, gain, slack, forward):
    """One sweep over the edges, (E, 2): the ends of each go by the gain, a half for all of it, towards its length.

    Those of one that is too long go by the share `slack` of that.
    """
    one = np.float32(1)
    for q in range(len(edges)):
        e = q if forward else len(edges) - 1 - q
        i, j = edges[e, 0], edges[e, 1]
        dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        size = np.sqrt(dx * dx + dy * dy + dz * dz) + np.float32(1e-9)
        move = gain * (one - lengths[e] / size)
        if move > 0:
            move *= slack
        dx, dy, dz = dx * move, dy * move, dz * move
        x[i, 0] += dx
        x[i, 1] += dy
        x[i, 2] += dz
        x[j, 0] -= dx
        x[j, 1] -= dy
        x[j, 2] -= dz


@njit(cache=True, fastmath=True, nogil=True)
def tighten(x, base, radius, edges, lengths, over, slack, hinges, weights, bend, planes, plane_normals, margin, sweeps):
    """Project the edges, (E, 2), of points x, (V, 3) float32, to their lengths, in place; within `radius` of `base`.

    Args:
        over: over-relaxation of an edge's correction, 1 to 2; the last three sweeps are at 1.
        slack: share of it for an edge that is too long, 0 to 1.
        bend: gain of the hinges, as in `_relax`.
        planes: points, (V, 3), of half planes that no vertex comes nearer to than the margin, and their normals.
    """
    one, half = np.float32(1), np.float32(0.5)
    for sweep in range(sweeps):
        forward = sweep % 2 == 0
        if bend > 0:
            flatten(x, hinges, weights, bend, forward)
        for i in range(len(x)):
            ox, oy, oz = x[i, 0] - base[i, 0], x[i, 1] - base[i, 1], x[i, 2] - base[i, 2]
            size = np.sqrt(ox * ox + oy * oy + oz * oz)
            if size > radius:
                x[i, 0] = base[i, 0] + ox * radius / size
                x[i, 1] = base[i, 1] + oy * radius / size
                x[i, 2] = base[i, 2] + oz * radius / size
            depth = -margin
            for k in range(3):
                depth += (x[i, k] - planes[i, k]) * plane_normals[i, k]
            if depth < 0:
                for k in range(3):
                    x[i, k] -= depth * plane_normals[i, k]
        lengthen(x, edges, lengths, half * (over if sweep < sweeps - 3 else one), slack, forward)
