"""Rays against a limb of a posed body: only the pieces of it that rays come near are made into a tree.

Building a tree takes far longer than what few rays ask of it, and most rays from one limb meet no other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32, Int64

from capture4d.geometry.ray_casting import Hits, TriangleScene
from capture4d.heavy_imports import njit

__all__ = ["LEAVING_M", "LimbPieces", "PosedPieces"]

REACH_M = 0.01
"""Of limbs whose boxes are farther from a vertex and its foot nothing is asked."""
LEAVING_M = 0.002
"""Rays start so far over the skin: where two limbs meet, the other one's skin begins beside it."""

PIECE = 200
"""Faces of a piece, at most."""
BUNDLE = 8
"""Pieces that are looked at together first; those that lie together come one after the other."""
ROUNDING_M = 1e-4
"""Boxes of pieces are larger by this than what is in them; rays are traced in single precision."""


@dataclass(frozen=True, slots=True, eq=False)
class LimbPieces:
    """Faces of a limb, those that lie together one after the other."""

    faces: Int32[np.ndarray, "faces 3"]
    offsets: Int64[np.ndarray, " pieces_plus_1"]
    """Faces of piece p: faces[offsets[p] : offsets[p + 1]]."""

    @staticmethod
    def of(vertices: Float64[np.ndarray, "skin 3"], faces: Int32[np.ndarray, "faces 3"]) -> LimbPieces:
        """Cut at right angles to where it is longest, until pieces are small."""
        pieces = [*_halved(vertices[faces].mean(axis=1), np.arange(len(faces)))]
        return LimbPieces(faces[np.concatenate(pieces)], np.cumsum([0, *(len(piece) for piece in pieces)]))


def _halved(centres: np.ndarray, rows: np.ndarray) -> Iterator[np.ndarray]:
    if len(rows) <= PIECE:
        yield rows
        return
    along = centres[rows, np.ptp(centres[rows], axis=0).argmax()]
    order = rows[np.argsort(along, kind="stable")]
    for half in (order[: len(order) // 2], order[len(order) // 2 :]):
        yield from _halved(centres, half)


class PosedPieces:
    """A limb in one pose.

    Args:
        vertices: of the body, metres.
    """

    def __init__(self, pieces: LimbPieces, vertices: Float64[np.ndarray, "skin 3"]) -> None:
        self._pieces, self._vertices = pieces, vertices
        self._lows, self._highs = _boxes(vertices, pieces.faces, pieces.offsets)
        self._made = np.zeros(len(self._lows), bool)
        self._scene: TriangleScene | None = None

    def cast(
        self,
        feet: Float64[np.ndarray, "verts 3"],
        points: Float64[np.ndarray, "verts 3"],
        outwards: Float64[np.ndarray, "verts 3"],
        strangers: Int64[np.ndarray, " strangers"],
    ) -> tuple[Int64[np.ndarray, " rays"], Hits | None]:
        """What rays from vertices' feet meet first.

        Args:
            feet: nearest points on the limbs that carry the garment's vertices.
            points: the vertices.
            outwards: directions of the rays.
            strangers: the vertices that count.
        Returns:
            Vertices whose rays may meet anything at all, and None where there are none.
        """
        chosen, rays, met = _rays(feet, points, outwards, strangers, self._lows, self._highs)
        if not len(chosen):
            return chosen, None
        if self._scene is None or (met & ~self._made).any():
            self._made |= met
            self._scene = TriangleScene((self._vertices, self._pieces.faces[np.repeat(self._made, self._sizes)]))
        return chosen, self._scene.cast(rays)

    @property
    def _sizes(self) -> np.ndarray:
        return np.diff(self._pieces.offsets)


@njit(cache=True)
def _boxes(vertices, faces, offsets):
    """Least and greatest coordinates of each piece."""
    lows, highs = np.full((len(offsets) - 1, 3), np.inf), np.full((len(offsets) - 1, 3), -np.inf)
    for p in range(len(lows)):
        for f in range(offsets[p], offsets[p + 1]):
            for corner in range(3):
                for k in range(3):
                    x = vertices[faces[f, corner], k]
                    lows[p, k], highs[p, k] = min(lows[p, k], x), max(highs[p, k], x)
    return lows, highs


@njit(cache=True)
def _meets(start, along, low, high):
    """Whether a ray passes through a box."""
    first, last = 0.0, np.inf
    for k in range(3):
        near, far = low[k] - ROUNDING_M - start[k], high[k] + ROUNDING_M - start[k]
        if abs(along[k]) < 1e-12:
            if near > 0.0 or far < 0.0:
                return False
            continue
        near, far = near / along[k], far / along[k]
        first, last = max(first, min(near, far)), min(last, max(near, far))
        if first > last:
            return False
    return True


@njit(cache=True)
def _rays(feet, points, outwards, strangers, lows, highs):
    """Vertices beside a limb whose rays pass through a piece's box, those rays, and which pieces they are.

    Beside: the box around vertex and foot meets that of the limb.
    """
    bundles = (len(lows) + BUNDLE - 1) // BUNDLE
    least, most = np.full((bundles, 3), np.inf), np.full((bundles, 3), -np.inf)
    for p in range(len(lows)):
        for k in range(3):
            least[p // BUNDLE, k] = min(least[p // BUNDLE, k], lows[p, k])
            most[p // BUNDLE, k] = max(most[p // BUNDLE, k], highs[p, k])
    low, high = np.empty(3), np.empty(3)
    for k in range(3):
        low[k], high[k] = least[:, k].min(), most[:, k].max()
    chosen, rays = np.empty(len(strangers), np.int64), np.empty((len(strangers), 6))
    met, count = np.zeros(len(lows), np.bool_), 0
    for n in range(len(strangers)):
        v = strangers[n]
        beside = True
        for k in range(3):
            f, p = feet[v, k], points[v, k]
            beside = beside and max(f, p) > low[k] - REACH_M and min(f, p) < high[k] + REACH_M
        if not beside:
            continue
        for k in range(3):
            rays[count, 3 + k] = outwards[v, k]
            rays[count, k] = feet[v, k] + LEAVING_M * outwards[v, k]
        if not _meets(rays[count, :3], rays[count, 3:], low, high):
            continue
        any_met = False
        for bundle in range(bundles):
            if not _meets(rays[count, :3], rays[count, 3:], least[bundle], most[bundle]):
                continue
            for p in range(BUNDLE * bundle, min(BUNDLE * (bundle + 1), len(lows))):
                if _meets(rays[count, :3], rays[count, 3:], lows[p], highs[p]):
                    met[p] = any_met = True
        if any_met:
            chosen[count] = v
            count += 1
    return chosen[:count], rays[:count], met
