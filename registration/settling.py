"""From lying on a scan to lying in its place: the whole template turned and slid there with the shape that it has.

Planes say nothing of how cloth lies along itself. What is left is the shape: every neighbourhood is held to what it is
in the template, turned as it lies now, so that limbs twist and slide as wholes until their shape fits the scan's.

References: Sorkine and Alexa 2007 (as rigid as possible), whose turned neighbourhoods these are; Sorkine et al. 2004
(Laplacian coordinates).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy import sparse

from registration.border_strip import PaintRim
from registration.config import RegistrationConfig, SettleConfig
from registration.energies import edge_vectors, stretch_term
from registration.register import FrameScan, anneal, border_terms, data_term
from registration.solver import Rows, SmoothTerm, Term, gauss_newton_step
from registration.template import TemplateAnalysis

__all__ = ["TurnedShape", "settle"]

WIDENED = 2
"""How often the neighbourhood that a turn is measured on is widened by its neighbours: one ring alone turns with the
noise of the scan."""


@dataclass(frozen=True, slots=True, eq=False)
class TurnedShape:
    """A template's shape, each neighbourhood of which may be turned by itself."""

    analysis: TemplateAnalysis
    differences: Float64[np.ndarray, "verts 3"]
    """Each vertex minus the mean of its neighbours, in the template, metres."""
    edge_vectors: Float64[np.ndarray, "edges 3"]
    """In the template, metres."""
    incidence: sparse.csr_array
    """(verts, edges): the edges at each vertex."""
    adjacency: sparse.csr_array
    """(verts, verts): neighbours, and the vertex itself."""

    @staticmethod
    def of(analysis: TemplateAnalysis) -> TurnedShape:
        """The shape at rest."""
        count, edges = len(analysis.rest), analysis.edges
        ends, both = edges.T.reshape(-1), np.tile(np.arange(len(edges)), 2)
        incidence = sparse.csr_array((np.ones(len(ends)), (ends, both)), shape=(count, len(edges)))
        others = edges[:, ::-1].T.reshape(-1)
        adjacency = sparse.csr_array((np.ones(len(ends)), (ends, others)), shape=(count, count))
        adjacency = sparse.csr_array(adjacency + sparse.eye_array(count))
        differences = analysis.laplacian_rows.apply(analysis.rest[:, :, None])
        return TurnedShape(analysis, differences, edge_vectors(analysis.rest, edges), incidence, adjacency)

    def turns(self, vertices: Float64[np.ndarray, "verts 3"]) -> Float64[np.ndarray, "verts 3 3"]:
        """The rotation of each neighbourhood, in least squares, from the template to where it lies now."""
        now = edge_vectors(vertices, self.analysis.edges)
        spread = self.incidence @ (now[:, :, None] * self.edge_vectors[:, None, :]).reshape(-1, 9)
        for _ in range(WIDENED):
            spread = self.adjacency @ spread
        left, _, right = np.linalg.svd(spread.reshape(-1, 3, 3))
        left[:, :, 2] *= np.where(np.linalg.det(left) * np.linalg.det(right) < 0.0, -1.0, 1.0)[:, None]
        return left @ right

    def bending(self, vertices: Float64[np.ndarray, "verts 3"]) -> Float64[np.ndarray, "verts 3"]:
        """Of each vertex, by how much it is off its turned neighbourhood, metres."""
        turned = np.einsum("vab,vb->va", self.turns(vertices), self.differences)
        return self.analysis.laplacian_rows.apply(vertices[:, :, None]) - turned


def settle(
    analysis: TemplateAnalysis,
    scan: FrameScan,
    vertices: Float64[np.ndarray, "verts 3"],
    config: SettleConfig,
    registration: RegistrationConfig,
    *,
    rim: PaintRim | None = None,
) -> Float64[np.ndarray, "verts 3"]:
    """Turn and slide the template into its place on a scan that it lies on.

    Args:
        vertices: where it lies, metres.
        registration: how scan points are matched, and the solver.
        rim: where the borders' paint begins, in place of the points on those borders that it holds.
    """
    shape, rows = TurnedShape.of(analysis), analysis.laplacian_rows
    border_rows = Rows.of_points(analysis.border.vertices)
    count = len(vertices)
    every = np.arange(count)
    for step in range(config.steps):
        at = (step, config.steps)
        gate = anneal(config.gate, *at)
        drawn, others = rim.terms(scan, vertices, config.rim) if rim else ([], scan)
        terms: list[Term] = [
            data_term(analysis, analysis.vertex_rows, scan.surface, vertices, every, gate, registration),
            *drawn,
            *border_terms(
                analysis, border_rows, others, vertices, anneal(config.boundary, *at), registration.boundary.gate,
                rule=registration.boundary.dense_rule, along_curve=registration.boundary.along_curve,
            ),
            stretch_term(
                vertices, analysis.edges, analysis.rest_lengths, weight=anneal(config.stretch, *at), compression=1.0
            ),
            SmoothTerm(
                rows, analysis.laplacian_columns, anneal(config.bending, *at) / count, shape.bending(vertices)
            ),
        ]  # fmt: skip
        change, _ = gauss_newton_step(
            terms, None, count, damping=1e-6,
            tolerance=registration.solver.tolerance, max_iterations=registration.solver.max_iterations,
        )  # fmt: skip
        vertices = vertices + change[:, :, 0]
    return vertices
