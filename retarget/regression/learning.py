"""Learning a garment from unposed takes: shape space, coefficients, regressors, and how well they do.

The arrays of all takes lie one after the other; a `Take` says where its frames begin and how they moved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from capture4d.captures.animations.known_poses import PoseRange, nearest_poses, pose_quaternions
from capture4d.types import PoseSequence
from retarget.config import ShapeConfig
from retarget.regression.controls import ControlLayout, control_vectors
from retarget.regression.known_range import CoefficientRange, ControlRange
from retarget.regression.regressors import Clip, FittingClips, Regressor, Trust
from retarget.regression.splits import Piece, Role
from retarget.shapes.blendshapes import (
    ShapeSpace,
    fewest_directions,
    learn_shape_space,
    posed_errors,
    project,
)
from retarget.shapes.mirroring import Mirror

__all__ = [
    "Projected",
    "Take",
    "UnposedTakes",
    "examined",
    "fitting_clips",
    "learn_shapes",
    "learned_rows",
    "predictions",
    "regression_clips",
    "training_poses",
    "vertex_error_m",
]


LEAST_TAUGHT = 2
"""Good frames without which nothing can be learned."""


@dataclass(frozen=True, slots=True, eq=False)
class Take:
    """One registered take."""

    name: str
    poses: PoseSequence
    good: Bool[np.ndarray, " frames"]
    """Frames that were not flagged."""
    transforms: Float64[np.ndarray, "frames joints 4 4"]


@dataclass(frozen=True, slots=True, eq=False)
class UnposedTakes:
    """All frames of all takes in the rest pose."""

    takes: Sequence[Take]
    vertices: Float32[np.ndarray, "frames verts 3"]
    """Metres; may lie on disk."""
    weights: Float32[np.ndarray, "frames verts"]
    skin_weights: Float32[np.ndarray, "verts joints"]

    def start(self, take: int) -> int:
        """Row of a take's first frame."""
        return sum(len(each.good) for each in self.takes[:take])

    def rows(self, pieces: Sequence[Piece], role: Role) -> Int64[np.ndarray, " rows"]:
        """Rows of the good frames that have a role."""
        found = [
            self.start(piece.take) + np.flatnonzero(self.takes[piece.take].good[piece.frames.start : piece.frames.stop])
            + piece.frames.start
            for piece in pieces
            if piece.role == role
        ]  # fmt: skip
        return np.concatenate([np.zeros(0, np.int64), *found])

    @property
    def transforms(self) -> Float64[np.ndarray, "frames joints 4 4"]:
        return np.concatenate([take.transforms for take in self.takes])


def learned_rows(takes: UnposedTakes, pieces: Sequence[Piece]) -> Int64[np.ndarray, " rows"]:
    """Rows of the good frames that are learned from in the end: of training, and of takes that have validated."""
    training, late = _learned_pieces(pieces)
    return np.concatenate([takes.rows(training, "training"), takes.rows(late, "validation")])


def learn_shapes(
    takes: UnposedTakes, rows: Int64[np.ndarray, " rows"], config: ShapeConfig
) -> tuple[ShapeSpace, int | None]:
    """The shape space of some frames, cut where the error allows, and how many directions that takes.

    Returns:
        The space, and the fewest directions that keep to `config.max_error_mm` (None: all there are do not).
    """
    space = learn_shape_space(takes.vertices, takes.weights, rows, config, np.random.default_rng(0))
    fewest = fewest_directions(
        space, takes.vertices, takes.weights, rows, takes.transforms, takes.skin_weights,
        limit_m=1e-3 * config.max_error_mm,
    )  # fmt: skip
    if config.components:
        return space.first(config.components), fewest
    return (space if fewest is None else space.first(fewest)), fewest


Projected = dict[tuple[Piece, bool], np.ndarray]
"""Coefficients of pieces, as they are (True) or in the mirror."""


def regression_clips(
    takes: UnposedTakes,
    pieces: Sequence[Piece],
    role: Role,
    layout: ControlLayout,
    space: ShapeSpace,
    mirror: Mirror | None = None,
    projected: Projected | None = None,
) -> list[Clip]:
    """Controls and coefficients of the pieces that have a role. Bad frames have no coefficients.

    Args:
        mirror: the pieces are seen in it.
        projected: coefficients that are known from another layout's clips; gets those that are not.
    """
    projected = {} if projected is None else projected
    clips = []
    for piece in pieces:
        if piece.role != role:
            continue
        take, kept = takes.takes[piece.take], slice(piece.frames.start, piece.frames.stop)
        first = takes.start(piece.take)
        good = take.good[kept]
        if (piece, mirror is None) not in projected:
            rows = first + piece.frames.start + np.flatnonzero(good)
            coefficients = np.zeros((len(good), len(space.basis)), np.float32)
            if len(rows):
                frames = takes.vertices[rows], takes.weights[rows]
                coefficients[good] = project(space, *(frames if mirror is None else mirror.frames(*frames)))
            projected[piece, mirror is None] = coefficients
        poses = take.poses if mirror is None else mirror.poses(take.poses)
        controls = control_vectors(layout, poses)[kept]
        clips.append(Clip(controls, projected[piece, mirror is None], good, piece.take))
    return clips


def fitting_clips(
    takes: UnposedTakes,
    pieces: Sequence[Piece],
    layout: ControlLayout,
    space: ShapeSpace,
    mirror: Mirror | None = None,
    projected: Projected | None = None,
) -> FittingClips:
    """What regressors are fitted to: the training clips, as they are and in the mirror, and in the end the validation
    clips as well; but not the end of a take whose beginning was learned from, for it is all there is to show what came
    of it.
    """
    learned, late = _learned_pieces(pieces)

    def clips(pieces: Sequence[Piece], role: Role) -> list[Clip]:
        found = regression_clips(takes, pieces, role, layout, space, None, projected)
        return found + (regression_clips(takes, pieces, role, layout, space, mirror, projected) if mirror else [])

    training = clips(learned, "training")
    validation = regression_clips(takes, pieces, "validation", layout, space, None, projected)
    validation = [clip for clip in validation if clip.good.any()]  # the others decide nothing
    return FittingClips(training, validation, [*training, *clips(late, "validation")])


def vertex_error_m(
    takes: UnposedTakes,
    pieces: Sequence[Piece],
    role: Role,
    space: ShapeSpace,
    coefficients: Sequence[Float[np.ndarray, "frames shapes"]],
) -> float:
    """Mean distance, in the pose, of predicted to registered vertices with scan data, over the good frames; metres.

    Args:
        coefficients: one array for each piece with that role, as `regression_clips` orders them.
    """
    total, count = 0.0, 0
    flat = space.basis.reshape(len(space.basis), -1)
    for piece, said in zip([each for each in pieces if each.role == role], coefficients, strict=True):
        take, first = takes.takes[piece.take], takes.start(piece.take)
        for frame, answer in zip(piece.frames, said, strict=True):
            if not take.good[frame]:
                continue
            truth, seen = takes.vertices[first + frame], takes.weights[first + frame] >= 0.5
            residual = space.mean + (answer.astype(np.float64) @ flat).reshape(truth.shape) - truth
            errors = posed_errors(residual[None], takes.skin_weights, take.transforms[frame][None])[0, seen]
            total, count = total + float(errors.sum()), count + int(seen.sum())
    return total / max(count, 1)


def training_poses(
    takes: UnposedTakes, pieces: Sequence[Piece], layout: ControlLayout, mirror: Mirror | None = None
) -> PoseRange:
    """The poses of the good frames that regressors learn from in the end (`fitting_clips`), and how far those of
    validation were from the ones of training while they validated."""

    def quaternions(chosen: Sequence[Piece], mirror: Mirror | None) -> np.ndarray:
        found = [np.zeros((0, len(layout.joints), 4), np.float32)]
        for piece in chosen:
            take = takes.takes[piece.take]
            rotations = (take.poses if mirror is None else mirror.poses(take.poses)).rotations
            good = np.flatnonzero(take.good[piece.frames.start : piece.frames.stop]) + piece.frames.start
            found.append(pose_quaternions(rotations[good], layout.joints))
        return np.concatenate(found)

    def seen(chosen: Sequence[Piece]) -> np.ndarray:
        return np.concatenate([quaternions(chosen, each) for each in ((None,) if mirror is None else (None, mirror))])

    training, late = _learned_pieces(pieces)
    first, validation = seen(training), [piece for piece in pieces if piece.role == "validation"]
    distances, _ = nearest_poses(quaternions(validation, None), first)
    validated = float(np.percentile(distances, 95)) if len(distances) else 0.0
    return PoseRange(np.concatenate([first, seen(late)]), layout.joints, validated)


def examined(
    clips: FittingClips,
    layout: ControlLayout,
    coefficients: CoefficientRange,
    learned: int,
    fit: Callable[[FittingClips], Regressor],
) -> Trust:
    """How far a regressor's answers can be believed, shown on each take by what was learned from the others; of an only
    take, on its end.

    Args:
        learned: directions that the takes have taught. The one beyond them is the template's alone: that no learned
            frame has anything of it is no evidence.
        fit: learns from clips, with settings that are chosen already.
    """
    resting = np.zeros_like(coefficients.std) if coefficients.resting is None else coefficients.resting
    distances, answers, truth = [], [], []
    for known, asked in _left_out(clips):
        if sum(int(clip.good.sum()) for clip in known) < LEAST_TAUGHT:
            continue
        regressor, reach = fit(FittingClips(known, (), known)), ControlRange.of(known, layout)
        for clip in asked:
            controls, _ = reach.bounded(clip.controls, layout, np.inf)
            distances.append(reach.distances(clip.controls, layout)[clip.good])
            answers.append((coefficients.inside(regressor.predict(controls))[clip.good] - resting)[:, :learned])
            truth.append((clip.coefficients[clip.good] - resting)[:, :learned])
    if not distances:
        return Trust.whole()
    return Trust.of(np.concatenate(distances), np.concatenate(answers), np.concatenate(truth))


def _left_out(clips: FittingClips) -> list[tuple[Sequence[Clip], Sequence[Clip]]]:
    """What is learned from, and what is examined: each take in turn, by the others; of an only take, its end."""
    takes = sorted({clip.take for clip in clips.all})
    if len(takes) < 2:
        return [(clips.training, clips.validation)]
    return [
        ([clip for clip in clips.all if clip.take != take], [clip for clip in clips.all if clip.take == take])
        for take in takes
    ]


def _learned_pieces(pieces: Sequence[Piece]) -> tuple[list[Piece], list[Piece]]:
    """What is learned from, and what is learned from as well once it has validated."""
    begun = {piece.take for piece in pieces if piece.role == "training"}
    training = [piece for piece in pieces if piece.role == "training"]
    return training, [piece for piece in pieces if piece.role == "validation" and piece.take not in begun]


def predictions(regressor: Regressor, clips: Sequence[Clip]) -> list[Float32[np.ndarray, "frames shapes"]]:
    """What a regressor says to each clip."""
    return [regressor.predict(clip.controls) for clip in clips]
