"""The stage that puts a learned garment on a motion: MODEL and poses in, WORK/registration and WORK/body out.

The output is a registered sequence like any other, without scan data: its residuals are NaN.

body/          body.npz, poses.npz: who moves, and how, at the rate of what is written
registration/  stage.json, garment.npz, frames/000123.npz, metrics/000123.json, vertices.npy, metrics.jsonl
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from capture4d.body.skinning import ShapedBody
from capture4d.captures.animations.frame_files import (
    FRAMES_AT_ONCE,
    FrameFiles,
    collect,
    motion_files,
    open_frames,
    write_frame,
)
from capture4d.errors import InputError
from capture4d.files.arrays import map_array
from capture4d.files.atomic import file_digest, write_npy
from capture4d.files.outputs import require_apart
from capture4d.files.records import load_body, load_poses, save_body, save_garment, save_poses
from capture4d.motions.motion_files import rate_note, read_motion, resample, same_rate, told
from capture4d.runs.stage import Stage, StageResult
from capture4d.runs.workers import run_jobs
from capture4d.types import PoseSequence
from retarget.animation.animator import Animator
from retarget.animation.bodies import captured_person, person_of_shape, require_motion, retargeted_mean
from retarget.animation.frame_rates import coefficients_at, seconds
from retarget.animation.garment_model import GarmentModel, load_garment_model
from retarget.config import AnimateConfig
from retarget.mixture.config import MODEL as STYLES_MODEL
from retarget.model_folder import regressor_files
from retarget.regression.controls import control_vectors

__all__ = ["Wearer", "run", "run_on_coefficients"]


@dataclass(frozen=True, slots=True)
class Wearer:
    """Whom a garment is put on; by default the person it was learned on."""

    body: Path | None = None
    """Another person's body.npz, made of the same faces and joints."""
    beta: Sequence[float] | None = None
    """Shape coefficients of the person; without them those of the poses.npz beside `body`, and without that as well the
    mean of `body`."""
    style: Mapping[str, float] | Sequence[float] | None = None
    """Numbers of the style, by name or in their order, of a garment with styles alone; in the middle of their range
    without."""


def run(
    model: Path,
    poses: Path,
    output: Path,
    config: AnimateConfig,
    *,
    wearer: Wearer = Wearer(),
    device: str = "cpu",
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Animate a garment.

    Args:
        model: what `fit` wrote, or `fit-styles`.
        poses: a motion file; resampled to the model's frame rate, or written at `config.fps`.
        output: work folder; gets body/ and registration/.
        device: of the LSTM.
    Raises:
        InputError: a file is damaged, or would be written over; the poses or the body are of another skeleton, or
            numbers are not finite.
    """
    require_apart(motion_files(output), [poses, wearer.body])
    if (model / STYLES_MODEL).is_file():
        return _run_styled(model, poses, output, config, wearer, workers=workers, overwrite=overwrite)
    if wearer.style is not None:
        raise InputError("style: expected a garment with styles, which fit-styles learns, found another", where=model)
    known, name = _model(model, config, device)
    scene = _scene(known, poses, wearer, config)
    digest = file_digest(regressor_files(known.folder, name), root=known.folder)
    stage = _open(output, scene, config, digest, overwrite)
    path = stage.path / "coefficients.npy"
    if path.is_file():
        coefficients = map_array(path)
    else:
        regressor = known.regressors[name]
        coefficients = regressor.predict(control_vectors(regressor.layout, scene.motion))
        write_npy(path, coefficients)
    return _animate(stage, scene, coefficients, config, workers)


def _run_styled(
    model: Path, poses: Path, output: Path, config: AnimateConfig, wearer: Wearer, *, workers: int, overwrite: bool
) -> StageResult:
    # torch takes a second to load
    from retarget.animation.styled import run as styled

    if wearer.body is not None:
        raise InputError("--body: expected none, for a garment with styles is worn on its own body", where=model)
    _require_no_take(output)
    return styled(
        model, poses, output, config,
        beta=tuple(wearer.beta or ()), style=wearer.style or {}, workers=workers, overwrite=overwrite,
    )  # fmt: skip


def run_on_coefficients(
    model: Path,
    poses: Path,
    coefficients: Float32[np.ndarray, "frames shapes"],
    output: Path,
    config: AnimateConfig,
    *,
    wearer: Wearer = Wearer(),
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """`run` with coefficients of the motion's frames, at the model's rate, instead of a regressor's: a take's own
    projections, or edited ones."""
    require_apart(motion_files(output), [poses, wearer.body])
    known = load_garment_model(model, with_lstm=False)
    scene = _scene(known, poses, wearer, config)
    expected = (len(scene.motion.frame_ids), len(known.model.std))
    if coefficients.shape != expected:
        raise InputError(f"coefficients: expected an array of {expected}, found {coefficients.shape}")
    if not np.isfinite(coefficients).all():
        raise InputError("coefficients: expected finite numbers, found NaN or inf")
    stage = _open(output, scene, config, hashlib.sha256(coefficients.tobytes()).hexdigest(), overwrite)
    if not (stage.path / "coefficients.npy").is_file():
        write_npy(stage.path / "coefficients.npy", coefficients)
    return _animate(stage, scene, coefficients, config, workers)


# --- inputs ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What was read: the garment, who wears it and how they move."""

    known: GarmentModel
    person: ShapedBody
    motion: PoseSequence
    """At the model's rate, with the shape of the person: what regressors are asked."""
    shown: PoseSequence
    """The same at the rate of what is written."""
    mean: Float64[np.ndarray, "verts 3"]
    """The garment's, in the person's rest pose."""
    sources: Mapping[str, Path]
    digests: Mapping[str, str]


def _scene(known: GarmentModel, poses: Path, wearer: Wearer, config: AnimateConfig) -> _Scene:
    person = _person(known, wearer)
    motion, shown = _motion(known, poses, person, config.fps)
    mean = retargeted_mean(known.model, captured_person(known.model, known.body), person, formula=config.mean)
    digests = {"model": known.digest, "poses": file_digest([poses], root=poses.parent)}
    if wearer.body is not None:
        digests["body"] = file_digest([wearer.body], root=wearer.body.parent)
    return _Scene(known, person, motion, shown, mean, {"model": known.folder, "poses": poses}, digests)


def _model(path: Path, config: AnimateConfig, device: str) -> tuple[GarmentModel, str]:
    """The model, and which of its regressors is meant; torch is loaded only if the LSTM takes part."""
    known = load_garment_model(path, device=device, with_lstm=config.regressor in ("auto", "ensemble", "lstm"))
    found = list(known.regressors)
    name = known.best_name if config.regressor == "auto" else config.regressor
    if name not in found:
        apart = name == "ensemble" and {"kernel", "lstm"} <= {*found}
        why = "; its kernels do not see all that its LSTM sees" if apart else ""
        reason = f"expected a regressor '{name}' in the model, found {', '.join(found)} only{why}"
        raise InputError(reason, where=known.folder)
    return known, name


def _person(known: GarmentModel, wearer: Wearer) -> ShapedBody:
    """Whom the garment is put on."""
    if wearer.body is None:
        return known.person(wearer.beta)
    body, beta = load_body(wearer.body), _own_shape(wearer.body) if wearer.beta is None else wearer.beta
    try:
        return person_of_shape(known.model, body, beta)
    except InputError as error:
        raise error.at(wearer.body) from None


def _own_shape(body: Path) -> np.ndarray:
    """The shape of the person in a capture's or a tracked take's body.npz: that of the poses beside it. Of a body.npz
    that stands alone, the mean."""
    poses = body.with_name("poses.npz")
    return load_poses(poses).shape if poses.is_file() else np.zeros(0, np.float32)


def _motion(
    known: GarmentModel, path: Path, person: ShapedBody, fps: float | None
) -> tuple[PoseSequence, PoseSequence]:
    """The motion on the person, at the model's rate and at the wanted one; both from the file's own frames."""
    say = told(path)
    found = read_motion(path, person.body, say=say)
    try:
        require_motion(known.model, found)
        found = replace(found, shape=np.asarray(person.shape, np.float32))
        asked = _at_rate(found, known.model.fps)
        shown = asked if fps is None or same_rate(fps, asked.fps) else _at_rate(found, fps)
    except InputError as error:
        raise error.at(path) from None
    if shown is not found:
        whose = "" if fps else "the model's"
        between = "" if same_rate(shown.fps, asked.fps) else f"; the garment answers at the model's {asked.fps:g}"
        say(rate_note(found.fps, len(found.frame_ids), shown.fps, len(shown.frame_ids), whose=whose) + between)
    elif asked is not found:
        say(f"{found.fps:g} frames a second, as wanted; the garment answers at the model's {asked.fps:g}")
    return asked, shown


def _at_rate(poses: PoseSequence, fps: float) -> PoseSequence:
    return poses if same_rate(poses.fps, fps) else resample(poses, fps)


def _open(output: Path, scene: _Scene, config: AnimateConfig, regressor: str, overwrite: bool) -> Stage:
    """The stage of the registration; the person and the motion are written beside it.

    Args:
        regressor: digest of what the coefficients come from.
    """
    _require_no_take(output)
    settings = {**asdict(config), "beta": [float(value) for value in scene.person.shape]}
    upstream = {**scene.digests, "regressor": regressor}
    stage = open_frames(output, settings, upstream, scene.sources, overwrite=overwrite)
    body, poses = motion_files(output)
    save_body(body, scene.person.body)
    save_poses(poses, scene.shown)
    return stage


def _require_no_take(output: Path) -> None:
    if (output / "body" / "stage.json").is_file():
        raise InputError("expected a folder for the animation alone, found a take with a tracked body", where=output)


# --- frames ------------------------------------------------------------------------------------------------------


def _animate(
    stage: Stage, scene: _Scene, coefficients: Float32[np.ndarray, "frames shapes"], config: AnimateConfig, workers: int
) -> StageResult:
    """Write the garment, and the frames that are missing.

    Args:
        coefficients: of the motion's frames at the model's rate.
    """
    known, motion = scene.known, scene.shown
    if motion is not scene.motion:
        coefficients = coefficients_at(coefficients, seconds(scene.motion), seconds(motion))
    garment = known.model.garment
    template = garment.template.with_vertices(scene.mean.astype(np.float32))
    save_garment(stage.path / "garment.npz", replace(garment, template=template, body_shape=motion.shape))
    frame_ids = [int(frame_id) for frame_id in motion.frame_ids]
    pending = set(stage.pending(frame_ids))
    rows = [row for row, frame_id in enumerate(frame_ids) if frame_id in pending]
    chunks = [tuple(rows[start : start + FRAMES_AT_ONCE]) for start in range(0, len(rows), FRAMES_AT_ONCE)]
    unlike = max(config.unlike_deg, known.limits.poses.validated_deg)
    shared = FrameFiles(stage, motion, known.limits.poses.distances(motion), unlike)
    write = partial(_write_frames, shared, coefficients)
    prepare = partial(Animator, known.model, scene.person, scene.mean, config)
    for _ in run_jobs(write, chunks, prepare=prepare, workers=workers, label="animate", units=len):
        pass
    return collect(stage, frame_ids)


def _write_frames(
    shared: FrameFiles, coefficients: Float32[np.ndarray, "frames shapes"], animator: Animator, rows: Sequence[int]
) -> None:
    for row, frame in zip(rows, animator.frames(shared.poses, coefficients, rows), strict=True):
        write_frame(shared, row, frame)
