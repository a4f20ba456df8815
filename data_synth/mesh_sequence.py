"""Mesh sequences from other tools: a folder of mesh files, or one npz with `vertices` (T, V, 3) and `faces` (F, 3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capture4d.captures.scan_files import KINDS, list_scans
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import file_digest
from capture4d.mesh_files.meshes import read_mesh
from capture4d.types import Mesh

__all__ = ["MeshSequence", "open_sequence"]


@dataclass(frozen=True, slots=True, eq=False)
class MeshSequence:
    """Meshes that are read one by one, in the units and axes of their files."""

    path: Path
    files: Mapping[int, Path]
    """Mesh file of each frame number; all the same npz if the sequence is one."""
    arrays: tuple[np.ndarray, np.ndarray] | None = None
    """Vertices (T, V, 3) and faces (F, 3) of an npz: read once, for it has to be unpacked whole."""

    def __reduce__(self) -> tuple[Callable[[Path], MeshSequence], tuple[Path]]:
        """Travels to another process as its path: what an npz holds may be too much to send."""
        return open_sequence, (self.path,)

    @property
    def frame_ids(self) -> tuple[int, ...]:
        return tuple(self.files)

    def read(self, frame_id: int) -> Mesh:
        """One frame's mesh."""
        path = self.files[frame_id]
        if self.arrays is None:
            return read_mesh(path).mesh
        vertices, faces = self.arrays
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # what is no number is found in the mesh
                return Mesh(vertices[frame_id].astype(np.float32), faces.astype(np.int32))
        except InputError as error:
            raise InputError(f"frame {frame_id}: {error.reason}", where=path) from None

    def digest(self) -> str:
        return file_digest(set(self.files.values()), root=self.path if self.path.is_dir() else self.path.parent)


def open_sequence(path: Path) -> MeshSequence:
    """Find the frames of a sequence, by the names that a capture's scans have.

    Raises:
        InputError: there is nothing, or the names do not tell the frames apart.
    """
    if path.is_file() and path.suffix.lower() == ".npz":
        with ArrayFile(path) as arrays:
            vertices, faces = arrays["vertices"], arrays["faces"]
            shape = vertices.shape
            if len(shape) != 3 or shape[2] != 3 or not shape[0] or vertices.dtype.kind not in "iuf":
                raise InputError(f"expected vertices of shape (frames, vertices, 3), found {shape} of {vertices.dtype}")
            if faces.dtype.kind not in "iu" or faces.ndim != 2 or faces.shape[1] != 3:
                raise InputError(f"expected faces of shape (faces, 3), found {faces.shape} of {faces.dtype}")
        return MeshSequence(path, dict.fromkeys(range(shape[0]), path), (vertices, faces))
    if not path.is_dir():
        found = "a file" if path.exists() else "nothing"
        raise InputError(f"expected a folder of mesh files or an npz, found {found}", where=path)
    found = list_scans(path)
    for number, others in found.also.items():
        raise InputError(f"has the frame number {number} of {found.scans[number].name}", where=others[0])
    if not found.scans:
        kinds = ", ".join(KINDS)
        raise InputError(f"expected mesh files with a frame number in their names ({kinds}), found none", where=path)
    return MeshSequence(path, found.scans)
