"""Scans as coarse as a screen needs them, made once and kept in a folder: 000123.npz a scan, whole or absent.

A preview is a scan whose vertices are drawn together, cell by cell of a grid, to their mean and the mean of their
colours. It holds which file it was made from: of a scan that was replaced it is made anew.

References: Rossignac and Borrel, Multi-resolution 3D approximations (1993), for clustering vertices.
"""

from __future__ import annotations

import contextlib
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from capture4d.captures.capture import Capture, read_frame, scan_path
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import write_npz
from capture4d.runs.frame_lists import frame_file
from capture4d.runs.workers import run_jobs
from capture4d.types import Mesh

__all__ = ["Preview", "clustered", "prepare", "preview_folder", "scan_preview"]

_FORMAT = 1
Preview = tuple[Mesh, np.ndarray]
"""A mesh, metres, and a colour (sRGB) of each vertex."""


def clustered(
    vertices: Float32[np.ndarray, "verts 3"],
    faces: Int32[np.ndarray, "faces 3"],
    colours: UInt8[np.ndarray, "verts 3"],
    cell_m: float,
) -> Preview:
    """A mesh with one vertex for each cell of a grid that has any, and the faces that are left between three cells.

    Args:
        cell_m: side of a cell, metres.
    """
    if not len(vertices):
        return Mesh(vertices, faces), colours
    cells = np.floor((vertices - vertices.min(axis=0)) / cell_m).astype(np.int64)
    wide = cells.max(axis=0) + 1
    _, at = np.unique((cells[:, 0] * wide[1] + cells[:, 1]) * wide[2] + cells[:, 2], return_inverse=True)
    counts = np.bincount(at)

    def means(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(at, values[:, axis].astype(np.float64)) / counts for axis in range(3)], axis=1)

    corners = at[faces]
    whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    corners = corners[whole]
    # A face begins with its least corner, so that equal faces are equal rows.
    first = np.argmin(corners, axis=1)[:, None]
    turned = np.take_along_axis(corners, (first + np.arange(3)) % 3, axis=1)
    count = len(counts)
    _, kept = np.unique((turned[:, 0] * count + turned[:, 1]) * count + turned[:, 2], return_index=True)
    mesh = Mesh(means(vertices).astype(np.float32), turned[np.sort(kept)].astype(np.int32))
    return mesh, np.rint(means(colours)).astype(np.uint8)


def preview_folder(root: Path, cell_mm: float) -> Path:
    """Where the previews of a work folder, or of a capture without one, are kept: those of another size elsewhere."""
    return root / "view" / f"scans-{cell_mm:g}mm"


def scan_preview(capture: Capture, frame_id: int, folder: Path, cell_mm: float) -> Preview:
    """The preview of a scan, as it is kept, or made and kept now; where nothing can be written it is made alone.

    Raises:
        InputError: the scan is missing or damaged.
    """
    source = scan_path(capture, frame_id)
    state = _state(source)
    path = frame_file(folder, frame_id, within=".")
    with contextlib.suppress(InputError):
        if path.is_file():
            found = _load(path, state)
            if found is not None:
                return found
    scan = read_frame(capture, frame_id)[0]
    mesh, colours = clustered(scan.mesh.vertices, scan.mesh.faces, scan.colours, 1e-3 * cell_mm)
    with contextlib.suppress(OSError):
        _save(path, mesh, colours, state)
    return mesh, colours


def prepare(capture: Capture, folder: Path, cell_mm: float, *, workers: int) -> list[int]:
    """Make the previews of all scans that have none yet; the frames whose scans cannot be read."""
    make = partial(_prepare_one, capture, folder, cell_mm)
    found = run_jobs(make, list(capture.frame_ids), workers=workers, label="previews")
    return sorted(frame_id for frame_id in found if frame_id is not None)


def _prepare_one(capture: Capture, folder: Path, cell_mm: float, frame_id: int) -> int | None:
    try:
        scan_preview(capture, frame_id, folder, cell_mm)
    except InputError:
        return frame_id
    return None


def _state(source: Path) -> np.ndarray:
    found = source.stat()
    return np.array([_FORMAT, found.st_size, found.st_mtime_ns], np.int64)


def _save(path: Path, mesh: Mesh, colours: np.ndarray, state: np.ndarray) -> None:
    """Positions as 16-bit numbers of steps from a corner."""
    low = mesh.vertices.min(axis=0) if len(mesh.vertices) else np.zeros(3, np.float32)
    step = max(float(np.ptp(mesh.vertices, axis=0).max(initial=0.0)), 1e-6) / 65535
    places = np.rint((mesh.vertices - low) / step).astype(np.uint16)
    faces = mesh.faces.astype(np.uint16 if len(places) <= 65536 else np.int32)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_npz(path, state=state, low=low, step=np.float64(step), places=places, faces=faces, colours=colours)


def _load(path: Path, state: np.ndarray) -> Preview | None:
    """None of a preview of another scan than there is now."""
    with ArrayFile(path, kind="preview") as arrays:
        if not np.array_equal(arrays["state"], state):
            return None
        vertices = arrays["low"] + arrays["places"] * np.float32(arrays["step"])
        return Mesh(vertices.astype(np.float32), arrays["faces"].astype(np.int32)), arrays["colours"]
