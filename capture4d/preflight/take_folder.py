"""A take as it lies in a folder, before anything about it is believed: which file is which frame, what is said of it.

`capture4d.captures.capture.read_capture` refuses a folder with a fault; here faults are what is looked for.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.body.anny import load_anny
from capture4d.body.posed_surface import BodyState, TrackedBody, tracked_body
from capture4d.body.skinning import ShapedBody, pose_frame, with_shape
from capture4d.captures.capture import Capture, template_path
from capture4d.captures.description import Description, parse_description
from capture4d.captures.scan_files import KINDS, ScanFiles, Surface, is_aside, list_scans, read_surface
from capture4d.colours.spaces import Colour, parse_colour
from capture4d.errors import EmptyMeshError, InputError, NotFiniteError
from capture4d.files.atomic import read_json
from capture4d.files.records import load_body, load_poses, load_rig
from capture4d.preflight.facts import BadFrame, Paints, TakeFacts
from capture4d.types import PoseSequence, Rig
from capture4d.units import METRES, Units

__all__ = ["CapturedMotion", "Claims", "TakeFolder", "load_motion", "open_take", "read_frame", "time_stamp"]

_STAMP = re.compile(rb"^\s*(?:comment|obj_info|#)\s+time(?:[_ ]?stamp)?\s*[:=]?\s+([-+.\deE]+)\s*(?:s|sec)?\s*$", re.M)


@dataclass(frozen=True, slots=True)
class Claims:
    """What the caller says of a take, over what its folder says."""

    frames: str | None = None
    """File name of a frame, `{frame}` in place of its number."""
    fps: float | None = None
    units: str | None = None
    garment_colour: str | None = None
    border_colours: tuple[str, ...] = ()
    rig: Path | None = None
    poses: Path | None = None
    body: Path | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TakeFolder:
    """Files of a take."""

    path: Path
    files: Mapping[int, Path]
    """One scan per frame number, ascending: those that the stages take."""
    also: Mapping[int, tuple[Path, ...]]
    """Further files with a number that has one already."""
    description: Mapping[str, Any]
    """capture.json, or nothing."""
    facts: TakeFacts
    rig: Rig | None
    poses_path: Path | None
    body_path: Path | None
    """None with `moving`: the built-in body."""
    moving: bool
    """There are poses, of a body that is known."""
    claims: Claims


def open_take(path: Path, claims: Claims | None = None) -> TakeFolder:
    """Find the frames of a take, and what is said of them.

    Raises:
        InputError: no such folder, no scans in it, a pattern without {frame}, or a description that cannot be read.
    """
    claims = claims or Claims()
    if not path.is_dir():
        raise InputError(f"expected a capture folder or a folder of scans, found {_kind(path)}", where=path)
    described = path / "capture.json"
    description = read_json(described) if described.is_file() else {}
    if not isinstance(description, dict):
        raise InputError(f"expected a JSON object, found {type(description).__name__}", where=described)
    try:
        said = parse_description(_not_claimed(description, claims))
    except InputError as error:
        raise error.at(described) from None
    folder = path / "scans" if (path / "scans").is_dir() else path
    found = list_scans(folder, claims.frames)
    if not found.scans:
        named = (
            f"named {claims.frames}" if claims.frames else f"with a frame number in their names ({', '.join(KINDS)})"
        )
        raise InputError(f"expected scans {named}, found none", where=folder)
    unlisted = set() if claims.frames or said.frames is None else set(found.scans) - set(said.frames)
    files = {number: scan for number, scan in found.scans.items() if number not in unlisted}
    also = {number: others for number, others in found.also.items() if number in files}
    if not files:
        raise InputError(f"expected scans of the frames in capture.json, found {len(unlisted)} others", where=folder)
    poses_path, body_path = (
        given or (path / name if (path / name).is_file() else None)
        for given, name in ((claims.poses, "poses.npz"), (claims.body, "body.npz"))
    )
    rig_path = claims.rig or (path / "rig.json" if (path / "rig.json").is_file() else None)
    rig = load_rig(rig_path) if rig_path else None
    poses = load_poses(poses_path) if poses_path else None
    facts = _facts(said, claims, tuple(files), poses)
    facts = replace(
        facts,
        duplicated=tuple(also),
        dropped=tuple(sorted({*facts.dropped, *unlisted})),
        unlisted=_unlisted(folder, found, said, claims),
        **_template_facts(path, tuple(files), said.units, painted=bool(facts.border_names)),
    )
    moving = poses is not None and (body_path is not None or poses.joint_names == load_anny().joint_names)
    return TakeFolder(path, files, also, description, facts, rig, poses_path, body_path, moving, claims)


def _unlisted(folder: Path, found: ScanFiles, said: Description, claims: Claims) -> tuple[str, ...]:
    """Names of meshes among the scans that no stage takes, and that the description does not say were left out."""
    taken = {path.name for paths in ([*found.scans.values()], *found.also.values()) for path in paths}
    numberless = [
        path.name
        for path in folder.iterdir()
        if path.suffix.lower() in KINDS and path.name not in taken and not is_aside(path) and not claims.frames
    ]
    if claims.frames or said.frames is None:
        return tuple(sorted(numberless))
    known = {*said.frames, *said.dropped}
    beside = [path.name for number, path in found.scans.items() if number not in known]
    return tuple(sorted([*numberless, *beside]))


def _template_facts(path: Path, frame_ids: tuple[int, ...], units: Units, *, painted: bool) -> dict[str, Any]:
    """What of the template can be said at once: the names of its borders, or why it cannot be registered."""
    capture = Capture(path, "", 1.0, frame_ids, None, units=units)
    try:
        template_path(capture)
    except InputError:
        return {}  # it may come later
    try:
        loops = tuple(capture.template.loops)
    except InputError as error:
        return {"template_fault": str(error)}
    if not len(capture.template.template.faces):
        return {"template_fault": "has no faces"}
    if painted and not loops:
        return {"template_fault": "has no open borders, and the take has painted ones", "template_loops": ()}
    return {"template_loops": loops}


def _kind(path: Path) -> str:
    return "a file" if path.exists() else "nothing"


def _not_claimed(description: Mapping[str, Any], claims: Claims) -> dict[str, Any]:
    """What capture.json says and the caller does not say over it."""
    over = {
        "fps": claims.fps,
        "units": claims.units,
        "garment_colour": claims.garment_colour,
        "boundary_colours": claims.border_colours or None,
    }
    return {entry: value for entry, value in description.items() if over.get(entry) is None}


def _facts(said: Description, claims: Claims, frame_ids: tuple[int, ...], poses: PoseSequence | None) -> TakeFacts:
    units = claims.units or said.units
    declared = next((metres for name, metres in METRES.items() if name == units), None)
    if declared is None:
        raise InputError(f"units: expected one of {', '.join(METRES)}, found '{units}'")
    fps = claims.fps if claims.fps is not None else said.fps
    if fps is not None and not 0 < fps < float("inf"):
        raise InputError(f"fps: expected a positive frame rate, found {fps}")
    garment = parse_colour(claims.garment_colour) if claims.garment_colour else said.garment_colour
    borders: dict[Colour, list[str]] = {}
    if claims.border_colours:
        borders = {parse_colour(colour): [colour] for colour in claims.border_colours}
    else:
        for name, colour in said.boundary_colours.items():
            borders.setdefault(colour, []).append(name)
    return TakeFacts(
        fps=fps,
        declared=declared,
        paints=Paints(garment, tuple(borders)),
        border_names=tuple(tuple(names) for names in borders.values()),
        borders_claimed=bool(claims.border_colours),
        frame_ids=frame_ids,
        listed=said.frames,
        dropped=said.dropped,
        pose_frames=None if poses is None else tuple(int(number) for number in poses.frame_ids),
        pose_fps=None if poses is None else poses.fps,
    )


def read_frame(path: Path, frame_id: int) -> Surface | BadFrame:
    """The scan in a file, or what is wrong with it."""
    try:
        if path.stat().st_size == 0:
            return BadFrame(frame_id, "frame-empty", f"{path}: an empty file")
        return read_surface(path)
    except EmptyMeshError as error:
        return BadFrame(frame_id, "frame-empty", str(error))
    except NotFiniteError as error:
        return BadFrame(frame_id, "frame-nan", str(error))
    except InputError as error:
        return BadFrame(frame_id, "frame-unreadable", str(error))
    except OSError as error:  # it was there when the folder was listed
        return BadFrame(frame_id, "frame-unreadable", f"{path}: {error.strerror}")


def time_stamp(path: Path) -> float | None:
    """Seconds, from a comment such as `comment timestamp 12.345` in the head of a ply or obj file."""
    with path.open("rb") as file:
        match = _STAMP.search(file.read(2048))
    try:
        return float(match[1]) if match else None
    except ValueError:  # a date, say
        return None


@dataclass(frozen=True, slots=True, eq=False)
class CapturedMotion:
    """The motion capture of a take, and whose it is."""

    shaped: ShapedBody
    poses: PoseSequence
    rows: Mapping[int, int]
    """Of `poses`, by frame number."""

    def surface(self, frame_id: int) -> np.ndarray | None:
        """The posed body of a frame, (V, 3), metres; None without a pose for it."""
        return pose_frame(self.shaped, self.poses, self.rows[frame_id]).vertices() if frame_id in self.rows else None

    def state(self, frame_id: int) -> BodyState | None:
        """Pose and shape of a frame; None without a pose for it."""
        if frame_id not in self.rows:
            return None
        shape = np.zeros(len(self.shaped.body.shape_directions))
        shape[: len(self.shaped.shape)] = self.shaped.shape
        row = self.rows[frame_id]
        rotations, translations = self.poses.rotations[row], self.poses.translations[row]
        return BodyState(rotations.astype(np.float64), translations.astype(np.float64), shape)

    def model(self) -> TrackedBody:
        """The body, as tracking has it."""
        return tracked_body(self.shaped.body)


def load_motion(poses_path: Path, body_path: Path | None) -> CapturedMotion:
    """The motion capture of a take.

    Args:
        body_path: None is the built-in body.
    Raises:
        InputError: body and poses do not belong together.
    """
    body, poses = load_body(body_path) if body_path else load_anny(), load_poses(poses_path)
    if body.joint_names != poses.joint_names:
        name = body_path.name if body_path else "the built-in body"
        raise InputError(f"expected the joints of {name}, found others", where=poses_path)
    rows = {int(number): row for row, number in enumerate(poses.frame_ids)}
    return CapturedMotion(with_shape(body, poses.shape), poses, rows)
