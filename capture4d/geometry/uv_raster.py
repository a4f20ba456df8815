"""UV rasterisation: which point of a mesh each texel of its map shows. Done once per template.

Row 0 of an image is v = 1 and column 0 is u = 0; texel (row, column) of a map of S x S texels has its centre at
u = (column + 0.5) / S, v = 1 - (row + 0.5) / S. Letters: N texels that show something, F faces, V vertices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Int64

from capture4d.errors import InputError
from capture4d.heavy_imports import njit
from capture4d.types import Mesh

__all__ = ["UvRaster", "rasterise_uv", "sample_bilinear"]

OVERLAP_PERCENT = 1.0
"""Share of the texels that two faces may claim: slivers folded over do no harm, islands on top of each other do."""


@dataclass(frozen=True, slots=True, eq=False)
class UvRaster:
    """The texels of a map that show a mesh, and the surface point each of them shows."""

    size: int
    """Texels along each side of the map."""
    texels: Int64[np.ndarray, " N"]
    """Row times `size` plus column, ascending."""
    faces: Int32[np.ndarray, " N"]
    corners: Int32[np.ndarray, "N 3"]
    """Vertices of the face."""
    barycentric: Float32[np.ndarray, "N 3"]
    """Of the surface point: that of the texel's centre, or the nearest one where the centre is beside the islands."""
    inside: Bool[np.ndarray, " N"]
    """The texel's centre lies on a face."""
    covered: Bool[np.ndarray, " N"]
    """A face touches the texel's square; the other texels are padding."""

    def at_vertices(self, values: Float[np.ndarray, "V C"]) -> Float[np.ndarray, "N C"]:
        """Vertex values interpolated linearly."""
        return np.einsum("nk,nkc->nc", self.barycentric, values[self.corners])

    def at_corners(self, values: Float[np.ndarray, "F 3 C"]) -> Float[np.ndarray, "N C"]:
        """Values of face corners interpolated linearly."""
        return np.einsum("nk,nkc->nc", self.barycentric, values[self.faces])

    def part(self, texels: slice) -> UvRaster:
        """Some of the texels: what they show costs as much less."""
        return UvRaster(
            self.size, self.texels[texels], self.faces[texels], self.corners[texels], self.barycentric[texels],
            self.inside[texels], self.covered[texels],
        )  # fmt: skip

    def image(self, values: np.ndarray, *, background: float | bool = 0) -> np.ndarray:
        """The map (size, size, ...) of texel values (N, ...)."""
        flat = np.full((self.size * self.size, *values.shape[1:]), background, values.dtype)
        flat[self.texels] = values
        return flat.reshape(self.size, self.size, *values.shape[1:])

    def read(self, image: np.ndarray) -> np.ndarray:
        """Texel values (N, ...) of a map (size, size, ...)."""
        return image.reshape(self.size * self.size, *image.shape[2:])[self.texels]


def rasterise_uv(mesh: Mesh, size: int, *, padding: int = 4) -> UvRaster:
    """Find the surface point of every texel.

    Args:
        mesh: with UVs in the unit square.
        padding: texels around the islands that repeat the nearest surface point, so that neither interpolation nor
            a convolution sees the background.
    Raises:
        InputError: there are no UVs, they leave the unit square, or islands overlap.
    """
    if mesh.uv is None:
        raise InputError("template: expected UVs, found none; `capture4d template --uv fresh` cuts some")
    uv = mesh.uv.astype(np.float64)
    low, high = uv.min(initial=0.0), uv.max(initial=0.0)
    if low < -1e-6 or high > 1 + 1e-6:
        raise InputError(f"template: expected UVs in the unit square, found values from {low:.3g} to {high:.3g}")
    centres = np.stack([uv[..., 0] * size - 0.5, (1 - uv[..., 1]) * size - 0.5], axis=-1)
    face, weights, claims, covered = _nearest_faces(centres, size, padding)
    twice = 100 * np.count_nonzero(claims > 1) / max(np.count_nonzero(claims), 1)
    if twice > OVERLAP_PERCENT:
        raise InputError(f"template: expected UV islands side by side, found {twice:.1f} % of the map used twice")
    texels = np.flatnonzero(face.ravel() >= 0)
    faces = face.ravel()[texels]
    barycentric = weights.reshape(-1, 3)[texels]
    return UvRaster(
        size,
        texels,
        faces,
        mesh.faces[faces],
        barycentric.astype(np.float32),
        (claims > 0).ravel()[texels],
        covered.ravel()[texels],
    )


def sample_bilinear(
    image: Float[np.ndarray, "size size C"], uv: Float[np.ndarray, "points 2"]
) -> Float32[np.ndarray, "points C"]:
    """A map at UVs, interpolated between the four nearest texels; beyond the border the outermost texel goes on."""
    size = len(image)
    x = np.clip(uv[:, 0] * size - 0.5, 0, size - 1)
    y = np.clip((1 - uv[:, 1]) * size - 0.5, 0, size - 1)
    column, row = np.minimum(x.astype(int), size - 2), np.minimum(y.astype(int), size - 2)
    right, down = (x - column)[:, None], (y - row)[:, None]
    upper = image[row, column] * (1 - right) + image[row, column + 1] * right
    lower = image[row + 1, column] * (1 - right) + image[row + 1, column + 1] * right
    return (upper * (1 - down) + lower * down).astype(np.float32)


@njit(cache=True)
def _nearest_faces(corners, size, padding):
    """Per texel: its nearest face within reach or -1, the barycentrics there, how many faces hold its centre, touch."""
    face = np.full((size, size), -1, np.int32)
    weights = np.zeros((size, size, 3))
    best = np.full((size, size), np.inf)
    claims = np.zeros((size, size), np.int32)
    covered = np.zeros((size, size), np.bool_)
    for f in range(len(corners)):
        a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if abs(area) < 1e-12:
            continue
        left, right = min(a[0], b[0], c[0]) - padding, max(a[0], b[0], c[0]) + padding
        top, bottom = min(a[1], b[1], c[1]) - padding, max(a[1], b[1], c[1]) + padding
        for y in range(max(int(np.ceil(top)), 0), min(int(np.floor(bottom)), size - 1) + 1):
            for x in range(max(int(np.ceil(left)), 0), min(int(np.floor(right)), size - 1) + 1):
                wa = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / area
                wb = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / area
                wc = 1.0 - wa - wb
                distance = 0.0
                if wa >= 0.0 and wb >= 0.0 and wc >= 0.0:
                    covered[y, x] = True
                    if wa > 1e-6 and wb > 1e-6 and wc > 1e-6:
                        claims[y, x] += 1
                    elif claims[y, x] == 0:
                        claims[y, x] = 1
                else:
                    if _touches(a, b, c, x, y):
                        covered[y, x] = True
                    wa, wb, wc, distance = _nearest_on_border(a, b, c, x, y)
                if distance <= padding and distance < best[y, x]:
                    best[y, x] = distance
                    face[y, x] = f
                    weights[y, x, 0], weights[y, x, 1], weights[y, x, 2] = wa, wb, wc
    return face, weights, claims, covered


@njit(cache=True)
def _nearest_on_border(a, b, c, x, y):
    """Barycentrics of the point of a triangle's border nearest to (x, y), and its distance."""
    best, wa, wb, wc = np.inf, 0.0, 0.0, 0.0
    for k in range(3):
        p, q = (a, b) if k == 0 else ((b, c) if k == 1 else (c, a))
        dx, dy = q[0] - p[0], q[1] - p[1]
        length = dx * dx + dy * dy
        t = 0.0
        if length > 0.0:
            t = min(max(((x - p[0]) * dx + (y - p[1]) * dy) / length, 0.0), 1.0)
        distance = np.hypot(p[0] + t * dx - x, p[1] + t * dy - y)
        if distance < best:
            best = distance
            if k == 0:
                wa, wb, wc = 1.0 - t, t, 0.0
            elif k == 1:
                wa, wb, wc = 0.0, 1.0 - t, t
            else:
                wa, wb, wc = t, 0.0, 1.0 - t
    return wa, wb, wc, best


@njit(cache=True)
def _touches(a, b, c, x, y):
    """Whether a triangle meets the unit square around (x, y): no axis of either separates them."""
    if min(a[0], b[0], c[0]) > x + 0.5 or max(a[0], b[0], c[0]) < x - 0.5:
        return False
    if min(a[1], b[1], c[1]) > y + 0.5 or max(a[1], b[1], c[1]) < y - 0.5:
        return False
    for k in range(3):
        p, q, opposite = (a, b, c) if k == 0 else ((b, c, a) if k == 1 else (c, a, b))
        nx, ny = q[1] - p[1], p[0] - q[0]
        if nx * (opposite[0] - p[0]) + ny * (opposite[1] - p[1]) > 0.0:
            nx, ny = -nx, -ny
        if nx * (x - p[0]) + ny * (y - p[1]) > 0.5 * (abs(nx) + abs(ny)):
            return False
    return True
