"""The stage that learns a garment: registered work folders in, WORK/retarget out.

stage.json                 what was run
body.npz                   the body that moved the garment
takes/NAME.json            verdicts of the frames that were unposed; done when it is there
blendshapes.safetensors    the model, with template, weights, borders, licence
linear.safetensors         regression from controls to coefficients
kernel.safetensors         the same by kernels
lstm.safetensors           the same by the network
poses.safetensors          the poses it was learned from
training/ final/           checkpoints and metrics of the network
fit.json                   what was learned from, how many directions, and the errors
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from capture4d.body.binding import with_body_shape
from capture4d.captures.animations.known_poses import PoseRange
from capture4d.captures.work_folder import WorkFolder
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_json
from capture4d.files.records import save_body
from capture4d.runs.stage import Stage, StageResult, open_stage, require_complete
from capture4d.types import BlendshapeModel, Body, Garment
from retarget.config import FitConfig, KernelConfig
from retarget.fit_takes import RegisteredTake, read_takes, stack_takes, unpose_takes
from retarget.model_folder import KERNEL, LINEAR, LSTM, MODEL, POSES, piece_name, shapes_digest
from retarget.regression.controls import ControlLayout
from retarget.regression.ensemble import regressors_by_name
from retarget.regression.kernel import fit_kernel, load_kernel, save_kernel
from retarget.regression.known_range import CoefficientRange, ControlRange, KnownRange, save_known_range
from retarget.regression.learning import (
    Projected,
    UnposedTakes,
    examined,
    fitting_clips,
    learn_shapes,
    learned_rows,
    predictions,
    regression_clips,
    training_poses,
    vertex_error_m,
)
from retarget.regression.linear import LinearRegressor, fit_linear, save_linear
from retarget.regression.regressors import FittingClips, Regressor, mean_squared_error
from retarget.regression.splits import ROLES, Piece, Role, split_takes
from retarget.shapes.blendshapes import (
    ShapeSpace,
    as_model_arrays,
    project,
    shape_space,
    through_garment,
    worst_errors,
)
from retarget.shapes.files import load_blendshapes, save_blendshapes
from retarget.shapes.mirroring import Mirror, find_mirror

__all__ = ["run"]

SCHEMA = 7
EXAMINED_FRAMES = 1000
"""Kernels that only show how far they can be trusted learn from no more; time grows with the cube."""


@dataclass(frozen=True, slots=True, eq=False)
class _Lesson:
    """What there is to learn from."""

    takes: UnposedTakes
    pieces: Sequence[Piece]
    garment: Garment
    """As the first take has it."""
    body: Body
    person: Float32[np.ndarray, " shapes"]
    """Shape coefficients that stand for all takes."""

    @property
    def fps(self) -> float:
        return self.takes.takes[0].poses.fps


def run(
    works: Sequence[WorkFolder],
    output: Path,
    config: FitConfig,
    *,
    device: str = "cpu",
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Learn a garment from registered takes.

    Args:
        works: work folders, each with a finished registration/, in any order. Their names are the takes' names.
        device: of the training.
    Raises:
        InputError: a registration is missing, takes do not fit together, or there are too few good frames.
    """
    if not works:
        raise InputError("takes: expected at least one work folder, found none")
    works = sorted(works, key=lambda work: work.path.resolve().name)
    names = [work.path.resolve().name for work in works]
    if len(set(names)) != len(names):
        raise InputError(f"takes: expected work folders of different names, found {', '.join(sorted(names))}")
    upstream = {
        name: require_complete(work.path / "registration", "register", f"capture4d run CAPTURE --output {work.path}")
        for name, work in zip(names, works, strict=True)
    }
    takes = read_takes(works)
    split_takes(names, [len(take.poses.frame_ids) for take in takes], takes[0].poses.fps, config.split)
    stage = open_stage(
        output, name="fit", schema=SCHEMA, config=config, upstream=upstream,
        sources={name: work.path for name, work in zip(names, works, strict=True)}, overwrite=overwrite,
    )  # fmt: skip
    if (output / "fit.json").is_file() and all((output / name).is_file() for name in _files(config)):
        return _finish(stage, config)
    lesson = _lesson(stage, takes, config, workers)
    note = _learn(stage, lesson, config, device)
    split = {role: [piece_name(names, piece) for piece in lesson.pieces if piece.role == role] for role in ROLES}
    write_json(output / "fit.json", {"split": split, **note})
    return _finish(stage, config)


def _files(config: FitConfig) -> list[str]:
    """What a finished model consists of."""
    kernel, network = config.regressor != "linear", config.regressor == "all"
    return ["body.npz", MODEL, LINEAR, POSES, *([KERNEL] if kernel else []), *([LSTM] if network else [])]


def _finish(stage: Stage, config: FitConfig) -> StageResult:
    result = stage.finish([stage.path / name for name in _files(config)])
    shutil.rmtree(stage.path / "unposed", ignore_errors=True)
    return result


def _lesson(stage: Stage, takes: Sequence[RegisteredTake], config: FitConfig, workers: int) -> _Lesson:
    """Unpose the takes, on the mean of the people who are learned from."""
    learned = [take.poses.shape for take in takes if take.name not in config.split.held_out]
    person = np.mean(learned, axis=0).astype(np.float32)
    first = takes[0]
    if not (stage.path / "body.npz").is_file():
        save_body(stage.path / "body.npz", first.body)
    unpose_takes(takes, stage.path, person, unseen_weight=config.shape.unseen_weight, workers=workers)
    unposed = stack_takes(takes, stage.path)
    names, lengths = [take.name for take in takes], [len(take.good) for take in unposed.takes]
    pieces = split_takes(names, lengths, unposed.takes[0].poses.fps, config.split)
    return _Lesson(unposed, pieces, first.garment, first.body, person)


# --- learning ----------------------------------------------------------------------------------------------------


def _learn(stage: Stage, lesson: _Lesson, config: FitConfig, device: str) -> dict[str, Any]:
    """Blendshapes, the range of poses, and regressors; what to say of them."""
    takes, pieces, body = lesson.takes, lesson.pieces, lesson.body
    model, shape_note = _blendshapes(stage, lesson, config)
    layout = ControlLayout.create(body, takes.skin_weights, lesson.fps, config.control)
    mirror = find_mirror(model.garment.template.with_vertices(model.mean), body.joint_names, config.mirror)
    poses = training_poses(takes, pieces, layout, mirror)
    note = _regressors(stage, lesson, layout, shape_space(model), mirror, poses, config, device)
    return {"validated_deg": poses.validated_deg, **shape_note, **note}


def _blendshapes(stage: Stage, lesson: _Lesson, config: FitConfig) -> tuple[BlendshapeModel, dict[str, Any]]:
    """Learn the shape space, unless an earlier run has; and what to say of it."""
    path, note_path = stage.path / MODEL, stage.path / "shapes.json"
    if path.is_file() and note_path.is_file():
        return load_blendshapes(path), read_json(note_path)
    takes, body, person = lesson.takes, lesson.body, lesson.person
    rows, training = learned_rows(takes, lesson.pieces), takes.rows(lesson.pieces, "training")
    learned, fewest = learn_shapes(takes, rows, config.shape)
    garment = replace(with_body_shape(lesson.garment, body, person), body_shape=person)
    space = through_garment(learned, garment.template.vertices, takes.vertices, rows)
    licence = config.licence or "none given"
    model = BlendshapeModel(garment, *as_model_arrays(space), body.joint_names, lesson.fps, licence)
    save_blendshapes(path, model)
    # frames that validated are no strangers to what was learned from them as well
    alone = learned if len(rows) == len(training) else learn_shapes(takes, training, config.shape)[0]
    note: dict[str, Any] = {"directions": len(learned.std), "directions_for_max_error": fewest}
    for role in ROLES:
        rows = takes.rows(lesson.pieces, role)
        if len(rows):
            mean_m, worst_m = _shape_errors(takes, rows, alone if role == "validation" else space)
            note[f"{role.replace(' ', '_')}_frames"] = len(rows)
            note[f"{role.replace(' ', '_')}_shape_error_mm"] = {"mean": 1e3 * mean_m, "worst": 1e3 * worst_m}
    write_json(note_path, note)
    return model, note


def _shape_errors(takes: UnposedTakes, rows: np.ndarray, space: ShapeSpace) -> tuple[float, float]:
    """Mean and largest distance of some frames from what all directions make of them, metres."""
    count = len(space.std)
    return worst_errors(
        space, takes.vertices, takes.weights, rows, takes.transforms, takes.skin_weights, [count]
    )[count]  # fmt: skip


def _regressors(
    stage: Stage,
    lesson: _Lesson,
    layout: ControlLayout,
    space: ShapeSpace,
    mirror: Mirror | None,
    poses: PoseRange,
    config: FitConfig,
    device: str,
) -> dict[str, Any]:
    """Learn what is not there yet, and measure all of it."""
    digest = shapes_digest(stage.path)
    projected: Projected = {}
    clips = fitting_clips(lesson.takes, lesson.pieces, layout, space, mirror, projected)
    linear = fit_linear(clips, layout, space.std, config.linear)
    save_linear(stage.path / LINEAR, linear, model_digest=digest)
    known_shapes = replace(CoefficientRange.of(clips.all, space.std), resting=_template_shape(stage, space))
    chosen, count = replace(config.linear, ridges=(linear.ridge,)), read_json(stage.path / "shapes.json")["directions"]
    trust = examined(clips, layout, known_shapes, count, lambda known: fit_linear(known, layout, space.std, chosen))
    ranges = {"linear": replace(ControlRange.of(clips.all, layout), trust=trust)}
    linear_alone, kernel_alone = fit_linear(clips.settled, layout, space.std, chosen), None
    kernel = network = network_alone = None
    if config.regressor != "linear":
        own = ControlLayout.create(lesson.body, lesson.takes.skin_weights, layout.fps, config.kernel.control)
        wider = fitting_clips(lesson.takes, lesson.pieces, own, space, mirror, projected)
        if not (stage.path / KERNEL).is_file():
            learned = fit_kernel(wider, own, space.std, config.kernel)
            save_kernel(stage.path / KERNEL, learned, model_digest=digest)
        kernel = load_kernel(stage.path / KERNEL, model_digest=digest)
        plain = _untuned(config.kernel, kernel.ridge)
        trust = examined(wider, own, known_shapes, count, lambda known: fit_kernel(known, own, space.std, plain))
        ranges["kernel"] = replace(ControlRange.of(wider.all, own), trust=trust)
        kernel_alone = fit_kernel(wider.settled, own, space.std, plain)
    if config.regressor == "all":
        network, network_alone = _network(stage, clips, linear, space, config, device)
    known = KnownRange(poses, ranges, known_shapes)
    save_known_range(stage.path / POSES, known, model_digest=digest)
    note: dict[str, Any] = {
        "mirrored": mirror is not None,
        "control_numbers": layout.size,
        "joints": [layout.joint_names[j] for j in layout.joints],
    }
    ridges = {"linear": linear.ridge} if kernel is None else {"linear": linear.ridge, "kernel": kernel.ridge}
    late = len(clips.all) > len(clips.training)  # those of training alone then tell how they validated
    alone = regressors_by_name(known, linear_alone, network_alone, kernel_alone) if late else {}
    for name, regressor in regressors_by_name(known, linear, network, kernel).items():
        note[name] = {"ridge": ridges[name]} if name in ridges else {}
        for role in ROLES:
            asked = alone.get(name, regressor) if role == "validation" else regressor
            note[name] |= _errors(lesson, asked, role, space, projected)
        if name in ranges:
            note[name]["trust"] = [{"degrees": degrees, "share": share} for degrees, share in ranges[name].trust.knots]
    return note


def _template_shape(stage: Stage, space: ShapeSpace) -> Float32[np.ndarray, " shapes"]:
    """The coefficients of the template on the person of the takes, which is in the space."""
    template = load_blendshapes(stage.path / MODEL).garment.template.vertices
    return project(space, template[None], np.ones((1, len(template)), np.float32))[0].astype(np.float32)


def _untuned(config: KernelConfig, ridge: float) -> KernelConfig:
    """What the kernels are examined with, once for every take: a smaller problem, and no better."""
    tuning = replace(config.tuning, enabled=False)
    return replace(config, ridges=(ridge,), tuning=tuning, most_frames=min(config.most_frames, EXAMINED_FRAMES))


def _errors(
    lesson: _Lesson, regressor: Regressor, role: Role, space: ShapeSpace, projected: Projected
) -> dict[str, Any]:
    """How far a regressor is off on the takes of a role, if there are any."""
    takes, pieces = lesson.takes, lesson.pieces
    clips = regression_clips(takes, pieces, role, regressor.layout, space, None, projected)
    if not any(clip.good.any() for clip in clips):
        return {}
    error = vertex_error_m(takes, pieces, role, space, predictions(regressor, clips))
    measured = {"coefficient_mse_mm2": 1e6 * mean_squared_error(regressor, clips), "vertex_error_mm": 1e3 * error}
    return {role.replace(" ", "_"): measured}


def _network(
    stage: Stage, clips: FittingClips, linear: LinearRegressor, space: ShapeSpace, config: FitConfig, device: str
) -> tuple[Regressor, Regressor]:
    """The network, and the one of the training clips alone."""
    # torch takes a second to load
    from retarget.regression.lstm import load_lstm, save_lstm
    from retarget.regression.training import fit_lstm

    path, digest = stage.path / LSTM, shapes_digest(stage.path)
    found = fit_lstm(clips, linear.layout, space.std, stage.path, config, linear=linear, device=device)
    if not path.is_file():
        save_lstm(path, found.regressor, model_digest=digest)
    return load_lstm(path, model_digest=digest, linear=linear), found.alone
