"""A try-on without a page: who wears the garment, in which style and pose, and what is seen of that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from capture4d.app.tryon.garments import Fitting, TriedGarment
from capture4d.app.tryon.sliders import PoseSliders
from capture4d.app.viewer.surfaces import Surface
from capture4d.errors import InputError
from capture4d.files.records import save_poses
from capture4d.geometry.intersection_removal import Penetration
from capture4d.motions.motion_files import read_motion, told
from capture4d.runs.progress import progress_style
from capture4d.runs.stage import StageResult
from capture4d.types import Mesh, PoseSequence
from retarget.animation.stage import Wearer
from retarget.animation.stage import run as animate
from retarget.config import AnimateConfig

__all__ = ["LiveFrame", "Session", "still"]

HELD_S = 1.0
"""How long a pose of the sliders is held in an animation that is written of it."""
CLOTH = (60, 96, 190)


@dataclass(frozen=True, slots=True, eq=False)
class LiveFrame:
    """What is seen."""

    vertices: Float64[np.ndarray, "verts 3"]
    """Of the garment, metres, world."""
    skin: Float64[np.ndarray, "skin 3"]
    """Of the body."""
    inside: Penetration | None = None
    """How much of the garment is inside the body; None while it moves, for that would take as long again."""
    mapped: Surface | None = None
    """The garment with wrinkles, at rest."""


def still(
    tried: TriedGarment, rotations: np.ndarray, translation: np.ndarray, count: int, fps: float | None = None
) -> PoseSequence:
    """A pose that has rested for so many frames.

    Args:
        fps: the garment's rate if None.
    """
    return PoseSequence(
        np.repeat(rotations[None], count, axis=0).astype(np.float32),
        np.repeat(translation[None], count, axis=0).astype(np.float32),
        np.zeros(len(tried.body.shape_directions), np.float32),
        np.arange(count, dtype=np.int32),
        fps or tried.fps,
        tried.body.joint_names,
    )


class Session:
    """One garment, tried on.

    Args:
        wrinkles: what `wrinkles train` wrote for its template; None for none.
    Raises:
        InputError: the network belongs to another template.
    """

    def __init__(self, tried: TriedGarment, wrinkles: Path | None = None) -> None:
        self.tried, self.sliders = tried, PoseSliders.of(tried.body)
        self.beta, self.style = [*tried.first_shape], {name: sum(ends) / 2 for name, ends in tried.style_ranges.items()}
        self.degrees: dict[str, float] = {}
        self.clip: PoseSequence | None = None
        self._row = 0
        self._wrinkles = wrinkles
        self._fitting = Fitting(tried, self.beta, self.style)
        if wrinkles is not None:
            _ = self._maker

    @property
    def has_wrinkles(self) -> bool:
        return self._wrinkles is not None

    # --- what is tried -------------------------------------------------------------------------------------------

    def dress(self, beta: Sequence[float], style: Mapping[str, float]) -> None:
        """Put it on somebody, in a style.

        Raises:
            InputError: shape or style are outside what was learned; all stays as it was.
        """
        fitting = Fitting(self.tried, beta, style)
        self.beta, self.style, self._fitting = [*beta], dict(style), fitting

    def pose(self, degrees: Mapping[str, float]) -> None:
        """Pose the person by sliders; what is left out is 0."""
        self.sliders.rotations(degrees)  # raises on a slider that is not there
        self.degrees, self.clip = dict(degrees), None

    def play(self, path: Path | None) -> int:
        """Pose the person by a motion file, or by sliders again; how many frames there are.

        Raises:
            InputError: there is no such file, or it is damaged, or of a skeleton that does not fit.
        """
        self._fitting.worn.begin()
        self._row = 0
        self.clip = None if path is None else self._read(path)
        return 0 if self.clip is None else len(self.clip.frame_ids)

    def _read(self, path: Path) -> PoseSequence:
        body = self.tried.body
        found = read_motion(path, body, fps=self.tried.clip_fps, say=told(path))
        if found.joint_names != body.joint_names or not len(found.frame_ids):
            raise InputError(
                f"expected frames of the {len(body.joint_names)} joints of the model, found {len(found.frame_ids)} "
                f"of {len(found.joint_names)}",
                where=path,
            )
        return found

    # --- what is seen --------------------------------------------------------------------------------------------

    def moving(self, row: int | None = None) -> LiveFrame:
        """The next pose of the sliders, or a row of the clip: quickly out of the body."""
        if self.clip is None:
            return LiveFrame(*self._fitting.moving(self.sliders.rotations(self.degrees), np.zeros(3, np.float32)))
        row = 0 if row is None else row
        if row != self._row + 1:  # it goes on from elsewhere
            self._fitting.worn.begin()
        self._row = row
        return LiveFrame(*self._fitting.moving(self.clip.rotations[row], self.clip.translations[row]))

    def resting(self, row: int | None = None) -> LiveFrame:
        """The pose of the sliders when it has rested, or a row of the clip: exactly out of the body, as `animate`
        writes it; with its wrinkles if there are any."""
        poses = self._rested()
        if self.clip is not None:
            poses = self.clip.of_frames(self.clip.frame_ids[: (row or 0) + 1])
        vertices, skin = self._fitting.resting(poses)
        return LiveFrame(vertices, skin, self._fitting.inside(vertices, skin), self._mapped(vertices))

    def _rested(self) -> PoseSequence:
        rotations = self.sliders.rotations(self.degrees)
        return still(self.tried, rotations, np.zeros(3), self._fitting.worn.remembers + 1)

    def unlike_deg(self, row: int = 0) -> float:
        """How far the pose is from the nearest that was learned, degrees."""
        poses = self._rested() if self.clip is None else self.clip.of_frames(self.clip.frame_ids[[row]])
        return float(self.tried.learned.distances(poses)[-1])

    @cached_property
    def _maker(self) -> Any:
        """Makes maps; untyped, for its module loads torch."""
        if self._wrinkles is None:
            return None
        from wrinkles.normal_maps.inference import generator_path, load_model
        from wrinkles.normal_maps.template import MapTemplate
        from wrinkles.normal_maps.wrinkle_maps import MapMaker

        model = load_model(generator_path(self._wrinkles))
        try:
            return MapMaker.create(model, MapTemplate.create(self.tried.garment, model.maps))
        except InputError as error:
            raise error.at(self._wrinkles) from None

    def _mapped(self, vertices: Float64[np.ndarray, "verts 3"]) -> Surface | None:
        if self._maker is None:
            return None
        from wrinkles.normal_maps.spaces import encode_png8

        placed = vertices.astype(np.float32)
        mesh: Mesh = self._maker.template.mesh
        return Surface(mesh.with_vertices(placed), CLOTH, encode_png8(self._maker.map(placed)))

    # --- what is kept --------------------------------------------------------------------------------------------

    def export(self, folder: Path) -> StageResult:
        """Write what is tried on as `animate` does: the clip, or the pose of the sliders, held for a second.

        Args:
            folder: new work folder; gets motion.npz, body/ and registration/.
        Raises:
            InputError: it is not empty.
        """
        if folder.exists() and any(folder.iterdir()):
            raise InputError("expected a new folder, found files in it", where=folder)
        poses = self.clip
        if poses is None:
            count = max(round(HELD_S * self.tried.fps), 1)
            poses = still(self.tried, self.sliders.rotations(self.degrees), np.zeros(3), count)
        folder.mkdir(parents=True, exist_ok=True)
        motion = folder / "motion.npz"
        save_poses(motion, replace(poses, shape=np.asarray(self._fitting.worn.person.shape, np.float32)))
        wearer = Wearer(beta=tuple(self.beta), style=dict(self.style) or None)
        with progress_style("quiet"):  # whoever asked for it looks at a page
            return animate(self.tried.path, motion, folder, AnimateConfig(), wearer=wearer)
