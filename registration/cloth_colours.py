"""Colours of a template and of scans, at the same points of the cloth and equally blurred.

The scan's colours at a point of the template, and their gradient along the surface, come from a plane fitted to the
points of the scan around it, under the bell (1 - d^2 / reach^2)^2. Colours are logarithms, so that light adds to them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32, UInt8

from capture4d.heavy_imports import njit
from registration.correspondences import ScanSurface
from registration.solver import Rows

__all__ = ["ClothColours", "ColourSamples", "SeenColours", "log_colours", "sample_faces", "see_colours"]

DARKEST = 10
"""sRGB of 255 below which differences are noise."""
SAME_SIDE = 0.5
"""Least cosine between a sample's normal and that of points around it."""
FEWEST = 5
"""Points that a plane is fitted to."""
ENOUGH = 60
"""Points around a sample of which all are used; of more, every second, third, ..."""
ASIDE = 0.25
"""How far their middle may lie beside the sample, as a share of the reach."""
RIDGE = 1e-3
"""Added to the second moments of the points, of the reach's square: where they lie in a line, nothing tells the colours
beside it."""


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

    def of_corners(self, values: Float64[np.ndarray, "faces 3 width"]) -> Float64[np.ndarray, "samples width"]:
        """Of values at the corners of the template's faces, those at the samples."""
        per_face = len(self) // len(values)
        return np.einsum("sk,skw->sw", self.weights, np.repeat(values, per_face, axis=0))

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


def log_colours(colours: UInt8[np.ndarray, "*any 3"]) -> Float64[np.ndarray, "*any 3"]:
    """Logarithms of sRGB: light scales linear colours, and adds to these."""
    return np.log(np.maximum(np.arange(256), DARKEST) / 255.0)[colours]


def sample_faces(
    faces: Int32[np.ndarray, "faces 3"], per_edge: int, aside: Bool[np.ndarray, " faces"]
) -> ColourSamples:
    """Points of a template's faces, the square of `per_edge` on each.

    Args:
        aside: faces whose colours are not the cloth's.
    """
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(per_edge) for j in range(per_edge - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(per_edge - 1) for j in range(per_edge - 1 - i)]
    places = np.array(upright + turned) / per_edge
    each = np.column_stack([places, 1 - places.sum(axis=1)])
    vertices, weights = np.repeat(faces, len(each), axis=0), np.tile(each, (len(faces), 1))
    rows = Rows(np.arange(0, 3 * len(vertices) + 1, 3, dtype=np.int32), vertices.reshape(-1), weights.reshape(-1, 1))
    return ColourSamples(vertices, weights, ~np.repeat(aside, len(each)), rows)


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
    stride = max(1, int(3.6 * (reach / surface.spacing) ** 2 / ENOUGH))
    values, gradients, known = fit_colours(
        places, samples.normals(vertices), reach, stride,
        grid.origin, grid.cell, grid.shape, grid.starts, grid.points, grid.order, surface.normals, colours,
    )  # fmt: skip
    return SeenColours(values, gradients, known & samples.inner, places)


@njit(cache=True)
def fit_colours(places, normals, reach, stride, origin, cell, shape, starts, points, order, scan_normals, colours):
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
                for p in range(starts[row + first[2]], starts[row + last[2] + 1], stride):
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
