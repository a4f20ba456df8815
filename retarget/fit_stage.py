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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.body.binding import with_body_shape
from capture4d.body.skinning import with_shape
from capture4d.captures.work_folder import VERDICTS, load_moving_body, load_records, load_registration
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_json, write_npy, write_npy_rows
from capture4d.files.records import load_garment, save_body
from capture4d.runs.stage import Stage, StageResult, open_stage, require_complete
from capture4d.runs.workers import run_jobs
from capture4d.types import BlendshapeModel, Body, PoseSequence
from retarget.config import FitConfig
from retarget.garment_model import KERNEL, LINEAR, LSTM, MODEL, POSES, model_digest_of, piece_name, regressors_by_name
from retarget.regression.controls import ControlLayout
from retarget.regression.kernel import KernelRegressor, fit_kernel, load_kernel, save_kernel
from retarget.regression.learning import (
    Projected,
    Take,
    UnposedTakes,
    fitting_clips,
    learn_shapes,
    predictions,
    regression_clips,
    training_poses,
    vertex_error_m,
)
from retarget.regression.linear import LinearRegressor, fit_linear, save_linear
from retarget.regression.pose_range import save_pose_range
from retarget.regression.regressors import FittingClips, Regressor, mean_squared_error
from retarget.regression.splits import ROLES, Piece, split_takes
from retarget.shapes.blendshapes import ShapeSpace, as_model_arrays, shape_space, worst_errors
from retarget.shapes.files import load_blendshapes, save_blendshapes
from retarget.shapes.mirroring import Mirror, find_mirror
from retarget.shapes.pose_normalisation import PoseRows, unpose_sequence

__all__ = ["run"]

SCHEMA = 4


SAME_WEIGHTS = 1e-3
"""Largest difference of skin weights that are the same."""


def run(
    works: Sequence[Path],
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
    works = sorted(works, key=lambda work: work.resolve().name)
    names = [work.resolve().name for work in works]
    if len(set(names)) != len(names):
        raise InputError(f"takes: expected work folders of different names, found {', '.join(sorted(names))}")
    upstream = {
        name: require_complete(work / "registration", "register", f"capture4d run CAPTURE --output {work}")
        for name, work in zip(names, works, strict=True)
    }
    body, moving = _moving_bodies(works)
    split_takes(names, [len(poses.frame_ids) for poses in moving], moving[0].fps, config.split)
    stage = open_stage(output, name="fit", schema=SCHEMA, config=config, upstream=upstream, overwrite=overwrite)
    if (output / "fit.json").is_file() and all((output / name).is_file() for name in _files(config)):
        return _finish(stage, config)
    learned = [poses.shape for name, poses in zip(names, moving, strict=True) if name not in config.split.held_out]
    person = np.mean(learned, axis=0).astype(np.float32)
    if not (output / "body.npz").is_file():
        save_body(output / "body.npz", body)
    unpose = partial(_unpose_take, stage.path, config.shape.unseen_weight, person)
    jobs = [_UnposeJob(name, work) for name, work in zip(names, works, strict=True)
            if not ((stage.path / "takes" / f"{name}.json").is_file()
                    and (stage.path / "unposed" / f"{name}.weights.npy").is_file())]  # fmt: skip
    for _ in run_jobs(unpose, jobs, workers=workers, label="unpose"):
        pass
    takes = _stacked(stage, works, names, body, moving)
    pieces = split_takes(names, [len(take.good) for take in takes.takes], takes.takes[0].poses.fps, config.split)
    model, shape_note = _blendshapes(stage, works, takes, pieces, body, person, config)
    layout = ControlLayout.create(body, takes.skin_weights, takes.takes[0].poses.fps, config.control)
    mirror = find_mirror(model.garment.template.with_vertices(model.mean), body.joint_names, config.mirror)
    known = training_poses(takes, pieces, layout, mirror)
    save_pose_range(output / POSES, known, model_digest=model_digest_of(output))
    note = shape_note | _regressors(stage, takes, pieces, layout, shape_space(model), mirror, body, config, device)
    split = {role: [piece_name(names, piece) for piece in pieces if piece.role == role]
             for role in ROLES}  # fmt: skip
    write_json(output / "fit.json", {"split": split, "validated_deg": known.validated_deg, **note})
    return _finish(stage, config)


def _files(config: FitConfig) -> list[str]:
    """What a finished model consists of."""
    kernel, network = config.regressor != "linear", config.regressor == "all"
    return ["body.npz", MODEL, LINEAR, POSES, *([KERNEL] if kernel else []), *([LSTM] if network else [])]


def _finish(stage: Stage, config: FitConfig) -> StageResult:
    result = stage.finish([stage.path / name for name in _files(config)])
    shutil.rmtree(stage.path / "unposed", ignore_errors=True)
    return result


# --- takes -------------------------------------------------------------------------------------------------------


def _moving_bodies(works: Sequence[Path]) -> tuple[Body, list[PoseSequence]]:
    """The one body of all takes, and the poses of each."""
    found = [load_moving_body(work) for work in works]
    body, first = found[0]
    bound = load_garment(works[0] / "registration" / "garment.npz")
    template, skin_weights = bound.template, bound.skin_weights
    for work, (other, poses) in zip(works, found, strict=True):
        if other.joint_names != body.joint_names or not np.array_equal(other.template.faces, body.template.faces):
            raise InputError(f"{work}: expected the body of {works[0]}, found another skeleton or mesh")
        if abs(poses.fps - first.fps) > 1e-3 * first.fps:
            raise InputError(f"{work}: expected {first.fps:g} frames a second as in {works[0]}, found {poses.fps:g}")
        if len(poses.shape) != len(first.shape):
            raise InputError(f"{work}: expected {len(first.shape)} shape coefficients, found {len(poses.shape)}")
        garment = load_garment(work / "registration" / "garment.npz")
        if not np.array_equal(garment.template.faces, template.faces):
            raise InputError(
                f"{work}: expected the template of {works[0]} ({len(template.vertices)} vertices, "
                f"{len(template.faces)} faces), found one of {len(garment.template.vertices)} and "
                f"{len(garment.template.faces)}"
            )
        ours, theirs = skin_weights, garment.skin_weights
        if ours is not None and theirs is not None and not np.allclose(ours, theirs, atol=SAME_WEIGHTS):
            raise InputError(f"{work}: expected the skin weights of {works[0]}, found others; one template serves all "
                             "takes, bound once")  # fmt: skip
    return body, [poses for _, poses in found]


@dataclass(frozen=True, slots=True)
class _UnposeJob:
    name: str
    work: Path


def _unpose_take(output: Path, unseen_weight: float, person: np.ndarray, job: _UnposeJob) -> None:
    """Write a take's frames in the rest pose, on the person whom all takes share."""
    registered = load_registration(job.work / "registration")
    body, poses = load_moving_body(job.work)
    rows = PoseRows.match(registered, with_shape(body, poses.shape), poses)
    weights = []

    def frames() -> Iterator[np.ndarray]:
        for rest, weight in unpose_sequence(registered, rows, person, unseen_weight=unseen_weight):
            weights.append(weight)
            yield rest

    folder = output / "unposed"
    write_npy_rows(folder / f"{job.name}.vertices.npy", frames(), count=len(registered.frame_ids))
    write_npy(folder / f"{job.name}.weights.npy", np.stack(weights))
    found = {record.get("frame_id"): record.get("verdict") for record in load_records(job.work / "registration")}
    for frame_id in registered.frame_ids.tolist():
        if found.get(frame_id) not in VERDICTS:
            path = job.work / "registration" / "metrics.jsonl"
            raise InputError(f"{path}: frame {frame_id}: expected a verdict, found {found.get(frame_id) or 'none'}")
    verdicts = [found[frame_id] for frame_id in registered.frame_ids.tolist()]
    write_json(output / "takes" / f"{job.name}.json", {"frames": registered.frame_ids, "verdicts": verdicts})


def _stacked(
    stage: Stage, works: Sequence[Path], names: Sequence[str], body: Body, moving: Sequence[PoseSequence]
) -> UnposedTakes:
    """All takes' frames in one array on disk."""
    folder = stage.path / "unposed"
    parts = [np.load(folder / f"{name}.vertices.npy", mmap_mode="r", allow_pickle=False) for name in names]
    path = folder / "all.npy"
    if not path.is_file():
        write_npy_rows(path, (row for part in parts for row in part), count=sum(map(len, parts)))
    takes, skin_weights = [], load_garment(works[0] / "registration" / "garment.npz").skin_weights
    assert skin_weights is not None
    for name, work, poses in zip(names, works, moving, strict=True):
        rows = PoseRows.match(load_registration(work / "registration"), with_shape(body, poses.shape), poses)
        verdicts = read_json(stage.path / "takes" / f"{name}.json")["verdicts"]
        transforms = np.stack([rows.transforms(row) for row in range(len(verdicts))])
        takes.append(Take(name, rows.poses, np.array([each == "good" for each in verdicts]), transforms))
    good = int(sum(take.good.sum() for take in takes))
    if good < 2:
        frames = sum(len(take.good) for take in takes)
        raise InputError(f"takes: expected at least 2 good frames to learn from, found {good} of {frames}")
    return UnposedTakes(
        takes,
        np.load(path, mmap_mode="r", allow_pickle=False),
        np.concatenate([np.load(folder / f"{name}.weights.npy", allow_pickle=False) for name in names]),
        skin_weights,
    )


# --- learning ----------------------------------------------------------------------------------------------------


def _blendshapes(
    stage: Stage,
    works: Sequence[Path],
    takes: UnposedTakes,
    pieces: Sequence[Piece],
    body: Body,
    person: np.ndarray,
    config: FitConfig,
) -> tuple[BlendshapeModel, dict[str, Any]]:
    """Learn the shape space, unless an earlier run has."""
    path, note_path = stage.path / MODEL, stage.path / "shapes.json"
    if path.is_file() and note_path.is_file():
        return load_blendshapes(path), read_json(note_path)
    space, fewest = learn_shapes(takes, pieces, config.shape)
    garment = with_body_shape(load_garment(works[0] / "registration" / "garment.npz"), body, person)
    mean, basis, std = as_model_arrays(space)
    model = BlendshapeModel(
        replace(garment, body_shape=person), mean, basis, std, body.joint_names, takes.takes[0].poses.fps,
        config.licence or "none given",
    )  # fmt: skip
    save_blendshapes(path, model)
    note: dict[str, Any] = {"directions": len(std), "directions_for_max_error": fewest}
    for role in ROLES:
        rows = takes.rows(pieces, role)
        if len(rows):
            mean_m, worst_m = _errors(takes, rows, space)
            note[f"{role.replace(' ', '_')}_frames"] = len(rows)
            note[f"{role.replace(' ', '_')}_shape_error_mm"] = {"mean": 1e3 * mean_m, "worst": 1e3 * worst_m}
    write_json(note_path, note)
    return model, note


def _errors(takes: UnposedTakes, rows: np.ndarray, space: ShapeSpace) -> tuple[float, float]:
    count = len(space.std)
    return worst_errors(
        space, takes.vertices, takes.weights, rows, takes.transforms, takes.skin_weights, [count]
    )[count]  # fmt: skip


def _regressors(
    stage: Stage,
    takes: UnposedTakes,
    pieces: Sequence[Piece],
    layout: ControlLayout,
    space: ShapeSpace,
    mirror: Mirror | None,
    body: Body,
    config: FitConfig,
    device: str,
) -> dict[str, Any]:
    """Learn what is not there yet, and measure all of it."""
    digest = model_digest_of(stage.path)
    projected: Projected = {}
    lesson = fitting_clips(takes, pieces, layout, space, mirror, projected)
    linear = fit_linear(lesson, layout, space.std, config.linear)
    save_linear(stage.path / LINEAR, linear, model_digest=digest)
    kernel = network = None
    if config.regressor != "linear":
        if not (stage.path / KERNEL).is_file():
            own = ControlLayout.create(body, takes.skin_weights, layout.fps, config.kernel.control)
            wider = fitting_clips(takes, pieces, own, space, mirror, projected)
            learned = fit_kernel(wider, own, space.std, config.kernel)
            save_kernel(stage.path / KERNEL, learned, model_digest=digest)
        kernel = load_kernel(stage.path / KERNEL, model_digest=digest)
    if config.regressor == "all":
        network = _network(stage, lesson, layout, space, linear, config, device, digest)
    note: dict[str, Any] = {
        "mirrored": mirror is not None,
        "control_numbers": layout.size,
        "joints": [layout.joint_names[j] for j in layout.joints],
    }
    for name, regressor in regressors_by_name(linear, network, kernel).items():
        note[name] = {"ridge": regressor.ridge} if isinstance(regressor, (LinearRegressor, KernelRegressor)) else {}
        for role in ROLES:
            known = regression_clips(takes, pieces, role, regressor.layout, space, None, projected)
            if any(clip.good.any() for clip in known):
                error = vertex_error_m(takes, pieces, role, space, predictions(regressor, known))
                note[name][role.replace(" ", "_")] = {
                    "coefficient_mse_mm2": 1e6 * mean_squared_error(regressor, known),
                    "vertex_error_mm": 1e3 * error,
                }
    return note


def _network(
    stage: Stage,
    lesson: FittingClips,
    layout: ControlLayout,
    space: ShapeSpace,
    linear: LinearRegressor,
    config: FitConfig,
    device: str,
    digest: str,
) -> Regressor:
    # torch takes a second to load
    from retarget.regression.lstm import load_lstm, save_lstm
    from retarget.regression.training import fit_lstm

    path = stage.path / LSTM
    if not path.is_file():
        found = fit_lstm(
            lesson, layout, space.std, stage.path,
            lstm=config.lstm, config=config.training, linear=linear, linear_config=config.linear, device=device,
        )  # fmt: skip
        save_lstm(path, found, model_digest=digest)
    return load_lstm(path, model_digest=digest, linear=linear)


# --- reading -----------------------------------------------------------------------------------------------------
