"""Takes to learn a garment from, registered or as they truly were; made once, kept in the user's cache."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.cached_takes import cached_training_set, one_maker
from benchmarks.renewal import renew
from capture4d import pipeline
from capture4d.body.skinning import ShapedBody, with_shape
from capture4d.captures.capture import Capture, read_capture
from capture4d.captures.evaluation import material_points
from capture4d.captures.truth import read_truth_model, read_truth_vertices
from capture4d.captures.work_folder import load_records, load_registration, open_work
from capture4d.files.records import load_poses
from capture4d.types import Garment, PoseSequence, RegisteredSequence
from data_synth.config import TRAINING_SETS, TrainingSetConfig
from retarget.config import ShapeConfig
from retarget.regression.learning import Take, UnposedTakes
from retarget.regression.splits import Piece, Role
from retarget.shapes.pose_normalisation import PoseRows, unpose_sequence

__all__ = ["Lesson", "learned_takes", "lesson", "registered_takes", "training_set", "true_places", "true_take"]


@dataclass(frozen=True, slots=True, eq=False)
class Lesson:
    """Everything to learn from and to be examined on."""

    takes: UnposedTakes
    pieces: tuple[Piece, ...]
    """Training and validation clips; the held-out ones have the role "held out"."""
    reversed: tuple[Piece, ...]
    """The clips that run backwards, as if they were held out."""
    garment: Garment
    person: ShapedBody


def training_set(*, quick: bool, workers: int, scans: bool = True) -> tuple[TrainingSetConfig, Path]:
    """The set and its folder; made if this machine has not made it before.

    Args:
        scans: without them only the cloth is simulated, on the captured person, and of no clip that runs backwards.
    """
    config = TRAINING_SETS["tiny-train" if quick else "tshirt-train"]
    if not scans:
        takes = {name: replace(take, scans=False) for name, take in config.takes.items() if name not in config.reversed}
        config = replace(config, takes=takes, reversed=(), bodies={})
    return config, cached_training_set(config, workers=workers)


def learned_takes(config: TrainingSetConfig) -> list[str]:
    """The clips that may be learned from."""
    return [name for name in config.takes if name not in config.held_out and name not in config.reversed]


def registered_takes(
    config: TrainingSetConfig, folder: Path, names: Sequence[str], *, tracked: bool, workers: int
) -> list[Path]:
    """The work folders of some clips, beside the set; what is there already costs seconds.

    Args:
        tracked: register with the body that was tracked, not with the poses of the capture.
    """
    works = []
    for name in names:
        works.append(folder / "works" / name)
        capture = folder / "takes" / name
        with one_maker(works[-1]):
            renew(partial(pipeline.run, capture, works[-1], tracked=tracked, draw=False, workers=workers))
    return works


def lesson(config: TrainingSetConfig, folder: Path, *, truth: bool, tracked: bool, workers: int) -> Lesson:
    """The takes of a set.

    Args:
        truth: the template's true places instead of its registrations.
        tracked: register with the body that was tracked, not with the poses of the capture.
    """
    names = list(config.takes)
    sequences = []
    for name in names:
        capture = read_capture(folder / "takes" / name)
        if truth:
            sequences.append(true_take(capture))
        else:
            (work,) = registered_takes(config, folder, [name], tracked=tracked, workers=workers)
            body, poses = open_work(work).require_posed_body()
            good = np.array([record["verdict"] != "failed" for record in load_records(work / "registration")])
            sequences.append((load_registration(work / "registration"), with_shape(body, poses.shape), poses, good))
    learned = learned_takes(config)
    shapes = [poses.shape for name, (_, _, poses, _) in zip(names, sequences, strict=True) if name in learned]
    person = np.mean(shapes, axis=0).astype(np.float32)
    takes, frames, weights = [], [], []
    for name, (registered, shaped, poses, good) in zip(names, sequences, strict=True):
        rows = PoseRows.match(registered, shaped, poses)
        for rest, weight in unpose_sequence(registered, rows, person, unseen_weight=ShapeConfig().unseen_weight):
            frames.append(rest)
            weights.append(weight)
        transforms = np.stack([rows.transforms(row) for row in range(len(good))])
        takes.append(Take(name, rows.poses, good, transforms))
    registered, shaped, _, _ = sequences[0]
    skin_weights = registered.garment.skin_weights
    assert skin_weights is not None
    unposed = UnposedTakes(takes, np.stack(frames), np.stack(weights), skin_weights)
    pieces = [Piece(take, range(len(each.good)), _role(names[take], config)) for take, each in enumerate(takes)]
    backwards = tuple(piece for piece in pieces if names[piece.take] in config.reversed)
    return Lesson(
        unposed,
        tuple(piece for piece in pieces if piece not in backwards),
        backwards,
        replace(registered.garment, body_shape=person),
        with_shape(shaped.body, person),
    )


def _role(name: str, config: TrainingSetConfig) -> Role:
    """The last clip that is learned from validates."""
    if name in config.held_out or name in config.reversed:
        return "held out"
    return "validation" if name == learned_takes(config)[-1] else "training"


def true_take(capture: Capture) -> tuple[RegisteredSequence, ShapedBody, PoseSequence, np.ndarray]:
    """A take as if it had been registered without any error, with its exact poses."""
    body, poses = capture.body, load_poses(capture.path / "truth" / "poses.npz")
    assert body is not None
    places = true_places(capture)
    registered = RegisteredSequence(
        capture.template, places, np.zeros(places.shape[:2], np.float32), np.array(capture.frame_ids, np.int32)
    )
    return registered, with_shape(body, poses.shape), poses, np.ones(len(places), bool)


def true_places(capture: Capture) -> np.ndarray:
    """(T, V, 3) float32: where the template's material points truly are, metres."""
    model = read_truth_model(capture)
    assert model is not None
    return np.stack(
        [
            material_points(
                read_truth_vertices(capture, frame_id),
                model.fine.faces,
                model.template_faces,
                model.template_barycentric,
            )
            for frame_id in capture.frame_ids
        ]
    )
