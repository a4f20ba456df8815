"""The files of `scans/`: which is which frame, and what surface is in one.

One list for all: what `capture4d check` counts is what the stages take.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from capture4d.captures.description import LAST_FRAME
from capture4d.errors import EmptyMeshError, InputError
from capture4d.files.reading import one_line
from capture4d.geometry.mesh import doubled_area_vectors
from capture4d.geometry.point_clouds import faces_between
from capture4d.geometry.seams import weld
from capture4d.mesh_files.meshes import READABLE, read_coloured_mesh
from capture4d.types import Mesh

__all__ = ["KINDS", "ScanFiles", "Surface", "frame_numbers", "is_aside", "list_scans", "read_surface", "whole_surface"]

KINDS = (".ply", ".glb", ".gltf", ".obj", ".off", ".stl")
"""Of several files with one number the first kind counts, and there the first name."""
LARGEST, SMALLEST = 1e9, 1e-4
"""Coordinates, and extents: a thousand kilometres in millimetres, where a float32 knows no person any more, and a tenth
of a millimetre in metres."""
_FEW_FACES = 100
_DIGITS = re.compile("[0-9]+")


@dataclass(frozen=True, slots=True, eq=False)
class ScanFiles:
    """The scans of a folder."""

    scans: Mapping[int, Path]
    """By frame number, ascending."""
    also: Mapping[int, tuple[Path, ...]]
    """Further files with a number that has one already; they are not taken."""


def list_scans(folder: Path, pattern: str | None = None) -> ScanFiles:
    """Find the frames in a folder. Hidden files are no scans, nor is what has no number.

    Args:
        pattern: name of a scan, `{frame}` in place of its number; else `frame_numbers` tells.
    Raises:
        InputError: the pattern has no {frame}, or a number is too large.
    """
    files = [path for path in _files(folder) if path.suffix.lower() in READABLE and not _is_template(path)]
    found: dict[int, list[Path]] = {}
    for path, number in zip(files, _numbers(files, pattern), strict=True):
        if number is None:
            continue
        if number > LAST_FRAME:
            raise InputError(
                f"expected frame numbers up to {LAST_FRAME} in the names of scans, found {number}", where=path
            )
        found.setdefault(number, []).append(path)
    ranked = {
        number: sorted(paths, key=lambda path: KINDS.index(path.suffix.lower()))
        for number, paths in sorted(found.items())
    }
    return ScanFiles(
        scans={number: paths[0] for number, paths in ranked.items()},
        also={number: tuple(paths[1:]) for number, paths in ranked.items() if len(paths) > 1},
    )


def _files(folder: Path) -> list[Path]:
    """The files of a folder that are not hidden, by name."""
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        names = [entry.name for entry in entries if not entry.name.startswith(".") and _is_file(entry)]
    return [folder / name for name in sorted(names)]


def _is_file(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_file()
    except OSError:  # a link that leads to itself
        return False


def is_aside(path: Path) -> bool:
    """Hidden files are no scans; and a folder of scans that is no capture may hold the template as well."""
    return path.name.startswith(".") or _is_template(path)


def _is_template(path: Path) -> bool:
    return path.stem.lower().startswith("template") and path.parent.name != "scans"


def _numbers(files: Sequence[Path], pattern: str | None) -> list[int | None]:
    if pattern is None:
        return frame_numbers([path.stem for path in files])
    if pattern.count("{frame}") != 1:
        raise InputError(f"--pattern: expected a file name with {{frame}} in it once, found '{pattern}'")
    before, after = (re.escape(part) for part in pattern.split("{frame}"))
    named = re.compile(f"{before}([0-9]+){after}", re.IGNORECASE)
    matches = [named.fullmatch(path.name) for path in files]
    return [None if match is None else int(match[1]) for match in matches]


def frame_numbers(stems: Sequence[str]) -> list[int | None]:
    """The frame that each file is, by its name without the ending; None for a name without a number.

    Of the numbers in a name the last one counts that differs between the files that are named alike but for numbers:
    12 in take3_000012 beside take3_000013, and in frame_0012_v2 beside frame_0013_v2. Where none differs, the last.
    """
    alike: dict[str, list[list[int]]] = {}
    for stem in stems:
        alike.setdefault(_DIGITS.sub("0", stem), []).append([int(digits) for digits in _DIGITS.findall(stem)])
    which: dict[str, int] = {}
    for kind, numbers in alike.items():
        columns = range(len(numbers[0]) - 1, -1, -1)
        differing = (column for column in columns if len({row[column] for row in numbers}) > 1)
        which[kind] = next(differing, len(numbers[0]) - 1)
    found: list[int | None] = []
    for stem in stems:
        digits = _DIGITS.findall(stem)
        found.append(int(digits[which[_DIGITS.sub("0", stem)]]) if digits else None)
    return found


# --- what is in a file -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A scan as the stages want it: a surface without seams."""

    mesh: Mesh
    """In the file's unit."""
    colours: UInt8[np.ndarray, "verts 3"] | None
    """sRGB per vertex."""
    estimated: bool
    """The file has points alone; the faces are made between them."""
    notes: tuple[str, ...] = ()
    """What in the file could not be used."""


def read_surface(path: Path) -> Surface:
    """Read one scan.

    Raises:
        InputError: whatever keeps the scan from being read: a take has others.
    """
    try:
        found = read_coloured_mesh(path, faces_needed=False)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or one_line(error)})", where=path) from error
    try:
        _require_extent(found.mesh)
        return replace(whole_surface(found.mesh, found.colours), notes=found.notes)
    except InputError as error:
        raise error.at(path) from None


def _require_extent(mesh: Mesh) -> None:
    """See that there is a surface of any size, in numbers that can be reckoned with."""
    largest = float(np.abs(mesh.vertices).max(initial=0.0))
    if largest > LARGEST:
        raise InputError(f"expected coordinates up to {LARGEST:g}, found {largest:.3g}")
    size = float(np.ptp(mesh.vertices.astype(np.float64), axis=0).max()) if len(mesh.vertices) else 0.0
    if size < SMALLEST:
        raise EmptyMeshError(f"expected a surface, found {len(mesh.vertices)} vertices within {size:.3g}")
    vertices = mesh.vertices.astype(np.float64)
    faces = (mesh.faces[:_FEW_FACES], mesh.faces[_FEW_FACES:])  # the first that has an area is enough
    if len(mesh.faces) and not any(np.any(doubled_area_vectors(vertices, some)) for some in faces):
        raise EmptyMeshError("expected a surface, found all faces without area")


def whole_surface(mesh: Mesh, colours: UInt8[np.ndarray, "verts 3"] | None) -> Surface:
    """A mesh with its seams joined, or the surface of a cloud of points.

    A vertex that is joined takes the mean of the colours on both sides, as it does of a texture's charts.

    Raises:
        InputError: a cloud is no surface.
    """
    if not len(mesh.faces):
        return Surface(Mesh(mesh.vertices, faces_between(mesh.vertices)), colours, estimated=True)
    welded = weld(mesh.vertices, mesh.faces)
    if not welded.is_split:
        return Surface(mesh, colours, estimated=False)
    joined = Mesh(mesh.vertices[welded.first], welded.faces, mesh.uv)
    if colours is not None:
        count = len(welded.first)
        sums = [np.bincount(welded.of_vertex, colours[:, channel], count) for channel in range(3)]
        mean = np.stack(sums, axis=1) / np.bincount(welded.of_vertex, minlength=count)[:, None]
        colours = np.rint(mean).astype(np.uint8)
    return Surface(joined, colours, estimated=False)
