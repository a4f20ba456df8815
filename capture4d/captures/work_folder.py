"""A work folder from outside: its registered sequence, and the body and poses that moved the template.

registration/garment.npz, frames/000123.npz and vertices.npy are read by every stage after registration, whoever wrote
them: registration itself, or an animated model.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from capture4d.captures.capture import Capture, read_capture
from capture4d.captures.scan_states import replaced_scan
from capture4d.errors import InputError, StaleError
from capture4d.files.arrays import ArrayFile, map_array
from capture4d.files.atomic import (
    read_json_lines,
    write_npy_rows,
)
from capture4d.files.reading import reading
from capture4d.files.records import load_body, load_garment, load_poses
from capture4d.runs.changes import description_changes, frame_changes
from capture4d.runs.frame_lists import counted, frame_file
from capture4d.runs.growing import frames_of
from capture4d.runs.made import Ledger
from capture4d.runs.stage import Stage, complete_record, read_record, require_complete
from capture4d.types import Body, PoseSequence, RegisteredSequence

__all__ = [
    "ANIMATE",
    "IMPORT",
    "REGISTER",
    "VERDICTS",
    "AnyCapture",
    "AnyWork",
    "Place",
    "WorkFolder",
    "load_records",
    "load_registration",
    "load_tracking",
    "open_work",
    "opened_capture",
    "opened_work",
    "path_of",
    "require_from_scans",
    "stack_vertices",
    "tracking_digest",
]

VERDICTS = ("good", "check", "failed")
"""What a frame's file holds as a number."""
REGISTER, ANIMATE, IMPORT = "register", "animate", "import"
"""Stages that write a registered sequence."""


@dataclass(frozen=True, eq=False)
class WorkFolder:
    """WORK as it was when it was opened. What it holds is read when it is first asked for, and once."""

    path: Path
    stages: Mapping[str, Mapping[str, Any]]
    """The stage.json of each of its folders that has one, by the folder's name."""

    def __getstate__(self) -> dict[str, Any]:
        """What travels to another process: not what was read, which is read there if it is needed."""
        return {"path": self.path, "stages": self.stages}

    def now(self) -> WorkFolder:
        """The folder as it is now: itself, unless a stage has written to it since."""
        opened = open_work(self.path)
        return self if self.stages == opened.stages else opened

    @property
    def registered_digest(self) -> str:
        """The digest of registration/, whichever stage made it.

        Raises:
            InputError: there is none, or it is unfinished.
        """
        record = self.stages.get("registration")
        if record is None:
            command = f"capture4d run CAPTURE --output {self.path}"
            raise InputError(f"expected a work folder with a registration, found none; run: {command}", where=self.path)
        if record.get("status") != "complete":
            raise InputError(
                f"'{record.get('stage')}' is not finished; run its command again", where=self.path / "registration"
            )
        return record["digest"]

    @property
    def is_animated(self) -> bool:
        """Whether the sequence comes from a model, not from scans."""
        return self.stages.get("registration", {}).get("stage") == ANIMATE

    @cached_property
    def registered(self) -> RegisteredSequence:
        """The registered sequence; its vertices stay on disk until they are touched."""
        return load_registration(self.path / "registration")

    @cached_property
    def records(self) -> list[dict[str, Any]]:
        """The frames' measures and verdicts."""
        return load_records(self.path / "registration")

    @cached_property
    def failed_frames(self) -> frozenset[int]:
        """Frames whose registration failed; empty where nobody graded them."""
        if not (self.path / "registration" / "metrics.jsonl").is_file():
            return frozenset()
        return frozenset(record["frame_id"] for record in self.records if record.get("verdict") == "failed")

    @property
    def capture_path(self) -> Path:
        """Where the capture lies: as the first stage recorded it, or else inside the work folder.

        Raises:
            InputError: it is in neither place.
        """
        recorded = self.stages.get("garment", {}).get("sources", {}).get("capture")
        for candidate in (recorded, self.path / "capture"):
            if candidate is not None and (Path(candidate) / "capture.json").is_file():
                return Path(candidate)
        raise InputError(
            f"expected the capture at {recorded or self.path / 'capture'}, found none there", where=self.path
        )

    @cached_property
    def capture(self) -> Capture:
        """The capture that the folder was made from.

        Raises:
            InputError: there are no scans' garments, or the capture is not where it was.
        """
        if "garment" not in self.stages:
            command = f"capture4d extract CAPTURE --output {self.path}"
            raise InputError(f"expected the scans' garments of 'extract', found none; run: {command}", where=self.path)
        return read_capture(self.capture_path)

    @cached_property
    def posed_body(self) -> tuple[Body, PoseSequence] | None:
        """The body and the poses with which the take was registered: those that were tracked, or those of the capture.

        Raises:
            StaleError: the body was tracked anew since.
        """
        if self.is_animated:
            return load_tracking(self.path / "body")
        upstream = self.stages.get("registration", {}).get("upstream", {})
        if "body" not in upstream:
            return read_capture(self.capture_path).posed_body
        command = f"capture4d track CAPTURE --output {self.path}"
        if require_complete(self.path / "body", "track", command) != upstream["body"]:
            command = f"capture4d register CAPTURE --output {self.path} --tracked --overwrite"
            raise StaleError(
                f"expected the body with which it was registered, found another; run: {command}", where=self.path
            )
        return load_tracking(self.path / "body")

    def require_posed_body(self) -> tuple[Body, PoseSequence]:
        """The same; raises InputError where nothing moved the template."""
        if self.posed_body is None:
            raise InputError(
                f"expected poses in {self.capture_path}, found none; track the body and register again", where=self.path
            )
        return self.posed_body


def open_work(path: str | Path) -> WorkFolder:
    """Open a work folder, finished or not; what is missing is told when it is asked for."""
    path = Path(path)
    records = {file.parent.name: read_record(file) for file in sorted(path.glob("*/stage.json"))}
    return WorkFolder(path, records)


# --- by path, or open already -------------------------------------------------------------------------------------

Place: TypeAlias = str | Path
AnyCapture: TypeAlias = Capture | Place
AnyWork: TypeAlias = WorkFolder | Place


def opened_capture(capture: AnyCapture) -> Capture:
    """A capture, read if it is a path."""
    return capture if isinstance(capture, Capture) else read_capture(capture)


def opened_work(work: AnyWork) -> WorkFolder:
    """A work folder as it is now."""
    return work.now() if isinstance(work, WorkFolder) else open_work(work)


def path_of(work: AnyWork) -> Path:
    """Where a work folder is, or will be."""
    return work.path if isinstance(work, WorkFolder) else Path(work)


# --- what stages leave -------------------------------------------------------------------------------------------


def tracking_digest(folder: Path, capture: Capture) -> str:
    """Digest of a finished tracking.

    Raises:
        InputError: it is missing, unfinished, or that of other scans.
    """
    command = f"capture4d track {capture.path} --output {folder.parent}"
    return require_from_scans(folder, "track", command, capture)[0]


def require_from_scans(folder: Path, name: str, command: str, capture: Capture) -> tuple[str, Ledger]:
    """The digest of a finished stage that goes by frames, and what its files were made from.

    Raises:
        InputError: it is missing, unfinished, or that of other scans, frames, or entries of capture.json; the message
            says what has changed, and names `command`, which goes on from there.
    """
    record, ledger = complete_record(folder, name, command), Ledger.read(folder)
    made_for = frames_of(record)
    if made_for is None:
        raise StaleError(f"'{name}' is of an earlier version of capture4d; run: {command} --overwrite", where=folder)
    words = frame_changes(sorted({*capture.frame_ids, *made_for}), made_for)  # more than are asked for will do
    said = record.get("description", {})
    words += description_changes(capture.entries(*said), said)
    paths = {frame_id: frame_file(folder, frame_id) for frame_id in {*capture.frame_ids} & {*made_for}}
    replaced = sorted(each for each, path in paths.items() if replaced_scan(ledger, path, capture, each))
    if replaced:
        words.append(counted(replaced, "replaced"))
    if words:
        raise StaleError(f"'{name}' is of the take as it was before ({', '.join(words)}); run: {command}", where=folder)
    return record["digest"], ledger


def load_tracking(folder: Path) -> tuple[Body, PoseSequence]:
    """The tracked body and its poses."""
    return load_body(folder / "body.npz"), load_poses(folder / "poses.npz")


def load_registration(folder: Path) -> RegisteredSequence:
    """Read a finished WORK/registration; the vertices stay on disk until they are touched."""
    garment = load_garment(folder / "garment.npz")
    record = read_record(folder / "stage.json") if (folder / "stage.json").is_file() else {}
    made_for = frames_of(record)
    frame_ids = (
        [int(path.stem) for path in sorted((folder / "frames").glob("*.npz"))] if made_for is None else list(made_for)
    )
    residual = []
    for frame_id in frame_ids:
        with ArrayFile(folder / "frames" / f"{frame_id:06d}.npz") as arrays:
            found = arrays["residual_m"]
            if found.dtype != np.float32 or found.shape != garment.template.vertices.shape[:1]:
                expected = f"{len(garment.template.vertices)} residuals as float32"
                raise InputError(f"expected {expected}, found {found.dtype} of shape {found.shape}")
            residual.append(found)
    path = folder / "vertices.npy"
    vertices = map_array(
        path,
        expected="the vertices of all frames",
        absent=f"no such file; run the command of '{folder.name}' again",
    )
    if len(vertices) != len(frame_ids):
        raise InputError(f"expected vertices of {len(frame_ids)} frames, found {len(vertices)}", where=path)
    with reading(path, "npy file"):
        return RegisteredSequence(garment, vertices, np.array(residual, np.float32), np.array(frame_ids, np.int32))


def stack_vertices(stage: Stage, frame_ids: Sequence[int]) -> None:
    """Write vertices.npy from the frames, one by one, so that memory does not grow with the take."""

    def frames() -> Iterator[np.ndarray]:
        for frame_id in frame_ids:
            with ArrayFile(stage.frame_path(frame_id)) as arrays:
                yield arrays["vertices"]

    write_npy_rows(stage.path / "vertices.npy", frames(), count=len(frame_ids))


def load_records(folder: Path) -> list[dict[str, Any]]:
    """The frames' measures and verdicts, from WORK/registration/metrics.jsonl."""
    return read_json_lines(folder / "metrics.jsonl")
