"""Reading what registration, or whoever writes a sequence of the same form, left in a work folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from capture4d.errors import InputError
from capture4d.records import load_garment
from capture4d.scans import Capture, read_capture
from capture4d.types import RegisteredSequence
from capture4d.workdir import read_json

__all__ = ["failed_frames", "load_registration", "registered_digest", "work_capture"]


def load_registration(folder: Path) -> RegisteredSequence:
    """Read a finished registration; the vertices stay on disk until they are touched."""
    garment = load_garment(folder / "garment.npz")
    frame_ids = [int(path.stem) for path in sorted((folder / "frames").glob("*.npz"))]
    residual = []
    for frame_id in frame_ids:
        with np.load(folder / "frames" / f"{frame_id:06d}.npz", allow_pickle=False) as arrays:
            residual.append(arrays["residual_m"])
    vertices = np.load(folder / "vertices.npy", mmap_mode="r", allow_pickle=False)
    return RegisteredSequence(garment, vertices, np.array(residual, np.float32), np.array(frame_ids, np.int32))


def registered_digest(work: Path) -> str:
    """The digest of WORK/registration, whichever stage made it.

    Raises:
        InputError: there is none, or it is unfinished.
    """
    record_path = work / "registration" / "stage.json"
    if not record_path.is_file():
        raise InputError(f"{work}: expected a work folder with a registration, found none; run: capture4d run CAPTURE "
                         f"--output {work}")  # fmt: skip
    record = read_json(record_path)
    if record.get("status") != "complete":
        raise InputError(f"{work / 'registration'}: '{record.get('stage')}' is not finished; run its command again")
    return record["digest"]


def failed_frames(work: Path) -> set[int]:
    """Frames whose registration failed; empty where nobody graded them."""
    path = work / "registration" / "metrics.jsonl"
    if not path.is_file():
        return set()
    records = [json.loads(line) for line in path.read_text().splitlines()]
    return {record["frame_id"] for record in records if record.get("verdict") == "failed"}


def work_capture(work: Path) -> Capture:
    """The capture a work folder was made from.

    Raises:
        InputError: the folder does not say, or the capture is not where it was.
    """
    record_path = work / "garment" / "stage.json"
    place = read_json(record_path).get("sources", {}).get("capture") if record_path.is_file() else None
    if place is None:
        raise InputError(f"{work}: expected the scans' garments of 'extract', found none; run: capture4d extract "
                         f"CAPTURE --output {work}")  # fmt: skip
    return read_capture(place)
