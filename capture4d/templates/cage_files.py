"""Files in which somebody has marked a cage on a garment mesh: face labels, or curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from capture4d.errors import InputError
from capture4d.files.arrays import map_array
from capture4d.files.atomic import read_json
from capture4d.files.json_values import entry, wholes
from capture4d.files.reading import reading
from capture4d.templates.wrapping import CageMarks

__all__ = ["read_cage"]

KIND = "cage"


def read_cage(path: Path) -> CageMarks:
    """A .npy with a whole number for each triangle of the mesh, as it is read, or a .json
    {"curves": [[vertex, vertex, ...], ...]} with vertices counted from 0.

    Raises:
        InputError: neither, or damaged.
    """
    match path.suffix.lower():
        case ".npy":
            labels = np.array(map_array(path, expected="an array of labels", absent=f"no such {KIND}"))
            if (
                labels.ndim != 1
                or labels.dtype.kind not in "iu"
                or np.abs(labels.astype(float)).max(initial=0) >= 2**31
            ):
                raise InputError(
                    f"expected a whole number below 2^31 for each triangle, found {labels.dtype} {labels.shape}",
                    where=path,
                )
            return CageMarks(labels=labels.astype(np.int32), source=str(path))
        case ".json":
            with reading(path, KIND, absent=f"no such {KIND}"):
                rows = entry(read_json(path), "curves")
                if not isinstance(rows, list) or not rows:
                    raise InputError("expected a list of curves as 'curves', found none")
                curves = [wholes(row, f"curves[{number}]") for number, row in enumerate(rows)]
                short = next((number for number, curve in enumerate(curves) if len(curve) < 2), None)
                if short is not None:
                    raise InputError(f"expected two or more vertices, found {len(curves[short])} in curves[{short}]")
            return CageMarks(curves=tuple(np.array(curve, np.int32) for curve in curves), source=str(path))
        case _:
            raise InputError(f"expected a cage as .npy or .json, found '{path.suffix}'", where=path)
