"""A mesh that moves in a glTF file, evaluated frame by frame: its skeleton and morph targets at the times of its keys.

glTF splits vertices along UV seams. `_VERTEX`, an attribute that our exports write and Blender keeps, is the number
that each had before; without it the order of the vertices is the file's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.errors import InputError
from capture4d.files.reading import reading
from capture4d.mesh_files.animated.moving_mesh import MovingMesh
from capture4d.mesh_files.gltf.accessors import accessor_values
from capture4d.mesh_files.gltf.document import Document, open_document
from capture4d.mesh_files.gltf.primitives import Primitive, primitives
from capture4d.types import Mesh

__all__ = ["GlbMotion", "read_glb"]

_MOVED = ("translation", "rotation", "scale", "weights")
_OFF_A_KEY_S = 1e-4
_OFF_A_FRAME = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class _Channel:
    node: int
    what: str
    values: np.ndarray
    """A row for each time."""


@dataclass(frozen=True, slots=True, eq=False)
class GlbMotion:
    """A file's first animation, whose channels have the same times."""

    document: Document
    times_s: np.ndarray
    """(T,) float64; one zero where nothing moves."""
    channels: list[_Channel]

    @staticmethod
    def of(path: Path) -> GlbMotion:
        """
        Raises:
            InputError: the file is damaged, or its channels have different times.
        """
        document = open_document(path)
        times, channels = np.zeros(1), []
        if document.tree.get("animations"):
            animation = document.entry("animations", 0)
            for described in _entries(animation, "channels"):
                target = described.get("target")
                if not isinstance(target, dict) or target.get("path") not in _MOVED or "node" not in target:
                    continue
                at, channel = _channel(document, animation, described, target)
                if channels and (len(at) != len(times) or np.abs(at - times).max() > _OFF_A_KEY_S):
                    raise InputError("expected one list of times for all that moves, found several")
                times = at
                channels.append(channel)
        return GlbMotion(document, times, channels)

    def surface(self, row: int) -> Primitive:
        """What is shown at one of the times.

        Raises:
            InputError: it is not one surface.
        """
        for each in self.channels:
            self.document.entry("nodes", each.node)[each.what] = each.values[row].astype(np.float64).tolist()
        found = list(primitives(self.document))
        if len(found) != 1:
            raise InputError(f"expected one surface with one material, found {len(found)}")
        return found[0]


def _entries(parent: dict[str, Any], name: str) -> list[dict[str, Any]]:
    found = parent.get(name)
    if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
        raise InputError(f"animations[0]: expected a list of {name}, found {str(found)[:40]!r}")
    return found


def _channel(
    document: Document, animation: dict[str, Any], described: dict[str, Any], target: dict[str, Any]
) -> tuple[np.ndarray, _Channel]:
    """The times of a channel, seconds, and its values."""
    samplers, index = _entries(animation, "samplers"), described.get("sampler")
    if type(index) is not int or not 0 <= index < len(samplers):
        raise InputError(f"animations[0]: expected one of {len(samplers)} samplers, found {str(index)[:40]!r}")
    sampler = samplers[index]
    if sampler.get("interpolation") == "CUBICSPLINE":
        raise InputError("expected keys without tangents, found CUBICSPLINE")
    times = accessor_values(document, sampler.get("input"))[:, 0].astype(np.float64)
    values = accessor_values(document, sampler.get("output"))
    if not len(times) or values.size % len(times) or not np.isfinite(times).all():
        raise InputError(f"animations[0]: expected values for each of {len(times)} times, found {values.size}")
    return times, _Channel(target["node"], target["path"], values.reshape(len(times), -1))


def read_glb(path: Path, fps: float | None = None) -> MovingMesh:
    """The one surface of a file in every frame of its first animation.

    Args:
        fps: frames a second; what the scene's extras say, as in our exports, if None.
    Raises:
        InputError: the file is damaged, holds several surfaces, or has keys between frames.
    """
    with reading(path, "GLB file"):
        motion = GlbMotion.of(path)
        said = _extras(motion.document)
        rate = fps or _number(said, "fps", None)
        if rate is None or not 0 < rate < np.inf:
            raise InputError("--fps: expected the frame rate, which this file does not tell, found none")
        first = round(_number(said, "first_frame", 0))
        frames = motion.times_s * rate
        ids = np.rint(frames)
        if np.abs(frames - ids).max() > _OFF_A_FRAME or np.any(np.diff(ids) <= 0):
            raise InputError(f"expected keys at frames of {rate:g} a second, found others")
        shape, number = _numbered(motion.surface(0))
        mesh = Mesh(shape, number[1])
        return MovingMesh(mesh, (first + ids).astype(np.int32), float(rate), partial(_frames, path, len(ids)))


def _frames(path: Path, count: int) -> Iterator[np.ndarray]:
    with reading(path, "GLB file"):
        motion = GlbMotion.of(path)
        for row in range(count):
            yield _numbered(motion.surface(row))[0]


def _numbered(surface: Primitive) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Vertices in the order that they had before they were split; the number of each that is split, and faces."""
    if "_VERTEX" not in surface.names:
        return surface.vertices, (np.arange(len(surface.vertices)), surface.faces)
    number = np.rint(surface.attribute("_VERTEX", (1,))[:, 0]).astype(np.int64)
    known, rows = np.unique(number, return_index=True)
    if not len(known) or not np.array_equal(known, np.arange(len(known))):
        raise InputError("_VERTEX: expected every number from 0 on, found gaps")
    return surface.vertices[rows], (number, number[surface.faces].astype(np.int32))


def _extras(document: Document) -> dict[str, Any]:
    index = document.tree.get("scene", 0)
    if not document.tree.get("scenes"):
        return {}
    found = document.entry("scenes", index).get("extras")
    return found if isinstance(found, dict) else {}


def _number(said: dict[str, Any], name: str, absent: Any) -> Any:
    found = said.get(name, absent)
    return found if isinstance(found, int | float) and np.isfinite(found) else absent
