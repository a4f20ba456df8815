"""The capture folder: what a lab hands in, and what the synthetic scanner writes.

    CAPTURE/
      capture.json                    name, frame rate, paint colours
      scans/000123.ply                one coloured mesh per frame (ply, glb, gltf or obj)
      poses.npz body.npz              motion capture and the body it moves            [optional]
      template.npz or template.obj    garment to register                             [optional]
      rig.json                        cameras                                         [optional]
      truth/model.npz truth/000123.npz    exact surfaces, from the synthetic scanner  [optional]

docs/reference/files.md describes every file, so that it can be written without this package.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.body.anny import load_anny
from capture4d.captures.description import FORMAT, LAST_FRAME, parse_description
from capture4d.captures.names import require_plain_names
from capture4d.captures.scan_files import KINDS, list_scans, read_surface
from capture4d.colours.spaces import Colour, format_colour
from capture4d.errors import InputError
from capture4d.files.atomic import content_digest, file_digest, parse_json, write_json
from capture4d.files.reading import shortened
from capture4d.files.records import (
    load_body,
    load_garment,
    load_poses,
    load_rig,
)
from capture4d.geometry.mesh import boundary_loops
from capture4d.geometry.seams import welded_mesh
from capture4d.mesh_files.meshes import READABLE, read_mesh, write_mesh
from capture4d.runs.frame_lists import chosen_frames
from capture4d.types import Body, Garment, PoseSequence, Rig, Scan
from capture4d.units import METRES, Units
from capture4d.value_checks import require_frame_rate

__all__ = [
    "Capture",
    "CaptureFiles",
    "read_capture",
    "read_frame",
    "read_scan",
    "scan_path",
    "template_path",
    "write_capture_description",
    "write_scan",
]


@dataclass(frozen=True, slots=True, eq=False)
class CaptureFiles:
    """What a capture folder held when it was opened."""

    description: bytes
    """Of capture.json."""
    scans: Mapping[int, Path]
    """By frame number."""


@dataclass(frozen=True, eq=False)
class Capture:
    """A take: the description of a capture folder, as it was when it was opened.

    What else the folder holds is read when it is first asked for, and once. Scans are read one by one, with
    `read_scan`.
    """

    path: Path
    name: str
    fps: float
    frame_ids: tuple[int, ...]
    """The capture's own frame numbers, ascending."""
    garment_colour: Colour | None
    """None: to be learned from the scans."""
    boundary_colours: Mapping[str, Colour] = field(default_factory=dict)
    """Paint on each border loop; the same colour may serve several. Empty: no painted borders, or, where the garment's
    colour is to be learned, those that are found."""
    units: Units = "m"
    """Of the scan files. What `read_scan` returns is in metres."""
    files: CaptureFiles | None = None
    """None for a capture that was not read from a folder: its files are looked up when they are asked for."""
    left_out: tuple[int, ...] = ()
    """Frames of the take that are not to be worked on."""

    def __post_init__(self) -> None:
        if not self.frame_ids:
            raise InputError("expected at least one frame, found none", where=self.path)
        try:
            require_frame_rate("fps", self.fps)
        except InputError as error:
            raise error.at(self.path) from None
        if list(self.frame_ids) != sorted(set(self.frame_ids)) or self.frame_ids[0] < 0:
            raise InputError("expected ascending frame numbers, each once and none negative", where=self.path)
        if self.frame_ids[-1] > LAST_FRAME:
            raise InputError(f"expected frame numbers up to {LAST_FRAME}, found {self.frame_ids[-1]}", where=self.path)

    def __getstate__(self) -> dict[str, Any]:
        """What travels to another process: not what was read of the folder, which is read there if it is needed."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    def time_s(self, frame_id: int) -> float:
        """Time of a frame since the first."""
        return (frame_id - self.frame_ids[0]) / self.fps

    def choosing(self, frames: str | None) -> Capture:
        """The take with no other frames than those that a text names, such as "1,5,10-20" or "1-200:5".

        Raises:
            InputError: it names none of the take's.
        """
        if frames is None:
            return self
        chosen = chosen_frames(frames, self.frame_ids)
        left_out = sorted({*self.left_out, *self.frame_ids} - set(chosen))
        return replace(self, frame_ids=chosen, left_out=tuple(left_out))

    def entries(self, *names: str) -> dict[str, Any]:
        """What capture.json says, as JSON, of `fps`, `units`, `garment_colour`, `boundary_colours`; and its `paints`,
        which are the latter without their names."""
        boundary = {name: format_colour(colour) for name, colour in self.boundary_colours.items()}
        said = {
            "fps": self.fps,
            "units": self.units,
            "garment_colour": None if self.garment_colour is None else format_colour(self.garment_colour),
            "boundary_colours": boundary,
            "paints": list(dict.fromkeys(boundary.values())),
        }
        return {name: said[name] for name in names}

    @cached_property
    def template(self) -> Garment:
        """The garment to register: `template.npz`, or a bare mesh with loops called border_0, ...

        The bare mesh of a format that splits vertices at seams is joined there.

        Raises:
            InputError: there is neither, or it is damaged.
        """
        path = self._template_path
        if path.suffix.lower() == ".npz":
            garment = load_garment(path, self._template_files[path.name])
            _require_loop_names(garment, path)
            return garment
        mesh, _ = welded_mesh(read_mesh(path).mesh)
        if self.units != "m":
            mesh = mesh.with_vertices(mesh.vertices * np.float32(METRES[self.units]))
        return Garment(mesh, {f"border_{index}": loop for index, loop in enumerate(boundary_loops(mesh.faces))})

    @property
    def template_digest(self) -> str:
        """Raises InputError where there is no template."""
        return content_digest(self._template_files)

    @cached_property
    def _template_path(self) -> Path:
        return template_path(self)

    @cached_property
    def _template_files(self) -> dict[str, bytes]:
        """The template, and the buffers that a gltf has in files of their own, by name."""
        path = self._template_path
        beside = sorted(path.parent.glob("*.[bB][iI][nN]")) if path.suffix.lower() == ".gltf" else []
        return {file.name: file.read_bytes() for file in (path, *beside)}

    @cached_property
    def poses(self) -> PoseSequence | None:
        """The poses of the take, one per scan and in their order; None if the capture has none.

        Raises:
            InputError: a scan has no pose.
        """
        return _poses(self)

    @cached_property
    def body(self) -> Body | None:
        """The body that `body.npz` brings."""
        path = self.path / "body.npz"
        return load_body(path) if path.is_file() else None

    @cached_property
    def posed_body(self) -> tuple[Body, PoseSequence] | None:
        """The body and its poses, of the built-in body where poses come without one; None without poses.

        Raises:
            InputError: a scan has no pose.
        """
        return None if self.poses is None else (self.body or load_anny(), self.poses)

    @cached_property
    def rig(self) -> Rig | None:
        path = self.path / "rig.json"
        return load_rig(path) if path.is_file() else None

    @cached_property
    def body_digest(self) -> str | None:
        """None where the capture brings no body."""
        path = self.path / "body.npz"
        return file_digest([path], root=self.path) if path.is_file() else None

    @cached_property
    def motion_digest(self) -> str | None:
        """Of the poses and of the body they move; None where the capture brings no poses."""
        if not (self.path / "poses.npz").is_file():
            return None
        paths = [self.path / name for name in ("poses.npz", "body.npz")]
        return file_digest([path for path in paths if path.is_file()], root=self.path)


# --- description and scans ---------------------------------------------------------------------------------------


def read_capture(path: str | Path, *, scans: bool = True) -> Capture:
    """Read `capture.json`, and see that every frame it names has a scan.

    Args:
        scans: False for a take that was simulated and never scanned.
    Raises:
        InputError: the folder, the description or a scan is missing, or the description is wrong.
    """
    path = Path(path)
    description = path / "capture.json"
    if not path.is_dir():
        raise InputError("no such capture folder", where=path)
    if not description.is_file():
        raise InputError("no such file; a capture folder needs one (see docs/reference/files.md)", where=description)
    files = _list_files(path)
    found = parse_json(files.description, description)
    try:
        said = parse_description(found)
        for entry in ("format", "fps"):
            if found.get(entry) is None:
                raise InputError(f"expected the entry '{entry}', found none")
    except InputError as error:
        raise InputError(shortened(error.reason), where=description) from None
    assert said.fps is not None
    frame_ids = tuple(files.scans) if said.frames is None else said.frames
    if not frame_ids:
        kinds = ", ".join(KINDS)
        raise InputError(
            f"expected scans with a frame number in their names ({kinds}), found none", where=path / "scans"
        )
    capture = Capture(
        path=path,
        name=said.name or path.resolve().name,
        fps=said.fps,
        frame_ids=frame_ids,
        garment_colour=said.garment_colour,
        boundary_colours=said.boundary_colours,
        units=said.units,
        files=files,
    )
    missing = [frame_id for frame_id in capture.frame_ids if frame_id not in files.scans]
    if scans and missing:
        raise InputError(
            f"no such scan; {len(missing)} of {len(capture.frame_ids)} frames in capture.json have none",
            where=_expected_scan(path, missing[0]),
        )
    return capture


def _list_files(path: Path) -> CaptureFiles:
    found = list_scans(path / "scans")
    return CaptureFiles((path / "capture.json").read_bytes(), found.scans)


def _expected_scan(path: Path, frame_id: int) -> Path:
    return path / "scans" / f"{frame_id:06d}.ply"


def write_capture_description(capture: Capture) -> None:
    """Write `capture.json` into the capture's folder."""
    write_json(
        capture.path / "capture.json",
        {
            "format": FORMAT,
            "name": capture.name,
            "fps": capture.fps,
            "units": capture.units,
            "garment_colour": None if capture.garment_colour is None else format_colour(capture.garment_colour),
            "boundary_colours": {name: format_colour(colour) for name, colour in capture.boundary_colours.items()},
            "frames": list(capture.frame_ids),
        },
    )


def scan_path(capture: Capture, frame_id: int) -> Path:
    """The file of a frame's scan.

    Raises:
        InputError: there is none.
    """
    if capture.files is not None:
        found = capture.files.scans.get(frame_id)
    else:
        named = (capture.path / "scans" / f"{frame_id:06d}{suffix}" for suffix in KINDS)
        found = next((path for path in named if path.is_file()), None)
        found = found or list_scans(capture.path / "scans").scans.get(frame_id)
    if found is None:
        raise InputError("no such scan", where=_expected_scan(capture.path, frame_id))
    return found


def read_scan(capture: Capture, frame_id: int) -> Scan:
    """Read one frame, in metres: joined along the seams of its texture, and with faces where the file has points alone.

    Raises:
        InputError: the scan is missing, damaged, or has neither vertex colours nor a texture.
    """
    return read_frame(capture, frame_id)[0]


def read_frame(capture: Capture, frame_id: int) -> tuple[Scan, bool]:
    """`read_scan`, and whether its faces are estimated."""
    path = scan_path(capture, frame_id)
    found = read_surface(path)
    if found.colours is None:
        raise InputError("expected a colour per vertex, found none, nor a texture", where=path)
    mesh = found.mesh
    if capture.units != "m":
        mesh = mesh.with_vertices(mesh.vertices * np.float32(METRES[capture.units]))
    return Scan(mesh, found.colours, frame_id, capture.time_s(frame_id)), found.estimated


def write_scan(path: str | Path, scan: Scan) -> None:
    write_mesh(path, scan.mesh, colours=scan.colours)


# --- what else a capture may hold --------------------------------------------------------------------------------


def _poses(capture: Capture) -> PoseSequence | None:
    path = capture.path / "poses.npz"
    if not path.is_file():
        return None
    poses = load_poses(path)
    index = {int(frame_id): row for row, frame_id in enumerate(poses.frame_ids)}
    missing = [frame_id for frame_id in capture.frame_ids if frame_id not in index]
    if missing:
        raise InputError(
            f"expected a pose for each of {len(capture.frame_ids)} scans, "
            f"found none for {len(missing)} of them, frame {missing[0]} first",
            where=path,
        )
    rows = [index[frame_id] for frame_id in capture.frame_ids]
    return replace(
        poses,
        rotations=poses.rotations[rows],
        translations=poses.translations[rows],
        frame_ids=np.array(capture.frame_ids, np.int32),
    )


def template_path(capture: Capture) -> Path:
    """The file of the template, in any letter case of its ending; an npz before bare meshes.

    Raises:
        InputError: there is none.
    """
    kinds = (".npz", *READABLE)
    found = [
        path for path in sorted(capture.path.glob("template.*")) if path.suffix.lower() in kinds and path.is_file()
    ]
    if not found:
        raise InputError(
            "no such file, nor a template.obj; registration needs a template", where=capture.path / "template.npz"
        )
    return min(found, key=lambda path: kinds.index(path.suffix.lower()))


def _require_loop_names(garment: Garment, path: Path) -> None:
    try:
        require_plain_names(garment.loops, "border")
    except InputError as error:
        raise error.at(path) from None
