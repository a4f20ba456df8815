"""Landmarks: pairs of a place on the template and its place on the scan, from a text file.

One pair a line, numbers parted by commas or blanks: two whole numbers are a template vertex and a scan vertex, counted
from 0; six numbers are a point of the template and a point of the scan, in the unit of the files. What follows a # is
left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from capture4d.errors import InputError
from capture4d.files.reading import reading
from capture4d.types import Mesh

__all__ = ["Landmarks", "read_landmarks"]

NEAR = 0.05
"""A point of the template lies on it, as a share of its diagonal."""


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Pairs of points in the unit of the files."""

    on_template: Float64[np.ndarray, "marks 3"]
    on_scan: Float64[np.ndarray, "marks 3"]


def read_landmarks(path: Path, template: Mesh, scan: Mesh) -> Landmarks:
    """Read the pairs.

    Raises:
        InputError: with the line: no two whole numbers and no six numbers, a vertex that is not there, a point far
            from the template; or the file names no pair.
    """
    with reading(path, "landmarks"):
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    template_points, scan_points = [], []
    size = float(np.linalg.norm(np.ptp(template.vertices.astype(np.float64), axis=0)))
    tree = KDTree(template.vertices)
    for number, line in enumerate(lines, start=1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        own, other = _pair(words, number, path, template, scan)
        away = float(tree.query(own)[0])
        if away > NEAR * size:
            raise InputError(
                f"line {number}: expected a point on the template, found one that is {away:.4g} away", where=path
            )
        template_points.append(own)
        scan_points.append(other)
    if not template_points:
        raise InputError("expected pairs of landmarks, found none", where=path)
    return Landmarks(np.array(template_points), np.array(scan_points))


def _pair(words: list[str], number: int, path: Path, template: Mesh, scan: Mesh) -> tuple[np.ndarray, np.ndarray]:
    wanted = "two vertex numbers or six coordinates"
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise InputError(f"line {number}: expected {wanted}, found '{' '.join(words)}'", where=path) from None
    if len(values) == 6 and np.isfinite(values).all():
        return values[:3], values[3:]
    if len(values) != 2 or not (np.isfinite(values).all() and (values == np.floor(values)).all()):
        raise InputError(f"line {number}: expected {wanted}, found '{' '.join(words)}'", where=path)
    found = []
    for value, mesh, name in zip(values.astype(int), (template, scan), ("template", "scan"), strict=True):
        if not 0 <= value < len(mesh.vertices):
            raise InputError(
                f"line {number}: expected a vertex of the {name}, 0 to {len(mesh.vertices) - 1}, found {value}",
                where=path,
            )
        found.append(mesh.vertices[value].astype(np.float64))
    return found[0], found[1]
