"""Colour in the dense stage: what is printed on the cloth tells where it has slid to.

Letters: samples s are points of the template's faces, T_s their colours on the cloth, c_s the scan's colours there, G_s
the gradient of the scan's colours along its surface, all logarithms, so that light, and what a camera makes of it, is
added to them. What T and c differ by over a hand's breadth is light, and is taken out as a mean over the nodes of the
deformation graph. What is left, e, is measured as

    sum_s w_s |e_s + G_s (x - x_s)|^2,     w_s the Geman-McClure weight of e_s

which pulls along the surface only, and across the lines of a stripe only. First both colours are blurred widely, so
that a place is found from afar, then narrowly.

References: Lucas and Kanade, An iterative image registration technique (1981); Geman and McClure (1987).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from capture4d.heavy_imports import njit
from registration.cloth_colours import ClothColours, ColourSamples, SeenColours, see_colours
from registration.config import ColourConfig
from registration.correspondences import ScanSurface
from registration.solver import RowTerm
from registration.template import TemplateAnalysis

__all__ = ["ColourPull", "colour_term", "without_light"]

LOOK_EVERY = 3
"""Steps after which the scan's colours are looked up again; between, their gradients tell."""
LARGEST_STEP_M = 0.004
"""How far one step follows a gradient."""
APERTURE = 1e-3
"""Share of a gradient's square by which the colours are taken to change in the direction in which they do not."""


class ColourPull:
    """What is printed on one scan, through the steps of a dense stage."""

    def __init__(
        self,
        analysis: TemplateAnalysis,
        surface: ScanSurface,
        colours: Float64[np.ndarray, "points 3"],
        config: ColourConfig,
    ) -> None:
        """Nothing is looked up yet.

        Args:
            analysis: of a template with colours.
            colours: logarithms, of the surface's points.
        """
        self._analysis, self._surface, self._colours, self._config = analysis, surface, colours, config
        self._seen: SeenColours | None = None
        sharp = analysis.cloth[-1]
        printed = np.zeros(len(analysis.rest), bool)
        printed[sharp.samples.vertices[sharp.known]] = True
        self.printed_edges = np.asarray(printed[analysis.edges].all(axis=1))

    def term(self, vertices: Float64[np.ndarray, "verts 3"], step: int, steps: int) -> RowTerm:
        """Pull the template to where its colours are the scan's, which are looked up every few steps."""
        config = self._config
        sharp = steps - config.sharp_steps
        cloth = self._analysis.cloth[0 if step < sharp else -1]
        if self._seen is None or step == sharp or step % LOOK_EVERY == 0:
            self._seen = see_colours(self._surface, self._colours, cloth.samples, vertices, cloth.reach)
        return colour_term(self._analysis, cloth, self._seen, vertices, weight=config.weight, robust=config.robust)


def without_light(
    analysis: TemplateAnalysis,
    samples: ColourSamples,
    differences: Float64[np.ndarray, "samples 3"],
    weights: Float64[np.ndarray, " samples"],
) -> Float64[np.ndarray, "samples 3"]:
    """Differences of colours less their weighted mean over a hand's breadth of cloth."""
    graph = analysis.graph
    return differences - local_means(
        samples.vertices, samples.weights, differences, weights,
        graph.vertex_nodes, graph.vertex_weights, len(graph.nodes),
    )  # fmt: skip


def colour_term(
    analysis: TemplateAnalysis,
    cloth: ClothColours,
    seen: SeenColours,
    vertices: Float64[np.ndarray, "verts 3"],
    *,
    weight: float,
    robust: float,
) -> RowTerm:
    """Pull the samples along the scan to where its colours are the cloth's.

    Args:
        seen: the scan's colours near where the samples lie, as much blurred as the cloth's.
        vertices: of the template as it lies.
        weight: of the term where the colours are as steep as usual, in a plane's direction, beside 1 of the scan's
            planes.
        robust: scale of the Geman-McClure weight, as a share of the colours' variance.
    """
    known = seen.known & cloth.known
    weights = known.astype(np.float64)
    difference = seen.at(cloth.samples.places(vertices)) - cloth.values
    for _ in range(2):
        error = without_light(analysis, cloth.samples, difference, weights)
        square = (error**2).sum(axis=1)
        weights = known / (1 + square / (robust * cloth.spread)) ** 2
    scale = weight / (len(cloth.samples) * cloth.steepness**2)
    metric, residual = pull_kernel(seen.gradients, error, scale * weights, LARGEST_STEP_M)
    return RowTerm(cloth.samples.rows, metric, residual)


@njit(cache=True)
def local_means(vertices, shares, differences, weights, vertex_nodes, vertex_weights, nodes):
    """Weighted means of samples over the nodes of the graph, and at the samples again."""
    count = len(vertex_nodes)
    sums, totals = np.zeros((count, 3)), np.zeros(count)
    for s in range(len(vertices)):
        for k in range(3):
            share = shares[s, k] * weights[s]
            totals[vertices[s, k]] += share
            for c in range(3):
                sums[vertices[s, k], c] += share * differences[s, c]
    node_sums, node_totals = np.zeros((nodes, 3)), np.zeros(nodes)
    for v in range(count):
        for k in range(vertex_nodes.shape[1]):
            node, share = vertex_nodes[v, k], vertex_weights[v, k]
            node_totals[node] += share * totals[v]
            for c in range(3):
                node_sums[node, c] += share * sums[v, c]
    for v in range(count):
        total = 0.0
        for c in range(3):
            sums[v, c] = 0.0
        for k in range(vertex_nodes.shape[1]):
            node, share = vertex_nodes[v, k], vertex_weights[v, k]
            if node_totals[node] > 0.0:
                total += share
                for c in range(3):
                    sums[v, c] += share * node_sums[node, c] / node_totals[node]
        if total > 0.0:
            for c in range(3):
                sums[v, c] /= total
    means = np.zeros((len(vertices), 3))
    for s in range(len(vertices)):
        for k in range(3):
            for c in range(3):
                means[s, c] += shares[s, k] * sums[vertices[s, k], c]
    return means


@njit(cache=True)
def pull_kernel(gradients, errors, weights, longest):
    """w G^T G, and the step (G^T G + a little)^-1 G^T e, at most `longest`."""
    count = len(errors)
    metric, residual = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for s in range(count):
        if weights[s] == 0.0:
            continue
        a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        g0, g1, g2 = 0.0, 0.0, 0.0
        for k in range(3):
            x, y, z = gradients[s, k, 0], gradients[s, k, 1], gradients[s, k, 2]
            a += x * x
            b += x * y
            c += x * z
            d += y * y
            e += y * z
            f += z * z
            g0 += x * errors[s, k]
            g1 += y * errors[s, k]
            g2 += z * errors[s, k]
        w = weights[s]
        metric[s, 0, 0], metric[s, 1, 1], metric[s, 2, 2] = w * a, w * d, w * f
        metric[s, 0, 1] = metric[s, 1, 0] = w * b
        metric[s, 0, 2] = metric[s, 2, 0] = w * c
        metric[s, 1, 2] = metric[s, 2, 1] = w * e
        little = APERTURE * (a + d + f)
        if little == 0.0:
            continue
        a, d, f = a + little, d + little, f + little
        aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
        dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
        scale = 1.0 / (a * aa + b * bb + c * cc)
        r0 = scale * (aa * g0 + bb * g1 + cc * g2)
        r1 = scale * (bb * g0 + dd * g1 + ee * g2)
        r2 = scale * (cc * g0 + ee * g1 + ff * g2)
        length = np.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
        share = 1.0 if length <= longest else longest / length
        residual[s, 0], residual[s, 1], residual[s, 2] = share * r0, share * r1, share * r2
    return metric, residual
