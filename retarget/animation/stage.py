"""The stage that puts a learned garment on a motion: MODEL and poses in, WORK/registration and WORK/body out.

The output is a registered sequence like any other, without scan data: its residuals are NaN.

body/          body.npz, poses.npz: who moves, and how, at the model's frame rate
registration/  stage.json, garment.npz, frames/000123.npz, metrics/000123.json, vertices.npy, metrics.jsonl
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from capture4d.body.motion_files import read_motion
from capture4d.body.skinning import ShapedBody, with_shape
from capture4d.captures.work_folder import ANIMATE, VERDICTS, stack_vertices
from capture4d.errors import InputError
from capture4d.files.atomic import file_digest, read_json, write_bytes, write_json, write_npy, write_npz
from capture4d.files.records import load_body, load_poses, save_body, save_garment, save_poses
from capture4d.runs.stage import Stage, StageResult, open_stage
from capture4d.runs.workers import run_jobs
from capture4d.types import Body, PoseSequence
from retarget.animation.animator import AnimatedFrame, Animator
from retarget.animation.bodies import captured_person, require_skeleton, retargeted_mean
from retarget.config import AnimateConfig
from retarget.garment_model import GarmentModel, load_garment_model, regressor_files
from retarget.regression.controls import control_vectors

__all__ = ["run"]

SCHEMA = 1
FRAMES_PER_JOB = 16
INSIDE_CHECK_PERCENT = 0.3
"""A frame with more of its vertices inside the body, after all, is flagged."""


@dataclass(frozen=True, slots=True)
class _Job:
    model: Path
    output: Path
    stage: Stage
    rows: tuple[int, ...]


def run(
    model: Path,
    poses: Path,
    output: Path,
    config: AnimateConfig,
    *,
    body: Path | None = None,
    beta: Sequence[float] | None = None,
    coefficients: Float32[np.ndarray, "frames shapes"] | None = None,
    device: str = "cpu",
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Animate a garment.

    Args:
        model: what `fit` wrote.
        poses: a motion file; resampled to the model's frame rate.
        output: work folder; gets body/ and registration/.
        body: another person's body.npz, made of the same faces and joints.
        beta: shape coefficients of the person; without them those of the poses.npz beside `body`; without that as well
            the mean of `body`, or, without `body`, the captured person.
        coefficients: of the motion's frames, instead of a regressor's: a take's own projections, or edited ones.
    Raises:
        InputError: a file is damaged, the poses or the body are of another skeleton, or numbers are not finite.
    """
    known, name = _model(model, config, device)
    person = _person(known, body, beta)
    motion = _motion(known, poses, person)
    if (output / "body" / "stage.json").is_file():
        raise InputError(f"{output}: expected a folder for the animation alone, found a take with a tracked body")
    folder = output / "registration"
    upstream = {
        "model": known.digest,
        "poses": file_digest([poses], root=poses.parent),
        "regressor": file_digest(regressor_files(known.folder, name), root=known.folder),
    }
    if coefficients is not None:
        expected = (len(motion.frame_ids), len(known.model.std))
        if coefficients.shape != expected:
            raise InputError(f"coefficients: expected an array of {expected}, found {coefficients.shape}")
        if not np.isfinite(coefficients).all():
            raise InputError("coefficients: expected finite numbers, found NaN or inf")
        upstream["regressor"] = hashlib.sha256(coefficients.tobytes()).hexdigest()
    if body is not None:
        upstream["body"] = file_digest([body], root=body.parent)
    captured = captured_person(known.model, known.body)
    mean = retargeted_mean(known.model, captured, person, formula=config.mean)
    settings = {**asdict(config), "beta": [float(value) for value in person.shape]}
    sources = {"model": known.folder, "poses": poses}
    stage = open_stage(
        folder, name=ANIMATE, schema=SCHEMA, config=settings, upstream=upstream, sources=sources, overwrite=overwrite
    )
    save_body(output / "body" / "body.npz", person.body)
    save_poses(output / "body" / "poses.npz", motion)
    garment = known.model.garment
    template = garment.template.with_vertices(mean.astype(np.float32))
    save_garment(folder / "garment.npz", replace(garment, template=template, body_shape=motion.shape))
    if not (folder / "coefficients.npy").is_file():
        if coefficients is None:
            regressor = known.regressors[name]
            coefficients = regressor.predict(control_vectors(regressor.layout, motion))
        write_npy(folder / "coefficients.npy", coefficients)
    distances = known.poses.distances(motion)
    unlike = max(config.unlike_deg, known.poses.validated_deg)
    frame_ids = [int(frame_id) for frame_id in motion.frame_ids]
    pending = set(stage.pending(frame_ids))
    rows = [row for row, frame_id in enumerate(frame_ids) if frame_id in pending]
    chunks = [tuple(rows[start : start + FRAMES_PER_JOB]) for start in range(0, len(rows), FRAMES_PER_JOB)]
    _animator.cache_clear()
    job = partial(_animate, config, distances, unlike)
    jobs = [_Job(known.folder, output, stage, chunk) for chunk in chunks]
    for _ in run_jobs(job, jobs, workers=workers, label="animate", units=lambda each: len(each.rows)):
        pass
    return _collect(stage, frame_ids)


def _model(path: Path, config: AnimateConfig, device: str) -> tuple[GarmentModel, str]:
    """The model, and which of its regressors is meant; torch is loaded only if the LSTM takes part."""
    known = load_garment_model(path, device=device, with_lstm=config.regressor in ("auto", "ensemble", "lstm"))
    found = list(known.regressors)
    name = found[-1] if config.regressor == "auto" else config.regressor
    if name not in found:
        apart = name == "ensemble" and {"kernel", "lstm"} <= {*found}
        why = "; its kernels do not see all that its LSTM sees" if apart else ""
        raise InputError(
            f"{known.folder}: expected a regressor '{name}' in the model, found {', '.join(found)} only{why}"
        )
    return known, name


def _person(known: GarmentModel, body: Path | None, beta: Sequence[float] | None) -> ShapedBody:
    """Whom the garment is put on."""
    if body is None and beta is None:
        return captured_person(known.model, known.body)
    other = known.body if body is None else load_body(body)
    try:
        require_skeleton(known.model, other)
        shape = np.zeros(len(other.shape_directions), np.float32)
        given = np.asarray(_own_shape(body) if beta is None else beta, np.float32)
        if not np.isfinite(given).all():
            raise InputError("beta: expected finite numbers, found NaN or inf")
        if len(given) > len(shape):
            raise InputError(f"beta: expected at most {len(shape)} coefficients, found {len(given)}")
        shape[: len(given)] = given
        return with_shape(other, shape)
    except InputError as error:
        raise InputError(f"{body}: {error}" if body is not None else str(error)) from None


def _own_shape(body: Path | None) -> np.ndarray:
    """The shape of the person in a capture's or a tracked take's body.npz: that of the poses beside it. Of a body.npz
    that stands alone, the mean."""
    poses = None if body is None else body.with_name("poses.npz")
    return np.zeros(0, np.float32) if poses is None or not poses.is_file() else load_poses(poses).shape


def _motion(known: GarmentModel, path: Path, person: ShapedBody) -> PoseSequence:
    """The motion at the model's rate, on the person."""
    poses = read_motion(path, person.body)
    if not len(poses.frame_ids) or (np.diff(poses.frame_ids) <= 0).any():
        raise InputError(f"{path}: expected frames with ascending numbers, found {len(poses.frame_ids)} frames"
                         f"{' in disorder' if len(poses.frame_ids) else ''}")  # fmt: skip
    if poses.joint_names != known.model.joint_names:
        raise InputError(
            f"{path}: expected the {len(known.model.joint_names)} joints of the model, found {len(poses.joint_names)} "
            f"({', '.join(poses.joint_names[:4])}, ...)"
        )
    if abs(poses.fps - known.model.fps) > 1e-3 * known.model.fps:
        poses = read_motion(path, person.body, fps=known.model.fps)
    return replace(poses, shape=np.asarray(person.shape, np.float32))


@lru_cache(maxsize=1)
def _animator(model: Path, output: Path, config: AnimateConfig) -> tuple[Animator, PoseSequence, np.ndarray]:
    """What a worker prepares once."""
    known = load_garment_model(model, with_lstm=False)
    body: Body = load_body(output / "body" / "body.npz")
    poses = load_poses(output / "body" / "poses.npz")
    coefficients: Float32[np.ndarray, "frames shapes"] = np.load(
        output / "registration" / "coefficients.npy", allow_pickle=False
    )
    person = with_shape(body, poses.shape)
    mean = retargeted_mean(known.model, captured_person(known.model, known.body), person, formula=config.mean)
    return Animator(known.model, person, mean, config), poses, coefficients


def _animate(config: AnimateConfig, distances: np.ndarray, unlike: float, job: _Job) -> int:
    animator, poses, coefficients = _animator(job.model, job.output, config)
    for row, frame in zip(job.rows, animator.frames(poses, coefficients, job.rows), strict=True):
        _write_frame(job.stage, int(poses.frame_ids[row]), frame, float(distances[row]), unlike)
    return len(job.rows)


def _write_frame(stage: Stage, frame_id: int, frame: AnimatedFrame, distance_deg: float, unlike: float) -> None:
    """Metrics first: the frame counts as done once its npz is there."""
    removed = frame.removed
    reasons = []
    if distance_deg > unlike:
        reasons.append(f"pose {distance_deg:.0f} deg from every pose that was learned > {unlike:.0f}")
    if removed.after.inside_percent > INSIDE_CHECK_PERCENT:
        reasons.append(f"inside the body {removed.after.inside_percent:.2f} % > {INSIDE_CHECK_PERCENT:g} %")
    record: dict[str, Any] = {
        "frame_id": frame_id,
        "verdict": "check" if reasons else "good",
        "reasons": reasons,
        "pose_distance_deg": distance_deg,
        "unlike_deg": unlike,
        "inside_before_percent": removed.before.inside_percent,
        "depth_before_mm": removed.before.depth_max_mm,
        "inside_body_percent": removed.after.inside_percent,
        "depth_mm": removed.after.depth_max_mm,
        "removal_moved_mm": removed.rest_moved_mm,
        "stretch_p99": frame.stretch_p99,
    }
    write_json(stage.frame_path(frame_id, ".json", folder="metrics"), record)
    write_npz(
        stage.frame_path(frame_id),
        vertices=frame.vertices,
        residual_m=np.full(len(frame.vertices), np.nan, np.float32),
        verdict=np.uint8(VERDICTS.index(record["verdict"])),
    )


def _collect(stage: Stage, frame_ids: Sequence[int]) -> StageResult:
    stack_vertices(stage, frame_ids)
    records = [read_json(stage.frame_path(frame_id, ".json", folder="metrics")) for frame_id in frame_ids]
    write_bytes(stage.path / "metrics.jsonl", "".join(json.dumps(each) + "\n" for each in records).encode())
    frames = [stage.frame_path(frame_id) for frame_id in frame_ids]
    return stage.finish([stage.path / "garment.npz", stage.path / "vertices.npy", *frames])
