"""What a GLB shows at the times of its frames, by the reader that reads other makers' files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from capture4d.errors import InputError
from capture4d.files.reading import reading
from capture4d.mesh_files.animated.glb import GlbMotion
from capture4d.mesh_files.animated.moving_mesh import MovingMesh

__all__ = ["largest_glb_difference"]

_LOOKED_AT = 24
"""Frames, evenly over the take; each has every target read."""


def largest_glb_difference(path: Path, moving: MovingMesh) -> float:
    """How far any vertex is from its place, metres, in frames evenly over the take.

    Raises:
        InputError: times, faces or vertices are others; says which.
    """
    with reading(path, "GLB file"):
        motion, count = GlbMotion.of(path), len(moving.frame_ids)
        wanted = moving.times_s() - moving.times_s()[0]
        near = 1e-3 / max(moving.fps or 1, 1)
        if motion.channels and (len(motion.times_s) != count or np.abs(motion.times_s - wanted).max() > near):
            raise InputError("read back: expected the times of the frames that were written, found others")
        chosen, largest = set(np.linspace(0, count - 1, min(count, _LOOKED_AT)).round().astype(int).tolist()), 0.0
        for frame, vertices in enumerate(moving.frames()):
            if frame in chosen:
                largest = max(largest, _difference(motion, frame, vertices, moving))
    return largest


def _difference(motion: GlbMotion, frame: int, vertices: np.ndarray, moving: MovingMesh) -> float:
    found = motion.surface(frame)
    number = found.attribute("_VERTEX", (1,))[:, 0].astype(np.int64)
    if not np.array_equal(np.unique(number), np.arange(len(vertices))):
        raise InputError(f"read back: expected {len(vertices)} vertices, found others")
    if not np.array_equal(number[found.faces], moving.mesh.faces):
        raise InputError("read back: expected the faces that were written, found others")
    return float(np.linalg.norm(found.vertices.astype(np.float64) - vertices[number], axis=1).max())
