"""Seams of a map: where two islands show the same edge of the cloth, they shall show it alike.

What lies beyond a seam is the cloth of the other island, not a repetition of the border: a texel of the gutter there
shows the point of the other island that it would show if both were one, the islands laid edge to edge and as flat as
they are in the map. So interpolation, convolutions and renderers see across the seam.

A network still paints the two sides of a seam apart, by little. Each side is moved half way to the other at the seam,
and less with the distance from it; a map that is continuous on the surface stays as it is. Both work on maps in one
global space, not in tangent space, where the two sides have different frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Int64
from scipy.spatial import KDTree

from capture4d.geometry.tangents import TangentLayout
from capture4d.geometry.uv_raster import UvRaster, sample_bilinear
from capture4d.types import Mesh

__all__ = ["REACH", "Gutter", "SeamTable", "find_gutter", "seam_table"]

REACH = 6 / 256
"""How far from a seam its two sides are brought together, as a share of the map's side."""


@dataclass(frozen=True, slots=True, eq=False)
class Gutter:
    """The texels beyond the seams, and the points across that they show. Found once per template."""

    texels: Int64[np.ndarray, " M"]
    """Index into the raster's texels, ascending."""
    uv: Float64[np.ndarray, "M 2"]
    """Of the points across."""
    faces: Int32[np.ndarray, " M"]
    barycentric: Float32[np.ndarray, "M 3"]
    """Of the points across."""
    seam_faces: Int32[np.ndarray, "2 M"]
    seam_barycentric: Float32[np.ndarray, "2 M 3"]
    """Of the nearest seam point, in the texel's own island and in the other."""

    def shown_by(self, raster: UvRaster) -> UvRaster:
        """The raster with the points across in place of the border."""
        faces, barycentric = raster.faces.copy(), raster.barycentric.copy()
        faces[self.texels], barycentric[self.texels] = self.faces, self.barycentric
        corners = raster.corners.copy()
        corners[self.texels] = self._corners(raster)
        return replace(raster, faces=faces, corners=corners, barycentric=barycentric)

    def _corners(self, raster: UvRaster) -> Int32[np.ndarray, "M 3"]:
        known = np.zeros((int(max(raster.faces.max(initial=0), self.faces.max(initial=0))) + 1, 3), np.int32)
        known[raster.faces] = raster.corners
        return known[self.faces]

    def filled(self, image: Float[np.ndarray, "size size C"], raster: UvRaster) -> Float32[np.ndarray, "size size C"]:
        """A map in a global space, its gutters read from across."""
        values = raster.read(image).astype(np.float32)
        values[self.texels] = sample_bilinear(image, self.uv)
        return raster.image(values)


@dataclass(frozen=True, slots=True, eq=False)
class SeamTable:
    """Texels near seams, with the place of the nearest seam point on either side. Found once per template."""

    texels: Int64[np.ndarray, " M"]
    """Index into the raster's texels."""
    weight: Float64[np.ndarray, " M"]
    """1 at the seam, 0 at the reach."""
    own_uv: Float64[np.ndarray, "M 2"]
    other_uv: Float64[np.ndarray, "M 2"]

    def blended(self, image: Float[np.ndarray, "size size C"], raster: UvRaster) -> Float32[np.ndarray, "size size C"]:
        """The map with equal values on both sides of every seam."""
        difference = sample_bilinear(image, self.other_uv) - sample_bilinear(image, self.own_uv)
        values = raster.read(image).astype(np.float32)
        values[self.texels] += 0.5 * self.weight[:, None].astype(np.float32) * difference
        return raster.image(values)


def seam_table(mesh: Mesh, raster: UvRaster, *, reach: float = REACH) -> SeamTable:
    """Find the texels near a seam of their own island, padding included.

    Args:
        raster: whose padding repeats the border: it is moved as far as the border is.
        reach: share of the map's side.
    """
    assert mesh.uv is not None
    points = _seam_points(mesh, raster.size)
    places = raster.at_corners(mesh.uv)
    texels, nearest, distance = _nearest_seam_points(mesh, raster, points, places, np.arange(len(places)), reach)
    return SeamTable(texels, 1 - distance / reach, points.own_uv[nearest], points.other_uv[nearest])


def find_gutter(mesh: Mesh, raster: UvRaster) -> Gutter:
    """Find what the padding beyond the seams would show if the other island went on there.

    Padding beside open borders, beyond the other island, or nearer to nothing than to its own border stays what it is.

    Args:
        raster: whose padding repeats the border.
    """
    assert mesh.uv is not None
    size, points = raster.size, _seam_points(mesh, raster.size)
    padding = np.flatnonzero(~raster.inside)
    row, column = np.divmod(raster.texels, size)
    centres = np.stack([(column + 0.5) / size, 1 - (row + 0.5) / size], axis=-1)
    reach = np.linalg.norm(centres - raster.at_corners(mesh.uv), axis=1)  # to the nearest point of the island
    texels, nearest, distance = _nearest_seam_points(mesh, raster, points, centres, padding, np.inf)
    at_seam = distance <= reach[texels] + 0.3 / size
    texels, nearest = texels[at_seam], nearest[at_seam]
    away = centres[texels] - points.own_uv[nearest]
    uv = points.other_uv[nearest] + np.einsum("mij,mj->mi", points.across[nearest], away)
    at = _texel_at(raster, uv)
    found = at >= 0
    islands = _islands(mesh)
    found[found] = islands[raster.faces[at[found]]] == islands[points.other_face[nearest[found]]]
    texels, nearest, uv, at = texels[found], nearest[found], uv[found], at[found]
    order = np.argsort(texels)
    texels, nearest, uv, at = texels[order], nearest[order], uv[order], at[order]
    faces, barycentric = raster.faces[at], raster.barycentric[at].copy()
    exact, good = _barycentric(mesh.uv[faces].astype(float), uv)
    good &= raster.inside[at]
    barycentric[good] = exact[good]
    uv = np.einsum("mk,mkd->md", barycentric.astype(float), mesh.uv[faces].astype(float))
    return Gutter(
        texels, uv, faces, barycentric, np.stack([points.own_face[nearest], points.other_face[nearest]]),
        np.stack([points.own_barycentric[nearest], points.other_barycentric[nearest]]).astype(np.float32),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _SeamPoints:
    """Points along all seams, twice each: from one side and from the other; one a quarter texel."""

    own_uv: Float64[np.ndarray, "P 2"]
    own_face: Int32[np.ndarray, " P"]
    own_barycentric: Float64[np.ndarray, "P 3"]
    other_uv: Float64[np.ndarray, "P 2"]
    other_face: Int32[np.ndarray, " P"]
    other_barycentric: Float64[np.ndarray, "P 3"]
    across: Float64[np.ndarray, "P 2 2"]
    """Turns and scales what leaves the one island to what enters the other."""


def _seam_points(mesh: Mesh, size: int) -> _SeamPoints:
    assert mesh.uv is not None
    uv, faces = mesh.uv.astype(float), mesh.faces
    face, corner = (each.ravel() for each in np.meshgrid(np.arange(len(faces)), np.arange(3), indexing="ij"))
    onward = (corner + 1) % 3
    turned = faces[face, corner] > faces[face, onward]
    start, end = np.where(turned, onward, corner), np.where(turned, corner, onward)
    edge = faces[face, start].astype(np.int64) * (int(faces.max(initial=0)) + 1) + faces[face, end]
    order = np.argsort(edge, kind="stable")
    _, first, count = np.unique(edge[order], return_index=True, return_counts=True)
    one, two = order[first[count == 2]], order[first[count == 2] + 1]
    ends = np.stack([uv[face, start], uv[face, end]], axis=1)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    seam = (ends[one] != ends[two]).any(axis=(1, 2)) & (np.minimum(lengths[one], lengths[two]) > 1e-12)
    own, other = np.concatenate([one[seam], two[seam]]), np.concatenate([two[seam], one[seam]])
    along = np.stack([ends[own, 1] - ends[own, 0], ends[other, 1] - ends[other, 0]])
    inward = np.stack([_inward(uv[face[side]], start[side], end[side]) for side in (own, other)])
    # What leaves one island by a length across its edge enters the other by that, at the other's scale.
    before = np.stack([along[0], -inward[0] * lengths[own, None]], axis=2)
    after = np.stack([along[1], inward[1] * lengths[other, None]], axis=2)
    across = after @ np.linalg.inv(before)
    steps = np.maximum(np.ceil(4 * size * np.maximum(lengths[own], lengths[other])).astype(int), 1) + 1
    at = np.repeat(np.arange(len(own)), steps)
    t = (np.arange(len(at)) - np.repeat(np.cumsum(steps) - steps, steps)) / (steps - 1)[at]
    barycentric, everything = np.zeros((2, len(at), 3)), np.arange(len(at))
    for weights, side in zip(barycentric, (own, other), strict=True):
        weights[everything, start[side][at]] = 1 - t
        weights[everything, end[side][at]] = t
    return _SeamPoints(
        ends[own, 0][at] + t[:, None] * along[0][at], face[own][at].astype(np.int32), barycentric[0],
        ends[other, 0][at] + t[:, None] * along[1][at], face[other][at].astype(np.int32), barycentric[1], across[at],
    )  # fmt: skip


def _inward(corners: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Unit vectors (M, 2) across an edge of each triangle (M, 3, 2), towards its third corner."""
    rows = np.arange(len(corners))
    along = corners[rows, end] - corners[rows, start]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    towards = corners[rows, 3 - start - end] - corners[rows, start]
    return normal * np.where(np.einsum("md,md->m", normal, towards) < 0, -1.0, 1.0)[:, None]


def _nearest_seam_points(
    mesh: Mesh, raster: UvRaster, points: _SeamPoints, places: np.ndarray, texels: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Those of some texels within reach of a seam of their own island, the seam point nearest to each, its distance."""
    islands = _islands(mesh)
    of_points, of_texels = islands[points.own_face], islands[raster.faces[texels]]
    found: list[tuple[np.ndarray, ...]] = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
    for number in np.unique(of_points):
        mine, theirs = np.flatnonzero(of_points == number), texels[of_texels == number]
        tree = KDTree(points.own_uv[mine])
        distance, nearest = map(np.asarray, tree.query(places[theirs], distance_upper_bound=reach))
        near = np.isfinite(distance)
        found.append((theirs[near], mine[nearest[near]], distance[near]))
    texels, nearest, distance = (np.concatenate(each) for each in zip(*found, strict=True))
    return texels, nearest, distance


def _islands(mesh: Mesh) -> np.ndarray:
    assert mesh.uv is not None
    return TangentLayout(mesh.faces, mesh.uv).islands()


def _texel_at(raster: UvRaster, uv: np.ndarray) -> np.ndarray:
    """Index into the raster's texels of that around each UV; -1 where the map shows nothing."""
    size = raster.size
    column, row = np.floor(uv[:, 0] * size).astype(int), np.floor((1 - uv[:, 1]) * size).astype(int)
    within = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    number = np.where(within, row * size + column, 0)
    at = np.minimum(np.searchsorted(raster.texels, number), len(raster.texels) - 1)
    return np.where(within & (raster.texels[at] == number), at, -1)


def _barycentric(corners: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of places (M, 2) in triangles (M, 3, 2), and where they are at most a triangle's size outside."""
    along, across, to = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], places - corners[:, 0]
    area = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    safe = np.where(np.abs(area) < 1e-16, 1.0, area)
    second = (to[:, 0] * across[:, 1] - to[:, 1] * across[:, 0]) / safe
    third = (along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0]) / safe
    found = np.stack([1 - second - third, second, third], axis=1)
    return found, (np.abs(area) >= 1e-16) & (found > -1).all(axis=1)
