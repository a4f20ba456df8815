"""Colour in the dense stage: what is printed on the cloth tells where it has slid to.

Letters: samples s are points of the template's faces, T_s their colours on the cloth, c_s the scan's colours there, G_s
the gradient of the scan's colours along its surface. Colours are logarithms, so that light, and what a camera makes of
it, is added to them. One template is many frames', and one frame one light's: what T and c differ by over a hand's
breadth is light, and is taken out as a mean over the nodes of the deformation graph. What is left, e, is measured as

    sum_s w_s |e_s + G_s (x - x_s)|^2,     w_s the Geman-McClure weight of e_s

which pulls along the surface only, and across the lines of a stripe only. The scan's colours and their gradients come
from a plane fitted to the points around each sample, under the bell (1 - d^2 / reach^2)^2, first a wide and then a
narrow one. T is learned from scans in the same way, so that both are equally blurred.

References: Lucas and Kanade, An iterative image registration technique (1981); Geman and McClure (1987).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32, UInt8

from capture4d.geometry.point_grid import PointGrid
from capture4d.heavy_imports import njit
from registration.correspondences import ScanSurface
from registration.solver import Rows, RowTerm
from registration.template import TemplateAnalysis

__all__ = ["ClothColours", "ColourSamples", "SeenColours", "colour_term", "log_colours", "sample_template", "see_colours"]

DARKEST = 10
"""sRGB of 255 below which differences are noise."""
LARGEST_STEP_M = 0.004
"""How far one step follows a gradient."""
SAME_SIDE = 0.5
"""Least cosine between a sample's normal and that of points around it."""
FEWEST = 5
"""Points that a plane is fitted to."""
ASIDE = 0.25
"""How far their middle may lie beside the sample, as a share of the reach."""
RIDGE = 1e-3
"""Added to the second moments of the points, of the reach's square: where they lie in a line, nothing tells the colours
beside it."""
APERTURE = 1e-3
"""Share of a gradient's square by which the colours are taken to change in the direction in which they do not."""
FROM_BORDER_M = 0.025
"""Nearer to a border the cloth may be painted, and the border's own term says where it is."""


@dataclass(frozen=True, slots=True, eq=False)
class ColourSamples:
    """Points of the template's faces at which colours are compared."""

    vertices: Int32[np.ndarray, "samples 3"]
    """Corners of the face of each."""
    weights: Float64[np.ndarray, "samples 3"]
    """Its place among them."""
    inner: Bool[np.ndarray, " samples"]
    """Not near a border."""
    rows: Rows

    def __len__(self) -> int:
        return len(self.vertices)

    def places(self, vertices: Float64[np.ndarray, "verts 3"]) -> Float64[np.ndarray, "samples 3"]:
        return np.einsum("sk,skc->sc", self.weights, vertices[self.vertices])

    def normals(self, vertices: Float64[np.ndarray, "verts 3"]) -> Float64[np.ndarray, "samples 3"]:
        """Unit normals of the faces."""
        a, b, c = (vertices[self.vertices[:, corner]] for corner in range(3))
        normals = np.cross(b - a, c - a)
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-15)


@dataclass(frozen=True, slots=True, eq=False)
class SeenColours:
    """A scan's colours at samples of the template as it lies."""

    values: Float64[np.ndarray, "samples 3"]
    """Logarithms."""
    gradients: Float64[np.ndarray, "samples 3 3"]
    """Of each channel along the scan's surface, per metre."""
    known: Bool[np.ndarray, " samples"]
    """The scan shows them."""
    places: Float64[np.ndarray, "samples 3"]
    """Where the samples were, metres."""

    def at(self, places: Float64[np.ndarray, "samples 3"]) -> Float64[np.ndarray, "samples 3"]:
        """The colours a little beside, by their gradients."""
        return self.values + np.einsum("sca,sa->sc", self.gradients, places - self.places)


@dataclass(frozen=True, slots=True, eq=False)
class ClothColours:
    """The template's own colours, blurred as `SeenColours` has those of a scan."""

    samples: ColourSamples
    reach: float
    """Of the blur, metres."""
    values: Float64[np.ndarray, "samples 3"]
    """Logarithms."""
    known: Bool[np.ndarray, " samples"]
    steepness: float
    """Of the colours where they change, root mean square along one direction, per metre."""
    spread: float
    """Variance of the colours where they change, about their mean over a hand's breadth."""


def log_colours(colours: UInt8[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points 3"]:
    """Logarithms of sRGB: light scales linear colours, and adds to these."""
    return np.log(np.maximum(np.arange(256), DARKEST) / 255.0)[colours]


def sample_template(analysis: TemplateAnalysis, spacing: float) -> ColourSamples:
    """Points of the template's faces, evenly spread, about `spacing` metres apart."""
    per_edge = max(1, round(float(analysis.rest_lengths.mean()) / spacing))
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(per_edge) for j in range(per_edge - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(per_edge - 1) for j in range(per_edge - 1 - i)]
    places = np.array(upright + turned) / per_edge
    weights = np.column_stack([places, 1 - places.sum(axis=1)])
    count = len(analysis.faces) * len(weights)
    vertices = np.repeat(analysis.faces, len(weights), axis=0)
    weights = np.tile(weights, (len(analysis.faces), 1))
    inner = np.ones(count, bool)
    if len(analysis.border.vertices):
        border = PointGrid.build(analysis.rest[analysis.border.vertices], FROM_BORDER_M)
        away = border.query(np.einsum("sk,skc->sc", weights, analysis.rest[vertices]), FROM_BORDER_M)[0]
        inner = ~np.isfinite(away)
    rows = Rows(np.arange(0, 3 * count + 1, 3, dtype=np.int32), vertices.reshape(-1), weights.reshape(-1, 1))
    return ColourSamples(vertices, weights, inner, rows)


def see_colours(
    surface: ScanSurface,
    colours: Float64[np.ndarray, "points 3"],
    samples: ColourSamples,
    vertices: Float64[np.ndarray, "verts 3"],
    reach: float,
) -> SeenColours:
    """The scan's colours at the samples, and how they change there.

    Args:
        colours: logarithms, of the surface's points.
        vertices: of the template as it lies.
        reach: how far from a sample points may lie, metres; a third of it is the blur's standard deviation.
    """
    grid, places = surface.grid, samples.places(vertices)
    values, gradients, known = fit_colours(
        places, samples.normals(vertices), reach,
        grid.origin, grid.cell, grid.shape, grid.starts, grid.points, grid.order, surface.normals, colours,
    )  # fmt: skip
    return SeenColours(values, gradients, known & samples.inner, places)


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
def fit_colours(places, normals, reach, origin, cell, shape, starts, points, order, scan_normals, colours):
    """A plane through the colours around each place, by least squares under a bell."""
    x, y, z = shape
    count = len(places)
    values, gradients, known = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros(count, np.bool_)
    first, last, size = np.empty(3, np.int64), np.empty(3, np.int64), (x, y, z)
    along, across = np.empty(3), np.empty(3)
    square, right = np.empty((3, 3)), np.empty((3, 3))
    for s in range(count):
        normal = normals[s]
        if abs(normal[0]) < 0.7:
            along[0], along[1], along[2] = 0.0, normal[2], -normal[1]
        else:
            along[0], along[1], along[2] = -normal[2], 0.0, normal[0]
        length = np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
        if length == 0.0:
            continue
        along /= length
        across[0] = normal[1] * along[2] - normal[2] * along[1]
        across[1] = normal[2] * along[0] - normal[0] * along[2]
        across[2] = normal[0] * along[1] - normal[1] * along[0]
        for axis in range(3):
            at = places[s, axis] - origin[axis]
            first[axis] = min(max(np.int64(np.floor((at - reach) / cell)), 0), size[axis])
            last[axis] = max(min(np.int64(np.floor((at + reach) / cell)), size[axis] - 1), -1)
        square[:], right[:], used = 0.0, 0.0, 0
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                row = (i * y + j) * z
                if last[2] < first[2]:
                    continue
                for p in range(starts[row + first[2]], starts[row + last[2] + 1]):
                    dx, dy, dz = points[p, 0] - places[s, 0], points[p, 1] - places[s, 1], points[p, 2] - places[s, 2]
                    away = dx * dx + dy * dy + dz * dz
                    if away >= reach * reach:
                        continue
                    n = order[p]
                    facing = (
                        normal[0] * scan_normals[n, 0] + normal[1] * scan_normals[n, 1] + normal[2] * scan_normals[n, 2]
                    )
                    if facing < SAME_SIDE:
                        continue
                    weight = (1 - away / (reach * reach)) ** 2
                    u = (dx * along[0] + dy * along[1] + dz * along[2]) / reach
                    v = (dx * across[0] + dy * across[1] + dz * across[2]) / reach
                    used += 1
                    square[0, 0] += weight
                    square[0, 1] += weight * u
                    square[0, 2] += weight * v
                    square[1, 1] += weight * u * u
                    square[1, 2] += weight * u * v
                    square[2, 2] += weight * v * v
                    for c in range(3):
                        right[0, c] += weight * colours[n, c]
                        right[1, c] += weight * u * colours[n, c]
                        right[2, c] += weight * v * colours[n, c]
        a, b, c, d, e, f = square[0, 0], square[0, 1], square[0, 2], square[1, 1], square[1, 2], square[2, 2]
        if used < FEWEST or b * b + c * c > (ASIDE * a) ** 2:
            continue
        d, f = d + RIDGE * a, f + RIDGE * a
        aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
        dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
        scale = 1.0 / (a * aa + b * bb + c * cc)
        known[s] = True
        for channel in range(3):
            r0, r1, r2 = right[0, channel], right[1, channel], right[2, channel]
            values[s, channel] = scale * (aa * r0 + bb * r1 + cc * r2)
            u = scale * (bb * r0 + dd * r1 + ee * r2) / reach
            v = scale * (cc * r0 + ee * r1 + ff * r2) / reach
            for axis in range(3):
                gradients[s, channel, axis] = u * along[axis] + v * across[axis]
    return values, gradients, known


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
