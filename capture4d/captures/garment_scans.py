"""The garment of one scan as a file: WORK/garment/frames/000123.npz."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import write_npz
from capture4d.types import GarmentScan, Mesh

__all__ = ["ESTIMATED", "load_garment_scan", "save_garment_scan"]


ESTIMATED = "faces_estimated"
"""An array that a garment has whose scan is points alone."""


def save_garment_scan(path: Path, scan: GarmentScan, *, estimated: bool = False) -> None:
    """Write one garment scan as npz, atomically.

    Args:
        estimated: the scan is points alone, and its faces are estimated; the file says so.
    """
    write_npz(
        path,
        vertices=scan.mesh.vertices,
        faces=scan.mesh.faces,
        boundary_points=scan.boundary_points,
        boundary_loops=scan.boundary_loops,
        loop_names=np.array(scan.loop_names, dtype=np.str_),
        **({} if scan.colours is None else {"colours": scan.colours}),
        **({ESTIMATED: np.array(True)} if estimated else {}),
    )


def load_garment_scan(path: Path, frame_id: int) -> GarmentScan:
    """Read a garment scan.

    Raises:
        InputError: the file is missing or damaged, or holds the reason why the frame has no garment.
    """
    with ArrayFile(path, kind="garment scan") as arrays:
        if "reason" not in arrays:
            return GarmentScan(
                mesh=Mesh(arrays["vertices"], arrays["faces"]),
                boundary_points=arrays["boundary_points"],
                boundary_loops=arrays["boundary_loops"],
                loop_names=arrays.names("loop_names"),
                frame_id=frame_id,
                **({"colours": arrays["colours"]} if "colours" in arrays else {}),
            )
        reason = str(arrays["reason"])
    raise InputError(reason)  # of the scan, which it names
