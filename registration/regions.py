"""Parts of a garment as an eye sees them: collar, cuffs, hem, sleeves, armpits, shoulders, front, back.

Borders are told by their loops, sleeves and legs by the joints that carry them, armpits and shoulders by the distance
along the cloth from where a sleeve begins, front and back by the way they face at rest. A template that no joints carry
has its borders, and one region for all the rest.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int32
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from capture4d.geometry.mesh import unique_edges, vertex_normals
from capture4d.types import Garment

__all__ = ["find_regions"]

BORDER_BAND_M = 0.03
"""Cloth so near a border belongs to the border's region, metres along the cloth."""
ARMHOLE_BAND_M = 0.08
"""Cloth so near the beginning of a sleeve belongs to armpit or shoulder."""
ARM = re.compile(r"upperarm|lowerarm|forearm|elbow|wrist|hand|(left|right|[lr])_shoulder")
LEG = re.compile(r"upperleg|lowerleg|thigh|calf|shin|knee|ankle|foot|(left|right|[lr])_hip")
"""Joints of the limbs, as our body models call them, lower case."""
LEFT, RIGHT = re.compile(r"\.l$|^l_|left"), re.compile(r"\.r$|^r_|right")
LEAST_VERTICES = 12
"""A region of fewer is given to the rest."""


def find_regions(garment: Garment, joint_names: Sequence[str]) -> dict[str, Int32[np.ndarray, " region"]]:
    """Vertices of every region, by name; each vertex is in one.

    Args:
        joint_names: of the joints that the garment's skin weights are for.
    """
    rest, faces = garment.template.vertices.astype(np.float64), garment.template.faces
    roads = _roads(rest, faces)
    label = np.full(len(rest), "", dtype="<U40")
    weights = garment.skin_weights
    if weights is not None and len(joint_names) == weights.shape[1]:
        normals = vertex_normals(rest, faces)
        label[:] = np.where(normals[:, 2] >= 0, "front", "back")
        for kind, words in (("leg", LEG), ("sleeve", ARM)):
            for side, which in (("left", LEFT), ("right", RIGHT)):
                joints = [bool(words.search(name.lower()) and which.search(name.lower())) for name in joint_names]
                limb = weights[:, joints].sum(axis=1) >= 0.5
                label[limb] = f"{side} {kind}"
                if kind == "sleeve" and limb.any() and not limb.all():
                    _mark_armhole(label, rest, faces, limb, roads, side)
    else:
        label[:] = "cloth"
    for name, loop in garment.loops.items():
        label[_reached(roads, loop, BORDER_BAND_M)] = name.replace("_", " ")
    names, counts = np.unique(label, return_counts=True)
    kept = [str(name) for name, count in zip(names, counts, strict=True) if count >= LEAST_VERTICES]
    found = {name: np.flatnonzero(label == name).astype(np.int32) for name in kept}
    left = np.flatnonzero(~np.isin(label, kept)).astype(np.int32)
    return found | ({"rest": left} if len(left) else {})


def _mark_armhole(
    label: np.ndarray,
    rest: np.ndarray,
    faces: np.ndarray,
    limb: Bool[np.ndarray, " verts"],
    roads: sparse.csr_array,
    side: str,
) -> None:
    """Name the cloth around the beginning of a sleeve: shoulder above its middle, armpit below."""
    edges = unique_edges(faces)
    crossing = edges[limb[edges[:, 0]] != limb[edges[:, 1]]]
    armhole = np.unique(crossing)
    if not len(armhole):
        return
    around = _reached(roads, armhole, ARMHOLE_BAND_M)
    height = rest[armhole, 1]
    above = rest[:, 1] > (height.min() + height.max()) / 2
    label[around & above] = f"{side} shoulder"
    label[around & ~above] = f"{side} armpit"


def _roads(rest: Float64[np.ndarray, "verts 3"], faces: np.ndarray) -> sparse.csr_array:
    """Lengths of the edges, as a graph."""
    edges = unique_edges(faces)
    lengths = np.maximum(np.linalg.norm(rest[edges[:, 1]] - rest[edges[:, 0]], axis=1), 1e-9)
    return sparse.csr_array((lengths, (edges[:, 0], edges[:, 1])), shape=(len(rest), len(rest)))


def _reached(roads: sparse.csr_array, sources: np.ndarray, reach: float) -> Bool[np.ndarray, " verts"]:
    """Vertices within `reach` metres of the sources, along the edges."""
    away = dijkstra(roads, directed=False, indices=np.asarray(sources), min_only=True, limit=reach)
    return np.isfinite(away)
