"""What one scan says of the colours of the template.

From each place a ray along the normal and one against it look for the scan, then the nearest point of the scan may
answer; its colour is interpolated between the three vertices of the face, which are sharpened before by what that
blurs. An answer weighs the less the farther away
it is, and the more it faces another way; next to a scan's open border, where its vertices mix cloth with what is beside
it, it hardly weighs at all.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8

from capture4d.geometry.mesh import boundary_edges, normalised, vertex_normals
from capture4d.geometry.mesh_kernels import laplacian_pass
from capture4d.geometry.ray_casting import TriangleScene, barycentric
from capture4d.geometry.uv_raster import UvRaster
from capture4d.types import GarmentScan

__all__ = ["ColouredScan", "SeenColours", "as_bytes", "sharpened", "surface_blocks"]

GATE = 0.5
"""Least cosine between the normals of template and scan."""
HALF_M = 0.5
"""Of the distance that is looked through: where an answer's weight has fallen to 1/e."""
BESIDE_BORDER = 0.02
"""Weight next to a scan's open border."""
SMOOTHED = 2
"""How often normals of a scan are averaged with their neighbours': the noise of vertices goes, folds stay."""
ALIKE_NOISE, ALIKE_SEEN = -0.2, 0.07
"""Correlation between neighbours of what a step towards the neighbours' mean takes away: just above that of plain cloth
(-0.21; -0.22 where all is noise of each vertex), and that of a print of blobs six spacings wide."""
BLOCK = 1 << 18
"""Places that are looked up together: memory does not grow with the picture."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenColours:
    """Colours at n places of the template."""

    colours: Float32[np.ndarray, "n 3"]
    """sRGB, 0 to 255; 0 where nothing is seen."""
    normals: Float32[np.ndarray, "n 3"]
    """Of the scan there, world."""
    weights: Float32[np.ndarray, " n"]
    """0 where nothing is seen, at most 1."""


class ColouredScan:
    """A garment's scan that is looked up. Its colours must be there.

    Args:
        distance_m: how far from a place the scan is looked for.
    """

    def __init__(self, scan: GarmentScan, distance_m: float) -> None:
        assert scan.colours is not None
        mesh, self._far = scan.mesh, distance_m
        self._colours = sharpened(scan.colours, mesh.faces)
        self._faces, self._scene = mesh.faces, TriangleScene((mesh.vertices, mesh.faces))
        normals: Any = vertex_normals(mesh.vertices.astype(np.float64), mesh.faces)
        for _ in range(SMOOTHED):
            normals = laplacian_pass(normals, mesh.faces, np.zeros(len(normals), bool))
        self._normals = normalised(normals)
        self._trust = np.ones(len(mesh.vertices), np.float32)
        self._trust[boundary_edges(mesh.faces)] = BESIDE_BORDER

    def seen_from(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> SeenColours:
        """Look it up.

        Args:
            points: on the registered template, metres, world.
            normals: of the template there, of length 1.
        """
        points, normals = points.astype(np.float32), normals.astype(np.float32)
        found = SeenColours(np.zeros_like(points), np.zeros_like(points), np.zeros(len(points), np.float32))
        nearest = np.full(len(points), np.inf, np.float32)

        def accept(index: np.ndarray, distance: np.ndarray, face: np.ndarray, uv: np.ndarray) -> None:
            near = (distance <= self._far) & (distance < nearest[index])
            index, distance, face, uv = index[near], distance[near], face[near], uv[near]
            corners, shares = self._faces[face], barycentric(uv)
            turned = normalised(np.einsum("nk,nkc->nc", shares, self._normals[corners]))
            cosine = np.einsum("nc,nc->n", turned, normals[index])
            good = cosine >= GATE
            index, corners, shares, turned = index[good], corners[good], shares[good], turned[good]
            nearest[index] = distance[good]
            weight = cosine[good] * np.exp(-((distance[good] / (HALF_M * self._far)) ** 2))
            found.weights[index] = weight * self._trust[corners].min(axis=1)
            found.colours[index] = np.einsum("nk,nkc->nc", shares, self._colours[corners])
            found.normals[index] = turned

        for direction in (normals, -normals):
            met = self._scene.cast(np.concatenate([points, direction], axis=1))
            hit = np.flatnonzero(np.isfinite(met.distance))
            accept(hit, met.distance[hit], met.faces[hit], met.uv[hit])
        missing = np.flatnonzero(found.weights == 0)
        if len(missing):
            close = self._scene.nearest(points[missing])
            accept(missing, np.linalg.norm(close.points - points[missing], axis=1), close.faces, close.uv)
        return found


def sharpened(
    colours: UInt8[np.ndarray, "verts 3"], faces: Int32[np.ndarray, "faces 3"]
) -> Float32[np.ndarray, "verts 3"]:
    """Colours that are no longer blurred when they are interpolated over the faces, as far as they are no noise.

    Between points at a distance h interpolation blurs with a variance of h^2 / 6 along each axis, and each has gathered
    the colours around it, h^2 / 12. Half a step towards the neighbours' mean blurs by the sum of both, h^2 / 4: what it
    takes away is added. Of noise each vertex has its own, so that what is added for it differs between neighbours as
    nothing that was seen does; as much as is noise is left out.
    """
    levels, border = colours.astype(np.float64), np.zeros(len(colours), bool)
    border[boundary_edges(faces)] = True
    border[faces[border[faces].any(axis=1)]] = True  # they have neighbours that mix cloth with what is beside it
    detail: Any = levels - laplacian_pass(levels, faces, border)
    size = np.linalg.norm(detail, axis=1)
    usual = max(float(np.median(size[~border])) if not border.all() else 0.0, 1e-9)
    capped = detail / np.maximum(size / usual, 1)[:, None]  # the edge of a painted border does not speak for the rest
    a, b, c = (capped[faces[:, corner]] for corner in range(3))
    alike = (a * b + b * c + c * a).sum() / max(float((a * a + b * b + c * c).sum()), 1e-9)
    share = np.clip((alike - ALIKE_NOISE) / (ALIKE_SEEN - ALIKE_NOISE), 0, 1)
    return np.clip(levels + share * detail, 0, 255).astype(np.float32)


def surface_blocks(
    raster: UvRaster, vertices: Float[np.ndarray, "verts 3"], faces: np.ndarray
) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Texels, a block at a time, with their places and normals on a posed template."""
    places, normals = vertices.astype(np.float64), vertex_normals(vertices.astype(np.float64), faces)
    for start in range(0, len(raster.texels), BLOCK):
        block = slice(start, start + BLOCK)
        part = raster.part(block)
        yield block, part.at_vertices(places), normalised(part.at_vertices(normals))


def as_bytes(values: np.ndarray) -> UInt8[np.ndarray, "..."]:
    """The nearest levels."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
