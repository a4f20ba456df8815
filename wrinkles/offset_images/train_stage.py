"""The stage that learns a garment's offsets from static drapes: a set of `synth-drapes` in, MODEL out.

stage.json            what was run
garment.npz body.npz model.safetensors networks/   the model, `wrinkles.offset_images.drape_model`
errors.json           how far off it is on drapes that were learned from, that chose the epoch, and on the others
metrics.jsonl         loss and validation error of every epoch of every network
checkpoints/          everything a resume needs; the last one of each network is kept

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 5 and 6.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32
from torch import Tensor, nn

from capture4d.captures.animations.known_poses import PoseRange, nearest_poses, pose_quaternions
from capture4d.captures.drapes.drape_parts import DrapeParts
from capture4d.captures.drapes.drape_sets import DrapeSet
from capture4d.errors import InputError
from capture4d.files.arrays import map_array
from capture4d.files.atomic import file_digest, nan_to_none, write_json
from capture4d.files.tensors import read_tensors
from capture4d.runs.stage import Stage, StageResult, complete_record, open_stage
from wrinkles.offset_images.canvas import OffsetSampler, Window, drawn_values
from wrinkles.offset_images.config import DrapeOffsetsConfig
from wrinkles.offset_images.drape_lessons import DrapeLesson, drape_lesson, read_parted_drapes
from wrinkles.offset_images.drape_model import (
    NETWORK_KIND,
    DrapeOffsets,
    ModelParts,
    load_drape_offsets,
    made_decoder,
    network_path,
    save_model_parts,
    save_network,
    windows_of,
)
from wrinkles.offset_images.frames import OffsetFrames, vertex_errors_cm
from wrinkles.offset_images.kernels import fit_kernels
from wrinkles.offset_images.layout import OffsetLayout
from wrinkles.offset_images.losses import edge_length_loss, normal_loss
from wrinkles.offset_images.networks import FullyConnected, PcaFullyConnected
from wrinkles.offset_images.patches import OffsetFilter, even_labels, kink_deg
from wrinkles.offset_images.resumable import METRICS, TrainingLog, train_resumably
from wrinkles.offset_images.training import OffsetLesson, start_training

__all__ = ["ERRORS", "run"]

STAGE, SCHEMA = "offsets train", 3
ERRORS = "errors.json"
COMMAND = "capture4d offsets train DRAPES --output MODEL"
DRAPES = "synth-drapes"


def run(
    drapes: Path,
    output: Path,
    config: DrapeOffsetsConfig,
    *,
    labels: Path | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Learn a garment from a set of drapes, unless that has been done.

    Equal inputs, settings and numbers of `workers`, which are torch's threads here, give equal weights, however often
    the run was interrupted.

    Args:
        drapes: what `synth-drapes` wrote.
        labels: a .npy with a whole number for each face of the garment: which patch it belongs to.
    Raises:
        InputError: the set is unfinished, damaged or too small; or labels or garment do not fit the settings.
    """
    record = complete_record(drapes, DRAPES, f"capture4d synth-drapes {drapes}")
    found, parts = read_parted_drapes(drapes)
    given = _given_labels(labels, len(found.garment.template.faces))
    if given is not None and config.network != "patches":
        raise InputError(f"labels: expected none but for the network 'patches', found some for '{config.network}'")
    layout = OffsetLayout.create(found.garment, config.texels)
    if config.network == "patches" and given is None:
        given = even_labels(layout, config.patch.count)
    windows = windows_of(layout, config, given)
    upstream = {"drapes": record["digest"]}
    if labels is not None:
        upstream["labels"] = file_digest([labels], root=labels.parent)
    stage = open_stage(
        output, name=STAGE, schema=SCHEMA, config=config, upstream=upstream, sources={"drapes": drapes},
        overwrite=overwrite,
    )  # fmt: skip
    networks = [network_path(output, index) for index in range(len(windows))]
    products = [output / name for name in ("garment.npz", "body.npz", "model.safetensors", ERRORS, METRICS)] + networks
    if stage.was_complete and all(path.is_file() for path in products):
        return stage.finish(products, changed=False)
    torch.set_num_threads(workers)
    lesson = drape_lesson(found, parts, texels=config.texels, space=config.space, mirrored=config.mirrored)
    base = _learn_parts(stage, found, parts, lesson, config, given)
    _learn_networks(stage, lesson, config, windows, base)
    model = load_drape_offsets(output)
    write_json(output / ERRORS, _errors(model, lesson, len(parts.train)))
    return stage.finish(products)


def _given_labels(path: Path | None, count: int) -> Int32[np.ndarray, " F"] | None:
    if path is None:
        return None
    labels = np.array(map_array(path, expected="an array of labels", absent="no such labels"))
    if labels.shape != (count,) or labels.dtype.kind not in "iu" or np.abs(labels.astype(float)).max() >= 2**31:
        raise InputError(f"expected a whole number for each of {count} faces, found {labels.dtype} {labels.shape}",
                         where=path)  # fmt: skip
    return labels.astype(np.int32)


def _learn_parts(
    stage: Stage,
    drapes: DrapeSet,
    parts: DrapeParts,
    lesson: DrapeLesson,
    config: DrapeOffsetsConfig,
    labels: Int32[np.ndarray, " F"] | None,
) -> tuple[Tensor, Tensor] | None:
    """Learn kernels and filter, and write all but the networks; the first guesses of the drapes that are learned from
    and of those that choose the epoch, where the networks are to add to them."""
    kernels, guessed = None, None
    if config.network == "kernels" or config.residual or config.partner:
        kernels, guessed = fit_kernels(lesson.train)
    patched = config.network == "patches"
    kept = OffsetFilter.learned(lesson.train.offsets, config.filter_components) if patched else None
    names = tuple(drapes.body.joint_names[joint] for joint in parts.joints)
    save_model_parts(
        stage.path,
        ModelParts(
            config, drapes.garment, drapes.body, drapes.shape, names, labels, kernels, kept, _known_poses(parts, lesson)
        ),
    )
    if not config.residual or kernels is None or guessed is None:
        return None
    return guessed, kernels.offsets(lesson.validation.pose)


def _known_poses(parts: DrapeParts, lesson: DrapeLesson) -> PoseRange:
    """The poses that are learned, and how far those that choose the epoch are from them."""

    def quaternions(pose: Tensor) -> Float32[np.ndarray, "frames joints 4"]:
        rotations = pose.numpy().reshape(len(pose), -1, 3, 3)
        return pose_quaternions(rotations, tuple(range(rotations.shape[1])))

    learned = quaternions(lesson.train.pose)
    distances, _ = nearest_poses(quaternions(lesson.validation.pose), learned)
    return PoseRange(learned, tuple(parts.joints.tolist()), float(np.percentile(distances, 95)))


def _learn_networks(
    stage: Stage,
    lesson: DrapeLesson,
    config: DrapeOffsetsConfig,
    windows: tuple[Window | None, ...],
    base: tuple[Tensor, Tensor] | None,
) -> None:
    """Train what is not trained yet, one network after the other; each is made from a seed of its own."""
    train, validation = lesson.train, lesson.validation
    if base is not None:
        train, validation = train.over(base[0]), validation.over(base[1])
    before: list[Mapping[str, Any]] = []
    values: Tensor | None = None
    for index, window in enumerate(windows):
        path = network_path(stage.path, index)
        if not path.is_file():
            if values is None and config.network not in ("direct", "pca"):
                values = torch.from_numpy(drawn_values(lesson.layout, train.offsets.numpy()))
            settings = replace(config.training, seed=(config.training.seed + index) % 2**63)
            torch.manual_seed(settings.seed)
            network = _made_network(config, train, window)
            task = OffsetLesson(lesson.layout, train, validation, window, values)
            name = config.network if window is None else f"{config.network}-{index + 1:02d}"
            training = start_training(network, task, settings)
            history = train_resumably(TrainingLog(stage.path, COMMAND, before), name, training, settings)
            save_network(path, network, history)
        before += read_tensors(path, NETWORK_KIND).entry("history")
    TrainingLog(stage.path, COMMAND, before).write([])


def _made_network(config: DrapeOffsetsConfig, train: OffsetFrames, window: Window | None) -> nn.Module:
    pose_size, pixels = train.pose.shape[1], train.offsets.shape[1]
    match config.network:
        case "direct":
            return FullyConnected(pose_size, pixels)
        case "pca":
            return PcaFullyConnected.analysed(pose_size, train.offsets, components=config.components)
        case _:
            return made_decoder(config, pose_size, window)


def _errors(model: DrapeOffsets, lesson: DrapeLesson, drapes: int) -> dict[str, Any]:
    """Errors of each part: of vertices and edges in cm, of normals as 1 - cos; and of the mean of all drapes.

    Args:
        drapes: how many were learned from, without their mirror images.
    """
    sampler = OffsetSampler(lesson.layout)
    mean = lesson.train.offsets.mean(dim=0)
    learned = lesson.train.rows(range(drapes))
    found: dict[str, Any] = {}
    for name, frames in (("train", learned), ("validation", lesson.validation), ("test", lesson.test)):
        made = sampler.positions(model.offsets(frames.pose), frames.points, frames.axes)
        usual = sampler.positions(mean.expand(len(frames), -1, -1), frames.points, frames.axes)
        found[name] = nan_to_none(
            {
                "drapes": len(frames),
                "vertex_cm": vertex_errors_cm(made, frames.vertices),
                "normal": float(normal_loss(made, frames.vertices, sampler.faces)),
                "edge_cm": float(edge_length_loss(made, frames.vertices, sampler.edges)),
                "mean_vertex_cm": vertex_errors_cm(usual, frames.vertices),
                "largest_offset_cm": float(frames.offsets.norm(dim=-1).max()),
            }
        )
    if model.parts.labels is not None:
        found["kinks"] = _kinks(model, lesson.test, sampler, model.parts.labels)
    return found


def _kinks(
    model: DrapeOffsets, frames: OffsetFrames, sampler: OffsetSampler, labels: Int32[np.ndarray, " F"]
) -> dict[str, float | None]:
    """Mean angles along the borders of the patches, degrees: true, stitched and filtered; and errors of vertices in
    centimetres before the filter."""
    faces = model.parts.garment.template.faces
    raw = sampler.positions(model.stitched_offsets(frames.pose), frames.points, frames.axes)
    filtered = sampler.positions(model.offsets(frames.pose), frames.points, frames.axes)

    def bent(vertices: Float[Tensor, "frames V 3"]) -> float:
        return kink_deg(vertices.numpy(), faces, labels)

    angles = {"true_deg": bent(frames.vertices), "stitched_deg": bent(raw), "filtered_deg": bent(filtered)}
    return nan_to_none({**angles, "stitched_vertex_cm": vertex_errors_cm(raw, frames.vertices)})
