"""A learned garment on motions that nobody taught it: does it look like cloth, and is it never worse than skinning?

Worst over all models, motions and people:

stretch_p99_worst       edge length over the cloth's on the person, 99th percentile of the worst frame (wanted: 1.25)
inside_body_percent     vertices inside the body, worst frame (0.3)
farthest_mm             any vertex to the skinned template's (150)
failed_frames           (0)
worst_ratio_to_skinned  vertex error over the skinned template's, where the cloth was simulated on the motion (1)
like_taught_ratio       the same on the model's own clips: walk and hop, and the two that were held out (0.7)

Models: that of the demo's take, and of `tshirt-train`; of two clips of `tiny-train` with --quick, whose own clips are
those two. All are learned from the true places of the template; with --scans `tshirt-train` is registered first.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.cached_takes import cached_take
from benchmarks.learning_takes import learned_takes, registered_takes, training_set, true_take
from benchmarks.metric import Metric
from benchmarks.renewal import renew
from benchmarks.true_works import write_true_work
from benchmarks.unseen_motions import unseen_motions
from capture4d import pipeline
from capture4d.body.binding import with_body_shape
from capture4d.body.skinning import ShapedBody, pose_frame
from capture4d.cache import user_cache_folder
from capture4d.captures.capture import read_capture
from capture4d.captures.evaluation import correspondence_errors
from capture4d.captures.work_folder import load_records, load_registration
from capture4d.errors import InputError
from capture4d.files.records import load_poses, save_poses
from capture4d.motions.motion_files import read_motion
from capture4d.types import PoseSequence
from data_synth.config import PRESETS, TRAINING_SETS, MotionConfig, SynthConfig
from retarget.animation.garment_model import GarmentModel, load_garment_model
from retarget.animation.stage import Wearer
from retarget.config import FitConfig
from retarget.shapes.blendshapes import skin_frames

__all__ = ["run"]

HEAVY = (1.5, 2.0)
"""Somebody taller and heavier than the person the garment was learned on."""
TAUGHT = ("twist", "reach")
"""What the quick model has seen."""
UNTAUGHT = ("walk", "hop", "arm-circles")
"""Clips whose cloth is simulated. `tshirt-train` has seen the first two, and is measured on the last."""


OWN = ("walk", "hop")
"""What `tshirt-train` is measured on, beside the clips that it has held out."""


@dataclass(frozen=True)
class Model:
    """A learned garment, and the take that its truth is simulated like."""

    name: str
    folder: Path
    like: SynthConfig
    seen: tuple[str, ...] = ()
    own: tuple[Path, ...] = ()
    """Captures to measure on that are of its own kind: learned, or held out of the same set."""


def run(
    *,
    quick: bool = False,
    workers: int = 2,
    mocap: Path | None = None,
    frames: int = 60,
    training: bool = True,
    scans: bool = False,
    simulate: bool = False,
) -> list[Metric]:
    """Animate every model on every motion.

    Args:
        quick: a tiny model, few frames; the same keys.
        mocap: a folder of BVH files, to move to as well.
        frames: of each motion and simulated clip.
        training: also the model of `tshirt-train`, for whose takes an hour is needed the first time.
        scans: learn that from scans, which takes two hours more.
        simulate: the cloth on those of the BVH files that are named *walk* or *hop*, too.
    """
    if mocap is not None and not mocap.is_dir():
        raise InputError("expected a folder of BVH files, found none", where=mocap)
    recorded = sorted(mocap.glob("*.bvh")) if mocap else []
    count = 16 if quick else frames
    models = [_tiny(workers)] if quick else [_demo(workers), *([_trained(workers, scans)] if training else [])]
    measured: list[Measured] = []
    taught: list[Measured] = []
    for model in models:
        garment = load_garment_model(model.folder)
        for who in (None, HEAVY):
            person = garment.person(who)
            motions = dict(unseen_motions(person, garment.model.fps, count // 2 if quick else count))
            for path in recorded:
                motions[path.stem] = _first(read_motion(path, garment.body, fps=garment.model.fps), count)
            for name, poses in motions.items():
                measured.append(_measure(model, garment, name, poses, who, None))
        for name, motion in _truths(model, recorded if simulate else [], quick).items():
            take = replace(model.like, name=f"{model.like.name}-{name}", motion=motion, frames=count, scans=False)
            measured.append(_measure_take(model, garment, f"{name} (simulated)", cached_take(take, workers=workers)))
        taught += [_measure_take(model, garment, f"{path.name} (its own)", path) for path in model.own]
    measured += taught
    return [
        Metric("stretch_p99_worst", max(each.stretch for each in measured)),
        Metric("inside_body_percent", max(each.inside for each in measured), "%"),
        Metric("farthest_mm", max(each.farthest_mm for each in measured), "mm"),
        Metric("failed_frames", float(sum(each.failed for each in measured))),
        Metric("worst_ratio_to_skinned", max(each.ratio for each in measured if each.ratio is not None)),
        *([Metric("like_taught_ratio", max(each.ratio or 0.0 for each in taught))] if taught else []),
    ]


# --- models ------------------------------------------------------------------------------------------------------


def _fit(name: str, works: Sequence[Path], workers: int) -> Path:
    folder = user_cache_folder() / "works" / f"unseen-{name}" / "retarget"
    renew(partial(pipeline.fit, works, folder, FitConfig(), workers=workers))
    return folder


def _true_works(name: str, captures: Sequence[Path]) -> list[Path]:
    root = user_cache_folder() / "works" / f"unseen-{name}"
    return [write_true_work(read_capture(path, scans=False), root / path.name) for path in captures]


def _tiny(workers: int) -> Model:
    config = TRAINING_SETS["tiny-train"]
    takes = [replace(config.takes[name], scans=False) for name in TAUGHT]
    captures = tuple(cached_take(take, workers=workers) for take in takes)
    return Model("tiny", _fit("tiny", _true_works("tiny", captures), workers), takes[0], TAUGHT, captures)


def _demo(workers: int) -> Model:
    take = replace(PRESETS["demo"], scans=False)
    return Model("demo", _fit("demo", _true_works("demo", [cached_take(take, workers=workers)]), workers), take)


def _trained(workers: int, scans: bool) -> Model:
    config, folder = training_set(quick=False, scans=scans, workers=workers)
    names = learned_takes(config)
    captures = [folder / "takes" / name for name in names]
    if scans:
        works = registered_takes(config, folder, names, tracked=True, workers=workers)
    else:
        works = _true_works(config.name, captures)
    clips = tuple(config.takes[name].motion.clip for name in names)
    own = tuple(folder / "takes" / name for name in (*OWN, *config.held_out))
    name = f"{config.name}-scans" if scans else config.name
    return Model(name, _fit(name, works, workers), config.takes[names[0]], clips, own)


def _truths(model: Model, recorded: Sequence[Path], quick: bool) -> dict[str, MotionConfig]:
    """Motions whose cloth is simulated for a model."""
    clips = [name for name in UNTAUGHT[: 2 if quick else None] if name not in model.seen]
    found = {name: MotionConfig(clip=name) for name in clips}  # pyright: ignore[reportArgumentType]
    if not quick:
        filmed = [path for path in recorded if "walk" in path.stem or "hop" in path.stem]
        found |= {path.stem: MotionConfig(bvh=str(path)) for path in filmed}
    return found


# --- measures ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Measured:
    """One motion on one person."""

    stretch: float
    inside: float
    farthest_mm: float
    failed: int
    ratio: float | None


def _first(poses: PoseSequence, frames: int) -> PoseSequence:
    kept = slice(0, frames)
    return replace(
        poses, rotations=poses.rotations[kept], translations=poses.translations[kept], frame_ids=poses.frame_ids[kept]
    )


def _measure_take(model: Model, garment: GarmentModel, name: str, capture: Path) -> Measured:
    truth, _, poses, _ = true_take(read_capture(capture, scans=False))
    return _measure(model, garment, name, poses, None, np.asarray(truth.vertices))


def _measure(
    model: Model,
    garment: GarmentModel,
    name: str,
    poses: PoseSequence,
    who: tuple[float, ...] | None,
    truth: np.ndarray | None,
) -> Measured:
    """As `capture4d animate` makes it, beside the template skinned with the same poses."""
    with tempfile.TemporaryDirectory(prefix="capture4d-unseen-") as scratch:
        save_poses(Path(scratch) / "motion.npz", poses)
        output = Path(scratch) / "out"
        pipeline.animate(model.folder, Path(scratch) / "motion.npz", output, wearer=Wearer(beta=who))
        vertices = np.array(load_registration(output / "registration").vertices)
        records = load_records(output / "registration")
        skinned = _skinned(garment, garment.person(who), load_poses(output / "body" / "poses.npz"))
    ratio = None
    if truth is not None:
        ours, theirs = (
            np.mean([correspondence_errors(found, true).mean() for found, true in zip(each, truth, strict=True)])
            for each in (vertices, skinned)
        )
        ratio = float(ours / theirs)
    measured = Measured(
        stretch=max(record["stretch_p99"] for record in records),
        inside=max(record["inside_body_percent"] for record in records),
        farthest_mm=1e3 * float(np.linalg.norm(vertices - skinned, axis=2).max()),
        failed=sum(record["verdict"] == "failed" for record in records),
        ratio=ratio,
    )
    person = "captured" if who is None else f"beta {who}"
    Console(stderr=True).print(f"{model.name}, {name}, {person}: {measured}", soft_wrap=True)
    return measured


def _skinned(garment: GarmentModel, person: ShapedBody, poses: PoseSequence) -> np.ndarray:
    """The template, graded to a person, moved by its skin weights alone; (T, V, 3)."""
    template = with_body_shape(garment.model.garment, person.body, np.asarray(person.shape, np.float32)).template
    weights = garment.model.garment.skin_weights
    assert weights is not None
    transforms = np.stack([pose_frame(person, poses, row).transforms for row in range(len(poses.frame_ids))])
    return skin_frames(np.repeat(template.vertices[None], len(transforms), axis=0), weights, transforms)
