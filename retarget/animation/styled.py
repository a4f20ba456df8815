"""A garment with styles on a motion: what `retarget.animation.stage` does with a model that `fit-styles` wrote.

The output is that of any animation. The garment of a pose depends on nothing that went before it, so that a motion
keeps its own frame rate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np

from capture4d.captures.animations.frame_files import (
    FRAMES_AT_ONCE,
    AnimatedFrame,
    FrameFiles,
    collect,
    motion_files,
    open_frames,
    write_frame,
)
from capture4d.errors import InputError
from capture4d.files.atomic import file_digest
from capture4d.files.records import save_body, save_garment, save_poses
from capture4d.geometry.mesh import edge_lengths, edge_stretch, stretch_p99, unique_edges
from capture4d.motions.motion_files import motion_on
from capture4d.runs.stage import StageResult
from capture4d.runs.workers import run_jobs
from retarget.config import AnimateConfig
from retarget.mixture.model_files import MODEL_FILES, load_styled_garment
from retarget.mixture.styled_garment import WornGarment

__all__ = ["run"]


def run(
    model: Path,
    poses: Path,
    output: Path,
    config: AnimateConfig,
    *,
    beta: Sequence[float],
    style: Mapping[str, float] | Sequence[float],
    workers: int,
    overwrite: bool,
) -> StageResult:
    """Animate a garment with styles.

    Args:
        beta, style: of `StyledGarment.worn`.
    Raises:
        InputError: a file is damaged, the poses are of another skeleton, or style or shape are outside what was
            learned.
    """
    for name, usual in (("regressor", "auto"), ("mean", "corrected")):
        if getattr(config, name) != usual:
            raise InputError(f"--{name}: expected none, for a garment with styles has none to choose")
    known = load_styled_garment(model)
    style = style if isinstance(style, Mapping) else known.ranges.named(style)
    worn = known.worn(beta, style, config)
    motion = motion_on(poses, known.body, worn.person.shape, config.fps)
    files = [model / name for name in MODEL_FILES]
    settings = {**asdict(config), "beta": [*map(float, beta)], "style": dict(style)}
    upstream = {"model": file_digest(files, root=model), "poses": file_digest([poses], root=poses.parent)}
    stage = open_frames(output, settings, upstream, {"model": model, "poses": poses}, overwrite=overwrite)
    body_path, poses_path = motion_files(output)
    save_body(body_path, known.body)
    save_poses(poses_path, motion)
    template = known.garment.template.with_vertices(worn.in_a_pose.astype(np.float32))
    save_garment(stage.path / "garment.npz", replace(known.garment, template=template, body_shape=motion.shape))
    frame_ids = [int(frame_id) for frame_id in motion.frame_ids]
    pending = set(stage.pending(frame_ids))
    rows = [row for row, frame_id in enumerate(frame_ids) if frame_id in pending]
    chunks = [tuple(rows[start : start + FRAMES_AT_ONCE]) for start in range(0, len(rows), FRAMES_AT_ONCE)]
    unlike = max(config.unlike_deg, known.learned.validated_deg)
    shared = FrameFiles(stage, motion, known.learned.distances(motion), unlike)
    prepare = partial(_worn, model, beta, style, config)
    for _ in run_jobs(
        partial(_write_frames, shared), chunks, prepare=prepare, workers=workers, label="animate", units=len
    ):
        pass
    return collect(stage, frame_ids)


def _worn(model: Path, beta: Sequence[float], style: Mapping[str, float], config: AnimateConfig) -> WornGarment:
    """The garment on the person, for a process."""
    return load_styled_garment(model).worn(beta, style, config)


def _write_frames(shared: FrameFiles, worn: WornGarment, rows: Sequence[int]) -> None:
    edges, at_rest = unique_edges(worn.faces), worn.in_a_pose
    lengths = edge_lengths(at_rest, edges)
    for row in rows:
        removed = worn.outside(shared.poses.rotations[row], shared.poses.translations[row])
        stretch = stretch_p99(edge_stretch(removed.vertices, edges, lengths))
        write_frame(shared, row, AnimatedFrame(removed.vertices.astype(np.float32), removed, stretch))
