"""The takes that a garment is learned from: read, checked against each other, and put into one rest pose.

takes/NAME.json             verdicts of the frames that were unposed; done when it is there
unposed/NAME.vertices.npy   the frames in the rest pose, and unposed/NAME.weights.npy; gone when the model is finished
unposed/all.npy             those of all takes, one after the other
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from capture4d.body.skinning import with_shape
from capture4d.captures.work_folder import VERDICTS, WorkFolder, load_registration
from capture4d.errors import InputError
from capture4d.files.arrays import map_array
from capture4d.files.atomic import read_json, write_json, write_npy, write_npy_rows
from capture4d.files.records import load_garment
from capture4d.runs.workers import run_jobs
from capture4d.types import Body, Garment, PoseSequence
from retarget.regression.learning import Take, UnposedTakes
from retarget.shapes.pose_normalisation import PoseRows, unpose_sequence

__all__ = ["RegisteredTake", "read_takes", "stack_takes", "unpose_takes"]

SAME_WEIGHTS = 1e-3
"""Largest difference of skin weights that are the same."""


@dataclass(frozen=True, slots=True, eq=False)
class RegisteredTake:
    """A take, its frames still unread, for they are many."""

    work: WorkFolder
    garment: Garment
    body: Body
    poses: PoseSequence

    @property
    def name(self) -> str:
        return self.work.path.resolve().name


def read_takes(works: Sequence[WorkFolder]) -> list[RegisteredTake]:
    """Takes of one garment on one body.

    Raises:
        InputError: they do not fit together; names the first that does not.
    """
    takes = [_read_take(work) for work in works]
    for take in takes:
        try:
            _require_alike(take, takes[0])
        except InputError as error:
            raise error.at(take.work.path) from None
    return takes


def _read_take(work: WorkFolder) -> RegisteredTake:
    body, poses = work.require_posed_body()
    return RegisteredTake(work, load_garment(work.path / "registration" / "garment.npz"), body, poses)


def _require_alike(take: RegisteredTake, first: RegisteredTake) -> None:
    where, body, poses, template = first.work.path, take.body, take.poses, take.garment.template
    if body.joint_names != first.body.joint_names or not np.array_equal(body.template.faces, first.body.template.faces):
        raise InputError(f"expected the body of {where}, found another skeleton or mesh")
    if abs(poses.fps - first.poses.fps) > 1e-3 * first.poses.fps:
        raise InputError(f"expected {first.poses.fps:g} frames a second as in {where}, found {poses.fps:g}")
    if len(poses.shape) != len(first.poses.shape):
        raise InputError(f"expected {len(first.poses.shape)} shape coefficients, found {len(poses.shape)}")
    wanted = first.garment.template
    if not np.array_equal(template.faces, wanted.faces):
        raise InputError(
            f"expected the template of {where} ({len(wanted.vertices)} vertices, {len(wanted.faces)} faces), "
            f"found one of {len(template.vertices)} and {len(template.faces)}"
        )
    ours, theirs = first.garment.skin_weights, take.garment.skin_weights
    if ours is not None and theirs is not None and not np.allclose(ours, theirs, atol=SAME_WEIGHTS):
        raise InputError(
            f"expected the skin weights of {where}, found others; one template serves all takes, bound once"
        )


def unpose_takes(
    takes: Sequence[RegisteredTake],
    folder: Path,
    person: Float32[np.ndarray, " shapes"],
    *,
    unseen_weight: float,
    workers: int,
) -> None:
    """Write the takes' frames in the rest pose of the person whom all takes share, where that is still to be done.

    Args:
        folder: gets takes/ and unposed/.
        person: shape coefficients.
        unseen_weight: of vertices without scan data.
    Raises:
        InputError: a registration is damaged.
    """
    missing = [
        take
        for take in takes
        if not ((folder / "takes" / f"{take.name}.json").is_file() and _weights_path(folder, take).is_file())
    ]
    unpose = partial(_unpose_take, folder, unseen_weight, person)
    for _ in run_jobs(unpose, missing, workers=workers, label="unpose"):
        pass


def _vertices_path(folder: Path, take: RegisteredTake) -> Path:
    return folder / "unposed" / f"{take.name}.vertices.npy"


def _weights_path(folder: Path, take: RegisteredTake) -> Path:
    return folder / "unposed" / f"{take.name}.weights.npy"


def _unpose_take(folder: Path, unseen_weight: float, person: np.ndarray, take: RegisteredTake) -> None:
    registered = load_registration(take.work.path / "registration")
    rows = PoseRows.match(registered, with_shape(take.body, take.poses.shape), take.poses)
    weights = []

    def frames() -> Iterator[np.ndarray]:
        for rest, weight in unpose_sequence(registered, rows, person, unseen_weight=unseen_weight):
            weights.append(weight)
            yield rest

    write_npy_rows(_vertices_path(folder, take), frames(), count=len(registered.frame_ids))
    write_npy(_weights_path(folder, take), np.stack(weights))
    verdicts = _verdicts(take.work, registered.frame_ids.tolist())
    write_json(folder / "takes" / f"{take.name}.json", {"frames": registered.frame_ids, "verdicts": verdicts})


def _verdicts(work: WorkFolder, frame_ids: Sequence[int]) -> list[str]:
    found = {record.get("frame_id"): str(record.get("verdict") or "none") for record in work.records}
    verdicts = [found.get(frame_id, "none") for frame_id in frame_ids]
    for frame_id, verdict in zip(frame_ids, verdicts, strict=True):
        if verdict not in VERDICTS:
            reason = f"frame {frame_id}: expected a verdict, found {verdict}"
            raise InputError(reason, where=work.path / "registration" / "metrics.jsonl")
    return verdicts


def stack_takes(takes: Sequence[RegisteredTake], folder: Path) -> UnposedTakes:
    """All frames that `unpose_takes` wrote, in one array on disk.

    Raises:
        InputError: there are not two good frames.
    """
    parts = [map_array(_vertices_path(folder, take)) for take in takes]
    path = folder / "unposed" / "all.npy"
    if not path.is_file():
        write_npy_rows(path, (row for part in parts for row in part), count=sum(map(len, parts)))
    unposed = [_unposed(take, read_json(folder / "takes" / f"{take.name}.json")) for take in takes]
    good = int(sum(take.good.sum() for take in unposed))
    if good < 2:
        frames = sum(len(take.good) for take in unposed)
        raise InputError(f"takes: expected at least 2 good frames to learn from, found {good} of {frames}")
    weights = np.concatenate([map_array(_weights_path(folder, take)) for take in takes])
    skin_weights = takes[0].garment.skin_weights
    assert skin_weights is not None
    return UnposedTakes(unposed, map_array(path), weights, skin_weights)


def _unposed(take: RegisteredTake, record: dict[str, list]) -> Take:
    """
    Args:
        record: the registered frames and their verdicts.
    """
    shaped, frame_ids = with_shape(take.body, take.poses.shape), np.array(record["frames"], np.int32)
    rows = PoseRows.of_frames(frame_ids, take.garment, shaped, take.poses)
    transforms = np.stack([rows.transforms(row) for row in range(len(frame_ids))])
    # a frame to be checked is whole: what its scan does not show weighs little, and crumpled cloth is cloth
    usable = np.array([each != "failed" for each in record["verdicts"]])
    return Take(take.name, rows.poses, usable, transforms)
