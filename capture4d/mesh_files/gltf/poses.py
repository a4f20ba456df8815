"""Vertices as morph targets and skins hold them in the scene, which is how the file looks when it is opened."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from capture4d.errors import InputError
from capture4d.mesh_files.gltf.accessors import accessor_values
from capture4d.mesh_files.gltf.document import MOST, Document

__all__ = ["World", "morphed", "skinned"]

World = Mapping[int, Float64[np.ndarray, "4 4"]]
"""The transforms of the nodes of a scene, by number."""


def morphed(
    document: Document,
    mesh: dict[str, Any],
    described: dict[str, Any],
    node: dict[str, Any],
    vertices: Float32[np.ndarray, "verts 3"],
) -> Float32[np.ndarray, "verts 3"]:
    """Vertices with the morph targets whose weights are not 0."""
    targets = described.get("targets") or []
    weights = np.asarray(node.get("weights", mesh.get("weights", [])), np.float64)
    if not targets or not weights.any():
        return vertices
    if weights.shape != (len(targets),) or not np.isfinite(weights).all():
        raise InputError(f"weights: expected {len(targets)} finite numbers, found {len(weights)}")
    if np.count_nonzero(weights) * len(vertices) > MOST:
        raise InputError(f"expected morph targets of at most {MOST} vertices in all, found more")
    moved = vertices.astype(np.float64)
    for weight, target in zip(weights, targets, strict=True):
        if weight and "POSITION" in target:
            offsets = accessor_values(document, target["POSITION"])
            if offsets.shape != vertices.shape:
                raise InputError(f"morph target: expected shape {vertices.shape}, found {offsets.shape}")
            moved += weight * offsets
    return moved.astype(np.float32)


def skinned(
    document: Document,
    index: Any,
    attribute: Callable[[str, tuple[int, ...]], np.ndarray],
    names: tuple[str, ...],
    vertices: Float32[np.ndarray, "verts 3"],
    world: World,
) -> tuple[Float32[np.ndarray, "verts 3"], bool]:
    """Vertices that hang from joints, whatever their own node says, and whether the joints mirror them."""
    skin = document.entry("skins", index)
    joints = skin.get("joints") or []
    absent = [joint for joint in joints if type(joint) is not int or joint not in world]
    if absent or not joints:
        raise InputError(f"skins[{index}]: expected joints in the scene, found {str(absent or None)[:40]}")
    places = np.stack([world[joint] for joint in joints])
    if skin.get("inverseBindMatrices") is not None:
        inverse = accessor_values(document, skin["inverseBindMatrices"])
        if inverse.shape[1] != 16 or len(inverse) < len(joints):
            raise InputError(
                f"skins[{index}]: expected a matrix of each of {len(joints)} joints, found {inverse.shape}"
            )
        places = places @ inverse[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)
    moved, total = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for group in range(len(names)):
        if f"JOINTS_{group}" not in names:
            break
        which, weights = attribute(f"JOINTS_{group}", (4,)), attribute(f"WEIGHTS_{group}", (4,))
        if which.dtype.kind != "u" or (which.size and which.max() >= len(joints)):
            raise InputError(f"JOINTS_{group}: expected numbers from 0 to {len(joints) - 1}, found others")
        for joint, weight in zip(which.T, weights.astype(np.float64).T, strict=True):
            turned = np.einsum("vij,vj->vi", places[joint, :3, :3], vertices, dtype=np.float64)
            moved += weight[:, None] * (turned + places[joint, :3, 3])
            total += weight
    if not (total > 0).all():
        raise InputError("WEIGHTS_0: expected a weight at every vertex, found none at some")
    return (moved / total[:, None]).astype(np.float32), bool(np.linalg.det(places[:, :3, :3]).mean() < 0)
