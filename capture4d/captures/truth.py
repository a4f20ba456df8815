"""The exact state of a synthetic take, as it lies in CAPTURE/truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from capture4d.captures.capture import Capture
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile, mesh_arrays
from capture4d.files.atomic import write_npz
from capture4d.types import Mesh
from capture4d.value_checks import require_array, require_finite, require_indices

__all__ = [
    "TruthFrame",
    "TruthModel",
    "read_truth_frame",
    "read_truth_model",
    "read_truth_vertices",
    "write_truth_frame",
    "write_truth_model",
]


@dataclass(frozen=True, slots=True, eq=False)
class TruthModel:
    """What the synthetic scanner knows about a take."""

    fine: Mesh
    """The simulated garment in its rest state; its faces and UVs hold for every frame."""
    loops: Mapping[str, Int32[np.ndarray, " loop"]]
    """Border loops of `fine`."""
    template_faces: Int32[np.ndarray, " verts"]
    """Material map: the face of `fine` each vertex of the registration template lies on, ..."""
    template_barycentric: Float32[np.ndarray, "verts 3"]
    """... and where in it."""

    def __post_init__(self) -> None:
        count = len(self.template_faces)
        require_array("TruthModel", "template_faces", self.template_faces, (count,), np.int32)
        require_array("TruthModel", "template_barycentric", self.template_barycentric, (count, 3), np.float32)
        require_indices("TruthModel", "template_faces", self.template_faces, len(self.fine.faces))
        require_finite("TruthModel", "template_barycentric", self.template_barycentric)
        for name, loop in self.loops.items():
            require_array("TruthModel", f"loops[{name!a:.80}]", loop, (None,), np.int32)
            require_indices("TruthModel", f"loops[{name!a:.80}]", loop, len(self.fine.vertices))


@dataclass(frozen=True, slots=True, eq=False)
class TruthFrame:
    """The exact state of one synthetic frame."""

    vertices: Float32[np.ndarray, "fine 3"]
    """Of `TruthModel.fine`, metres."""
    rotations: Float32[np.ndarray, "joints 3 3"]
    translation: Float32[np.ndarray, " 3"]
    labels: UInt8[np.ndarray, " scan"]
    """Per scan vertex: 0 body, 1 garment, 2 painted border."""

    def __post_init__(self) -> None:
        shapes = {"vertices": (None, 3), "rotations": (None, 3, 3), "translation": (3,)}
        for name, shape in shapes.items():
            require_array("TruthFrame", name, getattr(self, name), shape, np.float32)
            require_finite("TruthFrame", name, getattr(self, name))
        require_array("TruthFrame", "labels", self.labels, (None,), np.uint8)


def write_truth_model(path: str | Path, model: TruthModel) -> None:
    write_npz(
        path,
        **mesh_arrays("fine_", model.fine),
        **{f"loop_{name}": loop for name, loop in model.loops.items()},
        template_faces=model.template_faces,
        template_barycentric=model.template_barycentric,
    )


def read_truth_model(capture: Capture) -> TruthModel | None:
    path = capture.path / "truth" / "model.npz"
    if not path.is_file():
        return None
    with ArrayFile(path) as arrays:
        return TruthModel(
            fine=arrays.mesh("fine_"),
            loops=arrays.prefixed("loop_"),
            template_faces=arrays["template_faces"],
            template_barycentric=arrays["template_barycentric"],
        )


def write_truth_frame(path: str | Path, frame: TruthFrame) -> None:
    write_npz(
        path,
        vertices=frame.vertices,
        rotations=frame.rotations,
        translation=frame.translation,
        labels=frame.labels,
    )


def read_truth_frame(capture: Capture, frame_id: int) -> TruthFrame:
    with ArrayFile(_truth_path(capture, frame_id)) as arrays:
        return TruthFrame(arrays["vertices"], arrays["rotations"], arrays["translation"], arrays["labels"])


def read_truth_vertices(
    capture: Capture, frame_id: int, *, model: TruthModel | None = None
) -> Float32[np.ndarray, "fine 3"]:
    """Vertices of the simulated garment in a frame.

    Args:
        model: that it is a state of; one of other vertices is a fault of the frame.
    """
    path = _truth_path(capture, frame_id)
    with ArrayFile(path) as arrays:
        vertices = arrays["vertices"]
    expected = len(vertices) if model is None else len(model.fine.vertices)
    if vertices.shape != (expected, 3) or vertices.dtype != np.float32 or not np.isfinite(vertices).all():
        raise InputError(
            f"expected {expected} finite float32 vertices, found {vertices.dtype} of {vertices.shape}", where=path
        )
    return vertices


def _truth_path(capture: Capture, frame_id: int) -> Path:
    return capture.path / "truth" / f"{frame_id:06d}.npz"
