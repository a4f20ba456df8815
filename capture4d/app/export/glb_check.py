"""What a GLB shows at the times of its frames, by the reader that reads other makers' files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from capture4d.errors import InputError
from capture4d.files.reading import reading
from capture4d.mesh_files.animated.moving_mesh import MovingMesh
from capture4d.mesh_files.gltf.accessors import accessor_values
from capture4d.mesh_files.gltf.document import Document, open_document
from capture4d.mesh_files.gltf.primitives import primitives

__all__ = ["largest_glb_difference"]

_LOOKED_AT = 24
"""Frames, evenly over the take; each has every target read."""


def largest_glb_difference(path: Path, moving: MovingMesh) -> float:
    """How far any vertex is from its place, metres, in frames evenly over the take.

    Raises:
        InputError: times, faces or vertices are others; says which.
    """
    with reading(path, "GLB file"):
        document = open_document(path)
        keys = _keys(document)
        count = len(moving.frame_ids)
        wanted = moving.times_s() - moving.times_s()[0]
        for times, _, _, values in keys:
            if (
                len(times) != count
                or len(values) != count
                or np.abs(times - wanted).max() > 1e-3 / max(moving.fps or 1, 1)
            ):
                raise InputError("read back: expected the times of the frames that were written, found others")
        chosen, largest = set(np.linspace(0, count - 1, min(count, _LOOKED_AT)).round().astype(int).tolist()), 0.0
        for frame, vertices in enumerate(moving.frames()):
            if frame in chosen:
                largest = max(largest, _difference(document, keys, frame, vertices, moving))
    return largest


def _keys(document: Document) -> list[tuple[np.ndarray, int, str, np.ndarray]]:
    """Of each channel of the first animation: times, node, what of it, and a row of values for each time."""
    if not document.tree.get("animations"):
        return []
    animation, found = document.entry("animations", 0), []
    for channel in animation["channels"]:
        sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
        times = accessor_values(document, sampler["input"])[:, 0].astype(np.float64)
        values = accessor_values(document, sampler["output"]).reshape(len(times), -1)
        found.append((times, target["node"], target["path"], values))
    return found


def _difference(
    document: Document,
    keys: list[tuple[np.ndarray, int, str, np.ndarray]],
    frame: int,
    vertices: np.ndarray,
    moving: MovingMesh,
) -> float:
    for _, node, what, values in keys:
        document.entry("nodes", node)[what] = values[frame].astype(np.float64).tolist()
    (found,) = primitives(document)
    number = found.attribute("_VERTEX", (1,))[:, 0].astype(np.int64)
    if not np.array_equal(np.unique(number), np.arange(len(vertices))):
        raise InputError(f"read back: expected {len(vertices)} vertices, found others")
    if not np.array_equal(number[found.faces], moving.mesh.faces):
        raise InputError("read back: expected the faces that were written, found others")
    return float(np.linalg.norm(found.vertices.astype(np.float64) - vertices[number], axis=1).max())
