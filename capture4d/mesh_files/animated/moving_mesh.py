"""A mesh that moves: what every format of moving meshes is written from, and what is read from one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32

from capture4d.errors import InputError
from capture4d.types import Mesh
from capture4d.value_checks import require_frame_rate, require_frames

__all__ = ["CLOTH_COLOUR", "MovingMesh", "even_step", "largest_difference"]

Frames = Callable[[], Iterator[np.ndarray]]
CLOTH_COLOUR = (0.03, 0.12, 0.58)
"""Linear colour of what is written without a picture of its colours."""


@dataclass(frozen=True, slots=True, eq=False)
class MovingMesh:
    """One topology, and where its vertices are in each frame. T frames, V vertices."""

    mesh: Mesh
    """Faces and UVs, the vertices of the first frame, or of a template."""
    frame_ids: Int32[np.ndarray, " frames"]
    """Ascending."""
    fps: float | None
    """Frames a second; None where a file does not tell."""
    frames: Frames
    """Begins again each time: (V, 3) float32 of every frame, metres, world, Y up. A take need not fit into memory."""
    normals: Frames | None = None
    """Unit normals (V, 3) of every frame, where a file has them."""

    def __post_init__(self) -> None:
        require_frames("MovingMesh", self.frame_ids)
        if self.fps is not None:
            require_frame_rate("MovingMesh.fps", self.fps)

    def times_s(self) -> np.ndarray:
        """(T,) float64: seconds of each frame, such that frame 0 is at 0.

        Raises:
            InputError: nobody knows its frame rate.
        """
        if self.fps is None:
            raise InputError("expected a frame rate, found none")
        return self.frame_ids.astype(np.float64) / self.fps


def even_step(frame_ids: Int32[np.ndarray, " frames"], kind: str) -> int:
    """Frames from one to the next.

    Args:
        kind: of file that can hold no others, for the message.
    Raises:
        InputError: it is not the same everywhere.
    """
    steps = np.diff(frame_ids)
    if not len(steps):
        return 1
    odd = np.flatnonzero(steps != steps[0])
    if len(odd):
        at = int(odd[0])
        found = f"frame {frame_ids[at + 1]} after frame {frame_ids[at]}"
        raise InputError(f"{kind}: expected frames {steps[0]} apart, which is all that it can hold, found {found}")
    return int(steps[0])


def largest_difference(written: MovingMesh, found: MovingMesh) -> float:
    """How far any vertex of any frame is from its place, metres; what a file is checked by once it is written.

    Raises:
        InputError: frames, faces or UVs are others; says which.
    """
    if found.frame_ids.tolist() != written.frame_ids.tolist():
        raise InputError(f"read back: expected {len(written.frame_ids)} frames, found others or other numbers")
    if found.fps is not None and written.fps is not None and abs(found.fps - written.fps) > 1e-3:
        raise InputError(f"read back: expected {written.fps:g} frames a second, found {found.fps:g}")
    if not np.array_equal(found.mesh.faces, written.mesh.faces):
        raise InputError("read back: expected the faces that were written, found others")
    if written.mesh.uv is not None and (found.mesh.uv is None or not _close(found.mesh.uv, written.mesh.uv)):
        raise InputError("read back: expected the UVs that were written, found others")
    largest = 0.0
    for each, other in zip(written.frames(), found.frames(), strict=True):
        if each.shape != other.shape:
            raise InputError(f"read back: expected {len(each)} vertices, found {len(other)}")
        largest = max(largest, float(np.linalg.norm(each.astype(np.float64) - other, axis=1).max(initial=0)))
    return largest


def _close(found: Float32[np.ndarray, "faces 3 2"], written: Float32[np.ndarray, "faces 3 2"]) -> bool:
    return found.shape == written.shape and bool(np.abs(found - written).max(initial=0) < 1e-6)
