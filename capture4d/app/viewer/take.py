"""What a folder has to show: layers of a frame, read when they are asked for, while other commands may be writing."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from capture4d.app.drawing.palette import BODY, CLOTH
from capture4d.app.export.clip import MapFolder
from capture4d.app.export.maps import map_bytes
from capture4d.app.viewer.config import ViewConfig
from capture4d.app.viewer.figures import (
    FIT,
    INSIDE,
    MOTION,
    PLACE,
    STRETCH,
    TRUTH,
    StretchOf,
    figure_colours,
    speeds,
    truth_figure_mm,
)
from capture4d.app.viewer.previews import clustered, preview_folder, scan_preview
from capture4d.app.viewer.surfaces import Corners, Dots, Shown, Surface, corner_vertices
from capture4d.app.viewer.timeline import Registered, Timeline
from capture4d.body.limbs import WornBody
from capture4d.body.skinning import ShapedBody, pose_frame, with_shape
from capture4d.captures.capture import Capture, read_capture, read_scan
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.truth import TruthModel, read_truth_model, read_truth_vertices
from capture4d.captures.work_folder import WorkFolder, load_tracking, open_work
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.records import load_garment
from capture4d.runs.frame_lists import frame_file
from capture4d.runs.stage import read_record
from capture4d.types import Body, Garment, Mesh, PoseSequence

__all__ = ["BODY_LAYER", "BORDER", "CLOTH_LAYER", "LAYERS", "MAPS", "PLAIN", "SCAN", "ShownTake", "open_take"]

SCAN, CUT, BORDER = "scan", "garment in the scan", "border points"
CLOTH_LAYER, BODY_LAYER, TRUE_LAYER = "registration", "body", "truth"
LAYERS = (SCAN, CUT, BORDER, CLOTH_LAYER, BODY_LAYER, TRUE_LAYER)
PLAIN, MAPS = "plain", "with wrinkles"
TRUE_COLOUR = (120, 170, 130)
LOOP_COLOURS = np.array([(120, 120, 120), (214, 62, 62), (46, 150, 84), (150, 70, 190), (20, 150, 180), (230, 120, 20)])
"""Of border points by their loop; the first of those whose loop nobody knows."""


@dataclass(frozen=True, slots=True, eq=False)
class _Cloth:
    """The template, and what is derived of it once."""

    garment: Garment
    stretch: StretchOf
    maps: MapFolder | None
    mapped: tuple[Mesh, Corners] | None
    """The template with the UVs of the maps."""


@dataclass(frozen=True, slots=True, eq=False)
class _Person:
    """Who moves, and how."""

    person: ShapedBody
    poses: PoseSequence
    rows: dict[int, int]
    worn: WornBody | None
    """With the garment on; None without one that is bound to this body."""

    def skin(self, frame_id: int) -> np.ndarray | None:
        row = self.rows.get(frame_id)
        return None if row is None else pose_frame(self.person, self.poses, row).vertices()


class ShownTake:
    """A work folder, or a capture that nothing was made of yet.

    What a frame shows is read anew each time; whoever asks often keeps it. Between `look` and `look` the same is
    answered.
    """

    def __init__(self, path: Path, config: ViewConfig) -> None:
        self.path, self.config = path, config
        self.is_capture = (path / "capture.json").is_file()
        self._registered = Registered(path / "registration")
        self._stages: Any = None
        self._scanned: frozenset[int] = frozenset()
        self.work: WorkFolder | None = None
        self.capture: Capture | None = None
        self.timeline = Timeline(())
        self.notes: list[str] = []
        """What is missing that one might look for, a sentence each."""
        self.look()
        if not self.timeline.frame_ids:
            raise InputError(
                "expected frames to show, found none; run: capture4d run CAPTURE --output WORK", where=path
            )

    @property
    def name(self) -> str:
        return self.path.resolve().name

    @property
    def previews(self) -> Path:
        """Where the previews of the scans are kept."""
        return preview_folder(self.path, self.config.preview_mm)

    def look(self) -> bool:
        """Look for what has been written since; whether there is anything."""
        changed = self._registered.look()
        stages = None if self.is_capture else open_work(self.path).stages
        if not changed and stages == self._stages and self.timeline.frame_ids and not self.is_capture:
            return False
        again = stages != self._stages
        self._stages = stages
        if not self.is_capture:
            self.work = open_work(self.path)
        if self.capture is None or again or self.is_capture:
            changed |= self._look_at_capture()
        if again or self.work is None:
            for name in ("cloth", "person", "truth"):
                self.__dict__.pop(name, None)
        ids = {*self._registered.records, *(self.capture.frame_ids if self.capture is not None else ())}
        found = Timeline(tuple(sorted(ids)), self._registered.records)
        changed |= again or found.frame_ids != self.timeline.frame_ids
        self.timeline = found
        return changed

    def _look_at_capture(self) -> bool:
        """Read capture.json again, and which scans there are; whether these are others."""
        before = None if self.capture is None else self.capture.frame_ids
        try:
            if self.is_capture:
                self.capture = read_capture(self.path)
            elif self.work is not None and not self.work.is_animated:
                self.capture = read_capture(self.work.capture_path)
        except InputError as error:
            if self.is_capture:
                raise
            self._note(f"scans are not shown: {error.reason}")
        self._scanned = frozenset(() if self.capture is None else self.capture.frame_ids)
        return before != (None if self.capture is None else self.capture.frame_ids)

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    # --- what there is -------------------------------------------------------------------------------------------

    @cached_property
    def cloth(self) -> _Cloth | None:
        """The template; None before registration has begun."""
        path = self.path / "registration" / "garment.npz"
        if not path.is_file():
            return None
        garment, maps = load_garment(path), None if self.work is None else _maps(self.work)
        mapped = None
        if maps is not None:
            mesh = load_garment(maps.path / "template.npz").template
            if mesh.uv is not None and np.array_equal(mesh.faces, garment.template.faces):
                mapped = mesh, corner_vertices(mesh)
        return _Cloth(garment, StretchOf(garment), maps if mapped else None, mapped)

    @cached_property
    def person(self) -> _Person | None:
        try:
            found = self.capture.posed_body if self.work is None and self.capture is not None else None
            if self.work is not None:
                found = self._moved_by(self.work)
        except InputError as error:
            self._note(f"the body is not shown: {error.reason}")
            found = None
        if found is None:
            return None
        body, poses = found
        person, garment = with_shape(body, poses.shape), None if self.cloth is None else self.cloth.garment
        worn = None
        weights = None if garment is None else garment.skin_weights
        if garment is not None and weights is not None and weights.shape[1] == len(body.joint_names):
            worn = WornBody(person, garment.template.vertices, weights)
        rows = {frame_id: row for row, frame_id in enumerate(poses.frame_ids.tolist())}
        return _Person(person, poses, rows, worn)

    def _moved_by(self, work: WorkFolder) -> tuple[Body, PoseSequence] | None:
        """What moves the template of a work folder, or will; nothing in one that was imported."""
        if "registration" in work.stages:
            with contextlib.suppress(InputError):
                return work.posed_body
        body, poses = self.path / "body" / "body.npz", self.path / "body" / "poses.npz"
        if body.is_file() and poses.is_file():
            return load_tracking(self.path / "body")
        return None if self.capture is None else self.capture.posed_body

    @cached_property
    def truth(self) -> TruthModel | None:
        try:
            return None if self.capture is None else read_truth_model(self.capture)
        except InputError as error:
            self._note(f"the truth is not shown: {error.reason}")
            return None

    @property
    def fps(self) -> float:
        """Of the take; 30 where nobody knows."""
        if self.capture is not None:
            return self.capture.fps
        return self.person.poses.fps if self.person is not None else 30.0

    @property
    def layers(self) -> tuple[str, ...]:
        """Those of LAYERS that there is something of."""
        there = {
            SCAN: self.capture is not None,
            CUT: (self.path / "garment" / "frames").is_dir(),
            BORDER: (self.path / "garment" / "frames").is_dir(),
            CLOTH_LAYER: self.cloth is not None,
            BODY_LAYER: self.person is not None,
            TRUE_LAYER: self.truth is not None,
        }
        return tuple(layer for layer in LAYERS if there[layer])

    @property
    def paints(self) -> tuple[str, ...]:
        """What a registration can be coloured by: figures, PLAIN, MAPS."""
        cloth = self.cloth
        if cloth is None:
            return ()
        judged = self.work is not None and not self.work.is_animated
        truth = self.truth is not None and len(self.truth.template_faces) == len(cloth.garment.template.vertices)
        worn = self.person is not None and self.person.worn is not None
        there = {
            FIT: judged, PLAIN: True, MAPS: cloth.maps is not None, TRUTH: truth, PLACE: truth, STRETCH: True,
            MOTION: True, INSIDE: worn,
        }  # fmt: skip
        return tuple(paint for paint, is_there in there.items() if is_there)

    # --- what a frame shows --------------------------------------------------------------------------------------

    def state(self, layer: str, frame_id: int) -> int:
        """Changes whenever a frame of a registration is written anew; other layers stay as they are."""
        return self._registered.states.get(frame_id, 0) if layer == CLOTH_LAYER else 0

    def shown(
        self, layer: str, frame_id: int, *, paint: str = PLAIN, high: float = 1.0, full: bool = False
    ) -> Shown | None:
        """A layer of a frame; None where the frame has none.

        Args:
            paint: of `paints`, for the registration.
            high: the value that the end of a figure's colours stands for.
            full: the scan itself, not its preview.
        Raises:
            InputError: a file is damaged, or was written over meanwhile.
        """
        match layer:
            case "scan":
                return self._scan(frame_id, full=full)
            case "garment in the scan" | "border points":
                return self._cut(frame_id, layer)
            case "registration":
                return self._registration(frame_id, paint, high)
            case "body":
                skin = None if self.person is None else self.person.skin(frame_id)
                if skin is None or self.person is None:
                    return None
                mesh = self.person.person.body.template
                return Surface(Mesh(skin.astype(np.float32), mesh.faces), BODY)
            case "truth":
                if self.truth is None or self.capture is None:
                    return None
                fine = read_truth_vertices(self.capture, frame_id, model=self.truth)
                return Surface(Mesh(fine, self.truth.fine.faces), TRUE_COLOUR)
            case _:
                raise InputError(f"layer: expected one of {', '.join(LAYERS)}, found {layer!r}")

    def vertices(self, frame_id: int) -> Float32[np.ndarray, "verts 3"] | None:
        """Registered vertices, metres; None of a frame that is not registered."""
        found = self._arrays(frame_id, "vertices")
        return None if found is None else found[0]

    def _scan(self, frame_id: int, *, full: bool) -> Shown | None:
        if self.capture is None or frame_id not in self._scanned:
            return None
        if full:
            scan = read_scan(self.capture, frame_id)
            mesh, colours = scan.mesh, scan.colours
        else:
            mesh, colours = scan_preview(self.capture, frame_id, self.previews, self.config.preview_mm)
        return Surface(mesh, colours) if len(mesh.faces) else Dots(mesh.vertices, colours)

    def _cut(self, frame_id: int, layer: str) -> Shown | None:
        path = frame_file(self.path / "garment", frame_id)
        if not path.is_file():
            return None
        with contextlib.suppress(InputError):  # it holds why there is no garment; the frame's verdict says so
            found = load_garment_scan(path, frame_id)
            if layer == BORDER:
                loops = np.minimum(found.boundary_loops + 1, len(LOOP_COLOURS) - 1)
                return Dots(found.boundary_points, LOOP_COLOURS[loops].astype(np.uint8))
            colours = (
                np.full((len(found.mesh.vertices), 3), CLOTH, np.uint8) if found.colours is None else found.colours
            )
            cell = 1e-3 * min(self.config.preview_mm, 5.0)
            return Surface(*clustered(found.mesh.vertices, found.mesh.faces, colours, cell))
        return None

    def _registration(self, frame_id: int, paint: str, high: float) -> Shown | None:
        cloth, vertices = self.cloth, self.vertices(frame_id)
        if cloth is None or vertices is None:
            return None
        if paint == MAPS and cloth.maps is not None and cloth.mapped is not None:
            if cloth.maps.file(frame_id).is_file():
                mesh = cloth.mapped[0].with_vertices(vertices)
                return Surface(mesh, CLOTH, map_bytes(cloth.maps, frame_id, 8))
            paint = PLAIN
        mesh = Mesh(vertices, cloth.garment.template.faces)
        if paint in (PLAIN, MAPS):
            return Surface(mesh, CLOTH)
        values = self.figure(paint, frame_id, vertices)
        return Surface(mesh, figure_colours(paint, values, high))

    def corners(self) -> Corners | None:
        """Of the registration with maps."""
        return None if self.cloth is None or self.cloth.mapped is None else self.cloth.mapped[1]

    def figure(self, name: str, frame_id: int, vertices: Float32[np.ndarray, "verts 3"]) -> np.ndarray:
        """A figure of each vertex, (V,), in its unit; NaN where it is not known."""
        unknown = np.full(len(vertices), np.nan)
        match name:
            case "distance to scan":
                found = self._arrays(frame_id, "residual_m")
                return unknown if found is None else 1e3 * found[0].astype(np.float64)
            case "stretch":
                return unknown if self.cloth is None else self.cloth.stretch(vertices)
            case "motion":
                before = self._before(frame_id)
                return unknown if before is None else speeds(before[0], vertices, before[1] / self.fps)
            case "inside the body":
                person = self.person
                skin = None if person is None else person.skin(frame_id)
                if person is None or skin is None or person.worn is None:
                    return unknown
                return 1e3 * person.worn.posed(skin).contacts(vertices).depths
            case _:
                if self.truth is None or self.capture is None:
                    return unknown
                with contextlib.suppress(InputError):
                    fine = read_truth_vertices(self.capture, frame_id, model=self.truth)
                    return truth_figure_mm(name, vertices, fine, self.truth)
                return unknown

    def _before(self, frame_id: int) -> tuple[np.ndarray, int] | None:
        """Vertices of the frame before, and how many frames lie between."""
        ids = [*self._registered.records]
        row = int(np.searchsorted(ids, frame_id))
        before = self.vertices(ids[row - 1]) if row else None
        return None if before is None else (before, frame_id - ids[row - 1])

    def _arrays(self, frame_id: int, *names: str) -> list[np.ndarray] | None:
        path = frame_file(self.path / "registration", frame_id)
        if frame_id not in self._registered.states or not path.is_file():
            return None
        with ArrayFile(path) as arrays:
            return [arrays[name] for name in names]


def open_take(path: Path, config: ViewConfig | None = None) -> ShownTake:
    """A work folder, finished or not, or a capture.

    Raises:
        InputError: it is neither, or there are no frames in it.
    """
    if not path.is_dir():
        found = "a file" if path.exists() else "no such folder"
        raise InputError(f"expected a work folder or a capture, found {found}", where=path)
    return ShownTake(path, config or ViewConfig())


def _maps(work: WorkFolder) -> MapFolder | None:
    """Normal maps of the registration as it is now, finished or not."""
    folder = work.path / "wrinkles" / "generated"
    if not (folder / "stage.json").is_file() or not (folder / "template.npz").is_file():
        return None
    record = read_record(folder / "stage.json")
    registered = work.stages.get("registration", {}).get("digest")
    if record.get("upstream", {}).get("registration") != registered:
        return None
    config = record["config"]
    return MapFolder(folder, str(record.get("digest", "")), int(config["bits"]), bool(config["flip_green"]))
