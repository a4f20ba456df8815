"""A work folder from outside: its registered sequence, and the body and poses that moved the template.

registration/garment.npz, frames/000123.npz and vertices.npy are read by every stage after registration, whoever wrote
them: registration itself, or an animated model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.body.anny import load_anny
from capture4d.captures.capture import (
    Capture,
    capture_digest,
    read_body,
    read_capture,
    read_poses,
)
from capture4d.errors import InputError, StaleError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import (
    read_json,
    read_json_lines,
    write_npy_rows,
)
from capture4d.files.records import load_body, load_garment, load_poses
from capture4d.runs.stage import Stage, require_complete
from capture4d.types import Body, PoseSequence, RegisteredSequence

__all__ = [
    "ANIMATE",
    "REGISTER",
    "VERDICTS",
    "capture_path",
    "captured_motion",
    "failed_frames",
    "find_moving_body",
    "is_animated",
    "load_moving_body",
    "load_records",
    "load_registration",
    "load_tracking",
    "registered_digest",
    "stack_vertices",
    "tracking_digest",
    "work_capture",
]


def tracking_digest(folder: Path, capture: Path) -> str:
    """Digest of a finished tracking.

    Raises:
        InputError: it is missing, unfinished, or that of other scans.
    """
    command = f"capture4d track {capture} --output {folder.parent}"
    return require_complete(folder, "track", command, made_from={"capture": capture_digest(read_capture(capture))})


def load_tracking(folder: Path) -> tuple[Body, PoseSequence]:
    """The tracked body and its poses."""
    return load_body(folder / "body.npz"), load_poses(folder / "poses.npz")


VERDICTS = ("good", "check", "failed")
"""What a frame's file holds as a number."""


REGISTER, ANIMATE = "register", "animate"
"""Stages that write a registered sequence."""


def load_registration(folder: Path) -> RegisteredSequence:
    """Read a finished WORK/registration; the vertices stay on disk until they are touched."""
    garment = load_garment(folder / "garment.npz")
    frame_ids = [int(path.stem) for path in sorted((folder / "frames").glob("*.npz"))]
    residual = []
    for frame_id in frame_ids:
        with ArrayFile(folder / "frames" / f"{frame_id:06d}.npz") as arrays:
            residual.append(arrays["residual_m"])
    path = folder / "vertices.npy"
    try:
        vertices = np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; run the command of '{folder.name}' again") from None
    except (ValueError, EOFError) as error:
        raise InputError(f"{path}: expected the vertices of all frames, found a damaged file ({error})") from None
    if len(vertices) != len(frame_ids):
        raise InputError(f"{path}: expected vertices of {len(frame_ids)} frames, found {len(vertices)}")
    return RegisteredSequence(garment, vertices, np.array(residual, np.float32), np.array(frame_ids, np.int32))


def stack_vertices(stage: Stage, frame_ids: Sequence[int]) -> None:
    """Write vertices.npy from the frames, one by one, so that memory does not grow with the take."""

    def frames() -> Iterator[np.ndarray]:
        for frame_id in frame_ids:
            with np.load(stage.frame_path(frame_id), allow_pickle=False) as arrays:
                yield arrays["vertices"]

    write_npy_rows(stage.path / "vertices.npy", frames(), count=len(frame_ids))


def load_records(folder: Path) -> list[dict[str, Any]]:
    """The frames' measures and verdicts, from WORK/registration/metrics.jsonl."""
    return read_json_lines(folder / "metrics.jsonl")


def failed_frames(work: Path) -> set[int]:
    """Frames whose registration failed; empty where nobody graded them."""
    folder = work / "registration"
    if not (folder / "metrics.jsonl").is_file():
        return set()
    return {record["frame_id"] for record in load_records(folder) if record.get("verdict") == "failed"}


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


def is_animated(work: Path) -> bool:
    """Whether the sequence comes from a model, not from scans."""
    record = work / "registration" / "stage.json"
    return record.is_file() and read_json(record).get("stage") == ANIMATE


def capture_path(work: Path) -> Path:
    """Where the capture lies: as the first stage recorded it, or else inside the work folder.

    Raises:
        InputError: it is in neither place.
    """
    record = work / "garment" / "stage.json"
    recorded = read_json(record).get("sources", {}).get("capture") if record.is_file() else None
    for candidate in (recorded, work / "capture"):
        if candidate is not None and (Path(candidate) / "capture.json").is_file():
            return Path(candidate)
    raise InputError(f"{work}: expected the capture at {recorded or work / 'capture'}, found none there")


def work_capture(work: Path) -> Capture:
    """The capture a work folder was made from.

    Raises:
        InputError: there are no scans' garments, or the capture is not where it was.
    """
    if not (work / "garment" / "stage.json").is_file():
        raise InputError(f"{work}: expected the scans' garments of 'extract', found none; run: capture4d extract "
                         f"CAPTURE --output {work}")  # fmt: skip
    return read_capture(capture_path(work))


def captured_motion(capture: Capture) -> tuple[Body | None, PoseSequence | None]:
    """The body and the poses that a capture brings; the built-in body where poses come without one.

    Raises:
        InputError: a scan has no pose.
    """
    body, poses = read_body(capture), read_poses(capture)
    return (load_anny() if body is None and poses is not None else body), poses


def load_moving_body(work: Path) -> tuple[Body, PoseSequence]:
    """The body and the poses with which a take was registered.

    Raises:
        InputError: there are none.
    """
    moving = find_moving_body(work)
    if moving is None:
        capture = capture_path(work)
        raise InputError(f"{work}: expected poses in {capture}, found none; track the body and register again")
    return moving


def find_moving_body(work: Path) -> tuple[Body, PoseSequence] | None:
    """The same, or None: those that were tracked, or those of the capture."""
    if is_animated(work):
        return load_tracking(work / "body")
    upstream = read_json(work / "registration" / "stage.json").get("upstream", {})
    if "body" in upstream:
        if require_complete(work / "body", "track", f"capture4d track CAPTURE --output {work}") != upstream["body"]:
            raise StaleError(f"{work}: expected the body with which it was registered, found another; run: capture4d "
                             f"register CAPTURE --output {work} --tracked --overwrite")  # fmt: skip
        return load_tracking(work / "body")
    body, poses = captured_motion(read_capture(capture_path(work)))
    return None if body is None or poses is None else (body, poses)
