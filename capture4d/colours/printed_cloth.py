"""Cloth of many colours: what lies between its painted borders is the garment, whatever its colour.

The paint runs along every opening of a garment, so that a scan without its painted vertices falls apart into the cloth,
which has all the paint along it, and into pieces of the body, which have that of one opening each. Specks of the
paint's colour on the cloth, such as blends of two inks, are no paint.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int32, UInt8

from capture4d.colours.labels import FIRST_PAINT, GARMENT, OTHER
from capture4d.geometry.mesh_kernels import face_components

__all__ = ["between_paint", "island_share", "label_print", "without_specks"]

SPECK_SHARE = 0.02
"""Painted pieces with less of all painted vertices are specks: bands are as long as their openings."""
BAND_RIM = 0.15
"""Of a border the paint is all that lies along the cloth, but for blends with it, and of an arm with its cuff much of
it, though the hand lies on the cloth; of a logo hardly any is, though some blobs may have the paint's colour."""
SMALL_SHARE = 0.02
"""Pieces along the paint that have less of the cloth's vertices are torn off it, not pieces of the body."""


def label_print(
    faces: Int32[np.ndarray, "faces 3"], labels: UInt8[np.ndarray, " verts"]
) -> UInt8[np.ndarray, " verts"]:
    """Labels of a scan of printed cloth: garment between the paint, whatever it was taken for; the rest is other.

    Args:
        labels: as `classify_colours` gives them; only the paints' count.
    """
    painted = without_specks(faces, labels >= FIRST_PAINT)
    cloth = between_paint(faces, painted)
    found = np.where(cloth, GARMENT, OTHER).astype(np.uint8)
    found[painted] = labels[painted]
    return found


def without_specks(
    faces: Int32[np.ndarray, "faces 3"], painted: Bool[np.ndarray, " verts"]
) -> Bool[np.ndarray, " verts"]:
    """The painted vertices in pieces that are large enough to be bands."""
    piece = _pieces(faces, painted)
    size = np.bincount(piece[piece >= 0], minlength=len(painted))
    return (piece >= 0) & (size[np.maximum(piece, 0)] >= SPECK_SHARE * painted.sum())


def between_paint(
    faces: Int32[np.ndarray, "faces 3"], painted: Bool[np.ndarray, " verts"]
) -> Bool[np.ndarray, " verts"]:
    """The vertices, without the paint, of the piece of a scan that has the most paint along it, and of what the holes
    of the scan have cut off it."""
    piece = _pieces(faces, ~painted)
    contact = _contact(faces, painted, piece)
    if not contact.any():
        return np.zeros(len(painted), bool)
    main = int(contact.argmax())
    size = np.bincount(piece[piece >= 0], minlength=len(painted))
    own = (contact > 0) & (size < SMALL_SHARE * size[main])
    own[main] = True
    return (piece >= 0) & own[np.maximum(piece, 0)]


def island_share(
    faces: Int32[np.ndarray, "faces 3"], cloth: Bool[np.ndarray, " verts"], painted: Bool[np.ndarray, " verts"]
) -> float:
    """How much lies in islands of other colours in the cloth, as a share of its vertices.

    Borders have the paint along the cloth; pieces of the body have a border there, though hands may touch the cloth.

    Args:
        cloth, painted: vertices of the cloth's main colour, and of the paints.
    """
    piece = _pieces(faces, ~cloth)
    rim = _beside(faces, cloth)
    rim |= _beside(faces, cloth | rim)
    along = np.bincount(piece[rim & (piece >= 0)], minlength=len(cloth))
    painted_along = np.bincount(piece[rim & painted & (piece >= 0)], minlength=len(cloth))
    islands = (along > 0) & (painted_along < BAND_RIM * along)
    size = np.bincount(piece[piece >= 0], minlength=len(cloth))
    return float(size[islands].sum() / max(int(cloth.sum()), 1))


def _beside(faces: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Which vertices outside share a face with one inside."""
    beside = np.zeros(len(inside), bool)
    beside[faces[inside[faces].any(axis=1)].ravel()] = True
    return beside & ~inside


def _pieces(faces: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """The connected piece that each vertex inside belongs to, named by its smallest vertex; -1 for the others."""
    part = face_components(faces, len(inside), inside[faces].all(axis=1))
    piece = np.full(len(inside), -1)
    known = part >= 0
    piece[faces[known]] = part[known, None]
    return piece


def _contact(faces: np.ndarray, other: np.ndarray, piece: np.ndarray) -> np.ndarray:
    """How many vertices of another kind share a face with each piece, by the piece's name."""
    mixed = faces[other[faces].any(axis=1) & ~other[faces].all(axis=1)]
    pairs = np.concatenate([mixed[:, [a, b]] for a in range(3) for b in range(3) if a != b])
    pairs = pairs[other[pairs[:, 0]] & (piece[pairs[:, 1]] >= 0)]
    count = len(other)
    keys = np.unique(pairs[:, 0].astype(np.int64) * count + piece[pairs[:, 1]])
    return np.bincount(keys % count, minlength=count)
