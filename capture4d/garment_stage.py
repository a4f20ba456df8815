"""The stage that cuts the garment out of every scan: CAPTURE in, WORK/garment out.

The colours must be in the first frame, or else capture.json is wrong. In a later frame that lacks them, because the
subject has left the volume or hides a border, the reason is written instead of a garment, and registration flags it.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from capture4d.errors import InputError
from capture4d.garment_extraction import ColourNotFoundError, extract_garment
from capture4d.scans import Capture, capture_digest, read_capture, read_scan, scan_path
from capture4d.types import GarmentScan, Mesh
from capture4d.workdir import open_stage, run_jobs, write_npz

__all__ = ["load_garment_scan", "run", "save_garment_scan"]

SCHEMA = 1


@dataclass(frozen=True, slots=True)
class ExtractionSettings:
    """What decides the result, besides the capture; the colours are the capture's."""

    schema: int = SCHEMA


def run(capture: Path, output: Path, *, workers: int = 1, overwrite: bool = False) -> str:
    """Extract the garment of every frame that has none yet; the digest of the result.

    Raises:
        InputError: a scan is missing, damaged, without colours, or without the garment's colours.
    """
    description = read_capture(capture)
    stage = open_stage(
        output,
        name="extract",
        schema=SCHEMA,
        config=ExtractionSettings(),
        upstream={"capture": capture_digest(description)},
        sources={"capture": capture},
        overwrite=overwrite,
    )
    first = description.frame_ids[0]
    if stage.pending([first]):
        save_garment_scan(stage.frame_path(first), extract_frame(description, first))
    jobs = [(frame_id, stage.frame_path(frame_id)) for frame_id in stage.pending(description.frame_ids)]
    for _ in run_jobs(partial(write_frame, description), jobs, workers=workers, label="extract garment"):
        pass
    return stage.finish([stage.frame_path(frame_id) for frame_id in description.frame_ids])


def extract_frame(capture: Capture, frame_id: int) -> GarmentScan:
    """Read one scan and cut its garment out."""
    scan = read_scan(capture, frame_id)
    source = str(scan_path(capture, frame_id))
    return extract_garment(scan, capture.garment_colour, capture.boundary_colours, source=source)


def write_frame(capture: Capture, job: tuple[int, Path]) -> None:
    """Extract one frame and write it, or the reason why there is nothing to write."""
    frame_id, path = job
    try:
        save_garment_scan(path, extract_frame(capture, frame_id))
    except ColourNotFoundError as error:
        write_npz(path, reason=np.array(str(error)))


def save_garment_scan(path: Path, scan: GarmentScan) -> None:
    """Write one garment scan as npz, atomically."""
    write_npz(
        path,
        vertices=scan.mesh.vertices,
        faces=scan.mesh.faces,
        boundary_points=scan.boundary_points,
        boundary_loops=scan.boundary_loops,
        loop_names=np.array(scan.loop_names, dtype=np.str_),
    )


def load_garment_scan(path: Path, frame_id: int) -> GarmentScan:
    """Read a garment scan.

    Raises:
        InputError: the file is missing or damaged, or holds the reason why the frame has no garment.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            if "reason" in arrays:
                raise InputError(str(arrays["reason"]))
            return GarmentScan(
                mesh=Mesh(arrays["vertices"], arrays["faces"]),
                boundary_points=arrays["boundary_points"],
                boundary_loops=arrays["boundary_loops"],
                loop_names=tuple(str(name) for name in arrays["loop_names"]),
                frame_id=frame_id,
            )
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (ValueError, KeyError, EOFError, OSError, zipfile.BadZipFile) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a readable garment scan, cut off or damaged ({error})") from None
