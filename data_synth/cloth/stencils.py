"""What a sheet of cloth resists with: rest lengths of its edges, and bending stencils, both from the flat pattern.

References: isometric bending, Bergou et al., A Quadratic Bending Model for Inextensible Surfaces (SGP 2006).
"""

from __future__ import annotations

import numpy as np

from capture4d.geometry.mesh import edges_of_faces, unique_edges
from data_synth.cloth.patterns import PanelMesh

__all__ = ["hinges", "rest_areas", "rest_lengths"]


def rest_areas(mesh: PanelMesh) -> np.ndarray:
    """(F,) area of each face on the pattern, square metres."""
    first, second = mesh.uv[:, 1] - mesh.uv[:, 0], mesh.uv[:, 2] - mesh.uv[:, 0]
    return 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])


def _corner_lengths(mesh: PanelMesh) -> np.ndarray:
    """(F, 3) length on the pattern of the side opposite each corner."""
    a, b, c = mesh.uv.transpose(1, 0, 2)
    return np.stack([np.linalg.norm(c - b, axis=1), np.linalg.norm(a - c, axis=1), np.linalg.norm(b - a, axis=1)], 1)


def rest_lengths(mesh: PanelMesh) -> tuple[np.ndarray, np.ndarray]:
    """Unique edges, and their length on the pattern; an edge on a seam takes the mean of its two sides."""
    edges = unique_edges(mesh.faces)
    slot = edges_of_faces(mesh.faces, edges)[:, [1, 2, 0]].ravel()  # the side opposite each corner
    lengths = _corner_lengths(mesh).ravel()
    return edges, np.bincount(slot, lengths, len(edges)) / np.bincount(slot, minlength=len(edges))


def hinges(mesh: PanelMesh) -> tuple[np.ndarray, np.ndarray]:
    """Bending stencils of the inner edges from the pattern's angles; seams bend like the cloth around them."""
    lengths = _corner_lengths(mesh)
    squared = lengths**2
    heron = (
        4
        * np.linalg.norm(
            np.cross(
                np.pad(mesh.uv[:, 1] - mesh.uv[:, 0], ((0, 0), (0, 1))),
                np.pad(mesh.uv[:, 2] - mesh.uv[:, 0], ((0, 0), (0, 1))),
            ),
            axis=1,
        )
        / 2
    )
    cotangents = (squared[:, [1, 2, 0]] + squared[:, [2, 0, 1]] - squared) / heron[:, None]  # at each corner

    corners = np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1]])  # edge start, edge end, opposite corner
    start = mesh.faces[:, corners[:, 0]].ravel().astype(np.int64)
    end = mesh.faces[:, corners[:, 1]].ravel().astype(np.int64)
    opposite = mesh.faces[:, corners[:, 2]].ravel()
    at_start, at_end = cotangents[:, corners[:, 0]].ravel(), cotangents[:, corners[:, 1]].ravel()
    keys = np.minimum(start, end) * mesh.vertex_count + np.maximum(start, end)
    order = np.argsort(keys, kind="stable")
    paired = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    first, second = order[paired], order[paired + 1]
    stencils = np.stack([start[first], end[first], opposite[first], opposite[second]], axis=1)
    # The neighbour runs through the edge the other way: its start is our end.
    same_way = start[first] == start[second]
    c_start = np.where(same_way, at_start[second], at_end[second])
    c_end = np.where(same_way, at_end[second], at_start[second])
    weights = np.stack(
        [
            at_end[first] + c_end,
            at_start[first] + c_start,
            -at_start[first] - at_end[first],
            -c_start - c_end,
        ],
        axis=1,
    )
    return stencils, np.column_stack([weights, 1 / (weights**2).sum(axis=1)])
