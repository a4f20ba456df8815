"""From afar: the template drawn to a scan that it does not lie on yet, as a whole and with its lengths kept.

Nearest points mean nothing where an arm that hangs here is raised there. Here every scan point has one vote, which it
divides among all template vertices by a Gaussian of their distance, and by how their normals agree: a raised arm that
nothing explains pulls at the shoulder until the template's arm has swung there. The Gaussian narrows from step to
step, and the deformation graph loosens as it does. Template vertices that no scan point votes for, as of half a person,
follow their neighbours.

Where the two surfaces tell their points apart by distances along them (`registration.geodesic_signature`), a scan point
votes for vertices like it alone, and for the nearest of them however far they are: a raised hand for the hand. Such
votes fade out while the Gaussian narrows, for signatures are good to a hand's breadth.

References: Myronenko and Song 2010 (coherent point drift); Sumner, Schmid, Pauly 2007 (the graph that moves).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from registration.config import ApproachConfig
from registration.correspondences import ScanSurface, mesh_normals
from registration.deformation_graph import identity_nodes, node_edge_rows, rows_of_vertices, smooth_rows
from registration.energies import edge_vectors, rigid_term, stretch_metric
from registration.register import anneal
from registration.solver import Rows, RowTerm, gauss_newton_step
from registration.template import TemplateAnalysis

__all__ = ["approach", "spread_evenly"]


def approach(
    analysis: TemplateAnalysis,
    surface: ScanSurface,
    start: Float64[np.ndarray, "verts 3"],
    config: ApproachConfig,
    *,
    signatures: tuple[Float64[np.ndarray, "verts q"], Float64[np.ndarray, "points q"]] | None = None,
    landmarks: tuple[Int64[np.ndarray, " marks"], Float64[np.ndarray, "marks 3"]] | None = None,
) -> Float64[np.ndarray, "verts 3"]:
    """Draw the template to the scan.

    Args:
        start: where the template lies, metres.
        signatures: of the template's vertices and of the scan's points, metres.
        landmarks: template vertices, and their places on the scan, metres.
    """
    graph = analysis.graph
    count = len(graph.nodes)
    nodes = identity_nodes(count)
    rows = rows_of_vertices(graph, start, np.arange(len(start)))
    constant = start - rows.apply(nodes)
    chosen = spread_evenly(start, config.vertices)
    voters = spread_evenly(surface.points, config.voters)
    unlike = None if signatures is None else _unlike(signatures[0][chosen], signatures[1][voters], config)
    votes = _Votes(
        surface.points[voters].astype(np.float32), surface.normals[voters].astype(np.float32), unlike, config
    )
    data_rows = rows_of_vertices(graph, start, chosen)
    mark_rows = rows_of_vertices(graph, start, landmarks[0] if landmarks else np.zeros(0, np.int64))
    node_rows, node_constant = smooth_rows(graph, start)
    pair_rows, pairs = node_edge_rows(graph)
    pair_start = edge_vectors(start[graph.nodes], pairs)
    lengths = np.linalg.norm(edge_vectors(analysis.rest[graph.nodes], pairs), axis=1)
    first = config.width[0] if signatures is None else config.signature_width
    width = (first, config.width[1])
    vertices = start
    for step in range(config.steps):
        at = (step, config.steps)
        normals = mesh_normals(vertices, analysis.faces)[chosen]
        told = anneal(config.signature_weight, *at)
        terms = [votes.term(data_rows, vertices[chosen], normals, anneal(width, *at), told)]
        if landmarks is not None:
            weight = config.landmarks / len(landmarks[0])
            metric = np.tile(weight * np.eye(3), (len(landmarks[0]), 1, 1))
            terms.append(RowTerm(mark_rows, metric, vertices[landmarks[0]] - landmarks[1]))
        smooth = anneal(config.smooth, *at) / max(len(node_constant), 1)
        metric = np.ascontiguousarray(np.broadcast_to(smooth * np.eye(3), (len(node_constant), 3, 3)))
        terms.append(RowTerm(node_rows, metric, node_rows.apply(nodes) + node_constant))
        stretch, excess = stretch_metric(
            pair_start + pair_rows.apply(nodes), lengths, weight=anneal(config.stretch, *at), compression=1.0
        )
        terms.append(RowTerm(pair_rows, stretch, excess))
        rigid = rigid_term(nodes, weight=anneal(config.rigid, *at), spacing=graph.spacing)
        change, _ = gauss_newton_step(terms, rigid, count, damping=1e-6, tolerance=1e-2, max_iterations=60)
        nodes = nodes + change
        vertices = rows.apply(nodes) + constant
    return vertices


@dataclass(frozen=True, slots=True, eq=False)
class _Votes:
    """What the scan wants of the template: the same scan points in every step, in single precision."""

    points: np.ndarray
    normals: np.ndarray
    unlike: np.ndarray | None
    """(template points, scan points) half the squared distances of their signatures, in standard deviations."""
    config: ApproachConfig

    def term(self, rows: Rows, points: np.ndarray, normals: np.ndarray, width: float, told: float) -> RowTerm:
        """Pull each template point to the mean of its votes, as strongly as it has votes.

        Args:
            width: of the Gaussian, metres.
            told: weight of the signatures beside 1 of the distance.
        """
        here = points.astype(np.float32)
        squares = (here**2).sum(axis=1)[:, None] + (self.points**2).sum(axis=1) - 2.0 * (here @ self.points.T)
        facing = normals.astype(np.float32) @ self.normals.T
        exponent = np.float32(self.config.normal) * (facing - 1.0) - np.maximum(squares, 0.0) / (2.0 * width**2)
        reach = self.config.reach
        if self.unlike is not None:
            exponent -= np.float32(told) * self.unlike
            reach = self.config.signature_reach
        share = np.exp(exponent)
        share /= share.sum(axis=0) + np.float32(np.exp(-(reach**2) / 2.0))
        received = share.sum(axis=1).astype(np.float64)
        target = (share @ self.points) / np.maximum(received, 1e-9)[:, None]
        residual = np.where(received[:, None] > 1e-6, points - target, 0.0)
        weights = np.minimum(received * len(points) / len(self.points), MOST_VOTES) / len(points)
        return RowTerm(rows, weights[:, None, None] * np.eye(3), residual)


def _unlike(own: np.ndarray, other: np.ndarray, config: ApproachConfig) -> np.ndarray:
    """Half the mean squared difference of signatures, template by scan, in standard deviations."""
    a, b = own.astype(np.float32), other.astype(np.float32)
    squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * (a @ b.T)
    return np.maximum(squares, 0.0) / np.float32(2.0 * a.shape[1] * config.signature**2)


MOST_VOTES = 4.0
"""A template point listens to so many times its share of the votes: the end of an arm that is not there yet has all
those of the arm beyond it."""


def spread_evenly(points: Float64[np.ndarray, "points 3"], count: int) -> Int64[np.ndarray, " chosen"]:
    """About `count` points, one of each occupied cell of a grid: as dense where a mesh is coarse as where it is fine.
    Indices, ascending."""
    if len(points) <= count:
        return np.arange(len(points))
    lower = points.min(axis=0)
    low, high = 0.0, float(np.ptp(points, axis=0).max())
    chosen = np.arange(len(points))
    for _ in range(20):
        cell = (low + high) / 2
        keys = np.floor((points - lower) / max(cell, 1e-12)).astype(np.int64)
        size = keys.max(axis=0) + 1
        found = np.unique((keys[:, 0] * size[1] + keys[:, 1]) * size[2] + keys[:, 2], return_index=True)[1]
        chosen = found
        if abs(len(found) - count) <= 0.03 * count:
            break
        low, high = (cell, high) if len(found) > count else (low, cell)
    return np.sort(chosen)
