"""Border loops of a garment file: whether they run along the open edges of its template."""

from __future__ import annotations

import numpy as np

from capture4d.errors import InputError
from capture4d.types import Garment

__all__ = ["on_open_edges"]


def on_open_edges(garment: Garment) -> Garment:
    """The garment, if each of its loops is a closed chain of open edges.

    Vertices at one place count as one: a template that is split at the seams of its UVs has loops all the same.

    Raises:
        InputError: a loop steps from a vertex to one that no open edge joins to it.
    """
    if not garment.loops:
        return garment
    mesh = garment.template
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    place = place.reshape(-1)
    split, welded = _open_edges(mesh.faces, len(place)), _open_edges(place[mesh.faces], len(place))
    for name, loop in garment.loops.items():
        after = np.roll(loop, -1)
        good = np.isin(_keys(loop, after, len(place)), split)
        good |= np.isin(_keys(place[loop], place[after], len(place)), welded) | (place[loop] == place[after])
        if not good.all():
            at = int(np.flatnonzero(~good)[0])
            raise InputError(
                f"Garment.loops[{name!r}]: expected steps along open edges of the template, found one from vertex "
                f"{loop[at]} to {after[at]}"
            )
    return garment


def _open_edges(faces: np.ndarray, count: int) -> np.ndarray:
    """Of edges that one face uses, the keys."""
    keys, uses = np.unique(
        np.concatenate([_keys(faces[:, side], faces[:, (side + 1) % 3], count) for side in range(3)]),
        return_counts=True,
    )
    return keys[uses == 1]


def _keys(start: np.ndarray, end: np.ndarray, count: int) -> np.ndarray:
    return np.minimum(start, end).astype(np.int64) * count + np.maximum(start, end)
