"""The stage that learns offset images: a registered WORK in, WORK/wrinkles/offsets out.

stage.json                       what was run
decoder.safetensors              from poses to images of offsets
patches.safetensors              the same in patches, if they were asked for, and what stitches them
fully_connected.safetensors      a baseline without images: from poses to all offsets
fully_connected_pca.safetensors  another: from poses to principal components of the offsets
frames.json                      frames that were learned from, that chose the epoch, and that were held out
metrics.jsonl                    loss and validation error of every epoch
checkpoints/decoder-000010.safetensors   everything a resume needs; the last one of each network is kept

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 5 and 6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int

from capture4d.captures.work_folder import WorkFolder
from capture4d.errors import InputError
from capture4d.files.atomic import write_json
from capture4d.runs.stage import Stage, StageResult, open_stage
from wrinkles.frame_split import split_rows
from wrinkles.offset_images.canvas import OffsetSampler, drawn_values
from wrinkles.offset_images.config import OffsetConfig
from wrinkles.offset_images.frames import offset_frames, pose_joints
from wrinkles.offset_images.layout import OffsetLayout
from wrinkles.offset_images.model_files import (
    DECODER,
    DIRECT,
    FRAMES,
    NETWORKS,
    PATCHES,
    STAGE,
    OffsetModel,
    load_offset_model,
    save_offset_model,
    small_patch_decoder,
)
from wrinkles.offset_images.networks import FullyConnected, PcaFullyConnected, image_decoder
from wrinkles.offset_images.patches import OffsetFilter, Patchwork, cut_windows, even_labels
from wrinkles.offset_images.resumable import METRICS, TrainingLog, train_resumably
from wrinkles.offset_images.training import OffsetLesson, start_training

__all__ = ["run"]

SCHEMA = 3
COMMAND = "capture4d wrinkles offsets WORK"
BATCHES, SMALLEST_BATCH = 8, 4
"""A short take is learned from in as many batches, unless they become too small for batch norm."""
VALIDATION = 9
"""The last ninth of the frames chooses the epoch, as the paper regularises on a ninth."""


@dataclass(frozen=True, slots=True)
class _Parts:
    """Positions in the registered sequence."""

    learned: Sequence[int]
    chose_epoch: Sequence[int]
    held_out: Sequence[int]


def run(
    work: WorkFolder, output: Path, config: OffsetConfig, *, workers: int = 1, overwrite: bool = False
) -> StageResult:
    """Learn decoder and baselines, and patches if they are asked for, unless that has been done.

    Equal inputs, settings and numbers of `workers`, which are torch's threads here, give equal weights, however often
    the run was interrupted.

    Args:
        work: work folder of a registered take whose template is bound to a body.
        output: folder to write; WORK/wrinkles/offsets is where `compare` looks.
    Raises:
        InputError: there is no registration, no body that moved the template, or not frames enough; or a checkpoint is
            damaged.
    """
    digest, sequence = work.registered_digest, work.registered
    garment = sequence.garment
    layout = OffsetLayout.create(garment, config.texels)
    body, poses = work.require_posed_body()
    poses = poses.of_frames(sequence.frame_ids)
    weights = garment.skin_weights
    if weights is None or weights.shape[1] != len(body.joint_names) or poses.joint_names != body.joint_names:
        raise InputError("expected a template that is bound to the body that moved it, found another", where=work.path)
    parts = _split(work, sequence.frame_ids, config)
    stage = open_stage(
        output, name=STAGE, schema=SCHEMA, config=config, upstream={"registration": digest}, overwrite=overwrite
    )
    names = [name for name in NETWORKS if name != PATCHES or config.patched]
    products = [stage.path / FRAMES, *(_model(stage, name) for name in names)]
    if stage.was_complete and all(path.is_file() for path in [*products, stage.path / METRICS]):
        return stage.finish(products, changed=False)
    torch.set_num_threads(workers)
    joints = pose_joints(poses, weights)

    def encoded(rows: Sequence[int]):
        frames = poses.of_frames(sequence.frame_ids[list(rows)])
        return offset_frames(layout, body, frames, np.array(sequence.vertices[list(rows)]), joints)

    lesson = OffsetLesson(layout, encoded(parts.learned), encoded(parts.chose_epoch))
    frames = {name: sequence.frame_ids[list(getattr(parts, name))] for name in _Parts.__dataclass_fields__}
    write_json(stage.path / FRAMES, frames)
    _learn(stage, names, lesson, joints, config)
    return stage.finish(products)


def _split(work: WorkFolder, frame_ids: Int[np.ndarray, " frames"], config: OffsetConfig) -> _Parts:
    """The end of the take is held out; of the rest, frames that failed are left out, and the last choose the epoch."""
    start, end = split_rows(len(frame_ids), held_out=config.held_out, gap=config.held_out_gap, name=str(work.path))
    sound = [row for row in start if int(frame_ids[row]) not in work.failed_frames]
    if len(sound) < 2:
        raise InputError(
            f"expected at least 2 soundly registered frames to learn from, found {len(sound)}", where=work.path
        )
    cut = len(sound) - max(len(sound) // VALIDATION, 1)
    return _Parts(sound[:cut], sound[cut:], end)


def _learn(
    stage: Stage,
    names: Sequence[str],
    lesson: OffsetLesson,
    joints: Int[np.ndarray, " joints"],
    config: OffsetConfig,
) -> None:
    """Train what is not trained yet, one network after the other; each is made from the seed anew."""
    batch = min(config.training.batch, max(SMALLEST_BATCH, len(lesson.train) // BATCHES))
    settings = replace(config.training, batch=batch)
    before: list[Mapping[str, Any]] = []
    for name in names:
        path = _model(stage, name)
        if not path.is_file():
            log = TrainingLog(stage.path, COMMAND, before)
            save_offset_model(path, _learned(name, lesson, joints, replace(config, training=settings), log))
        before += load_offset_model(path, lesson.layout.garment).history
        TrainingLog(stage.path, COMMAND, before).write([])


def _learned(
    name: str, lesson: OffsetLesson, joints: Int[np.ndarray, " joints"], config: OffsetConfig, log: TrainingLog
) -> OffsetModel:
    layout, train, settings = lesson.layout, lesson.train, config.training
    pose_size = train.pose.shape[1]
    if name == PATCHES:
        return _learned_patches(lesson, joints, config, log)
    torch.manual_seed(settings.seed)
    if name == DECODER:
        network = image_decoder(pose_size, config.texels)
    elif name == DIRECT:
        network = FullyConnected(pose_size, len(layout.vertex))
    else:
        network = PcaFullyConnected.analysed(pose_size, train.offsets, components=config.components)
    history = train_resumably(log, name, start_training(network, lesson, settings), settings)
    return OffsetModel(network, joints, layout, history)


def _learned_patches(
    lesson: OffsetLesson, joints: Int[np.ndarray, " joints"], config: OffsetConfig, log: TrainingLog
) -> OffsetModel:
    layout, patch = lesson.layout, config.patch
    labels = even_labels(layout, patch.count)
    windows = cut_windows(layout, labels, patch.texels, patch.context)
    values = torch.from_numpy(drawn_values(layout, lesson.train.offsets.numpy()))
    decoders, history = [], []
    for index, window in enumerate(windows):
        settings = replace(config.training, seed=(config.training.seed + index) % 2**63)
        torch.manual_seed(settings.seed)
        decoder = small_patch_decoder(lesson.train.pose.shape[1], patch)
        task = replace(lesson, window=window, values=values)
        name = f"{PATCHES}-{index + 1:02d}"
        so_far = replace(log, before=[*log.before, *history])
        history += train_resumably(so_far, name, start_training(decoder, task, settings), settings)
        decoders.append(decoder)
    samplers = [OffsetSampler(layout, window) for window in windows]
    kept = OffsetFilter.learned(lesson.train.offsets, len(lesson.train))
    return OffsetModel(Patchwork(layout, samplers, decoders, kept), joints, layout, history, labels, patch)


def _model(stage: Stage, name: str) -> Path:
    return stage.path / f"{name}.safetensors"
