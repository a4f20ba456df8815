"""Seams of a map: where two islands show the same edge of the cloth, they shall show it alike.

Networks paint the two sides apart. Each side is moved half way to the other at the seam, and less with the distance
from it; a map that is continuous on the surface stays as it is. Works on maps in one global space, not in tangent
space, where the two sides have different frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from scipy.spatial import KDTree

from capture4d.geometry.tangents import TangentLayout
from capture4d.geometry.uv_raster import UvRaster, sample_bilinear
from capture4d.types import Mesh

__all__ = ["SeamTable", "seam_table"]


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


def seam_table(mesh: Mesh, raster: UvRaster, *, reach: float = 6.0) -> SeamTable:
    """Find the texels within `reach` texels of a seam of their own island, padding included."""
    assert mesh.uv is not None
    islands = TangentLayout(mesh.faces, mesh.uv).islands()
    own, other, island = _seam_points(mesh, islands, raster.size)
    # Padding repeats the border, so it is moved as far as the border is: it counts as lying there.
    places = raster.at_corners(mesh.uv)
    at = islands[raster.faces]
    near, weight, points = [np.zeros(0, np.int64)], [np.zeros(0)], [np.zeros(0, np.int64)]
    for number in np.unique(island):
        texels, mine = np.flatnonzero(at == number), np.flatnonzero(island == number)
        tree = KDTree(own[mine])
        distance, nearest = map(np.asarray, tree.query(places[texels], distance_upper_bound=reach / raster.size))
        found = np.isfinite(distance)
        near.append(texels[found])
        weight.append(1 - distance[found] * raster.size / reach)
        points.append(mine[nearest[found]])
    at_seam = np.concatenate(points)
    return SeamTable(np.concatenate(near), np.concatenate(weight), own[at_seam], other[at_seam])


def _seam_points(mesh: Mesh, islands: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """UVs of points along all seams, twice each: from one side and from the other; one a quarter texel. The island of
    the first."""
    assert mesh.uv is not None
    sides: dict[tuple[int, int], list[tuple[np.ndarray, int]]] = {}
    for corner in range(3):
        onward = (corner + 1) % 3
        start, end = mesh.faces[:, corner], mesh.faces[:, onward]
        uv = np.stack([mesh.uv[:, corner], mesh.uv[:, onward]], axis=1).astype(float)
        swap = start > end
        uv[swap] = uv[swap, ::-1]
        keys = zip(np.minimum(start, end).tolist(), np.maximum(start, end).tolist(), strict=True)
        for key, place, island in zip(keys, uv, islands.tolist(), strict=True):
            sides.setdefault(key, []).append((place, island))
    own, other, at = [np.zeros((0, 2))], [np.zeros((0, 2))], [np.zeros(0, np.int64)]
    for pair in sides.values():
        if len(pair) != 2 or np.array_equal(pair[0][0], pair[1][0]):
            continue
        length = size * max(np.linalg.norm(side[1] - side[0]) for side, _ in pair)
        t = np.linspace(0, 1, max(int(np.ceil(4 * length)), 1) + 1)[:, None]
        first, second = (side[0] + t * (side[1] - side[0]) for side, _ in pair)
        own += [first, second]
        other += [second, first]
        at += [np.full(len(t), island) for _, island in pair]
    return np.concatenate(own), np.concatenate(other), np.concatenate(at)
