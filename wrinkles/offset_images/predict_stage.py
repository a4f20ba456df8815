"""The stage that puts a garment learned from drapes on a motion: MODEL and poses in, an animated garment out.

WORK/body and WORK/registration are those of any animation (`capture4d.captures.animations.frame_files`): out of the
body, and graded. Nothing is known of time: every frame is the drape of its pose, so that a motion keeps its own rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, Int32

from capture4d.body.limbs import WornBody
from capture4d.body.skinning import ShapedBody, pose_frame, with_shape
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
from capture4d.files.outputs import require_apart
from capture4d.files.records import save_body, save_garment, save_poses
from capture4d.geometry.intersection_removal import IntersectionRemoval
from capture4d.geometry.mesh import edge_stretch, flat_edge_lengths, stretch_p99, unique_edges
from capture4d.geometry.uv_layout import require_uvs
from capture4d.motions.motion_files import motion_on
from capture4d.runs.stage import StageResult, complete_record
from capture4d.runs.workers import run_jobs
from wrinkles.offset_images.config import PredictOffsetsConfig
from wrinkles.offset_images.drape_model import DrapeOffsets, load_drape_offsets
from wrinkles.offset_images.train_stage import STAGE as TRAINED

__all__ = ["run"]


def run(
    model: Path,
    poses: Path,
    output: Path,
    config: PredictOffsetsConfig,
    *,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Put a garment on a motion of the person it was draped on; `failed` are the frames whose cloth is torn.

    Args:
        model: what `offsets train` wrote.
        poses: a motion file.
        output: work folder; gets body/ and registration/.
    Raises:
        InputError: a file is missing or damaged, or would be written over, or the motion does not fit the body.
    """
    require_apart(motion_files(output), [poses])
    if (output / "body" / "stage.json").is_file():
        raise InputError("expected a folder for the animation alone, found a take with a tracked body", where=output)
    record = complete_record(model, TRAINED, f"capture4d offsets train DRAPES --output {model}")
    known = load_drape_offsets(model)
    garment, body, shape = known.parts.garment, known.parts.body, known.parts.shape
    motion = motion_on(poses, known.parts.body, known.parts.shape, config.fps)
    upstream = {"model": record["digest"], "poses": file_digest([poses], root=poses.parent)}
    stage = open_frames(output, asdict(config), upstream, {"model": model, "poses": poses}, overwrite=overwrite)
    body_path, poses_path = motion_files(output)
    save_body(body_path, body)
    save_poses(poses_path, motion)
    save_garment(stage.path / "garment.npz", replace(garment, body_shape=np.asarray(shape, np.float32)))
    frame_ids = [int(frame_id) for frame_id in motion.frame_ids]
    pending = set(stage.pending(frame_ids))
    rows = [row for row, frame_id in enumerate(frame_ids) if frame_id in pending]
    chunks = [tuple(rows[start : start + FRAMES_AT_ONCE]) for start in range(0, len(rows), FRAMES_AT_ONCE)]
    learned = known.parts.learned
    shared = FrameFiles(stage, motion, learned.distances(motion), max(config.unlike_deg, learned.validated_deg))
    prepare = partial(_Dressed.read, model, config)
    for _ in run_jobs(
        partial(_write_frames, shared), chunks, prepare=prepare, workers=workers, label="predict", units=len
    ):
        pass
    return collect(stage, frame_ids)


@dataclass(frozen=True, slots=True, eq=False)
class _Dressed:
    """The garment on its person, with what frames share."""

    model: DrapeOffsets
    person: ShapedBody
    edges: Int32[np.ndarray, "E 2"]
    lengths: Float64[np.ndarray, " E"]
    """On the pattern, metres: the garment as it was put on is crushed under the arms where they have been lowered."""
    removal: IntersectionRemoval
    worn: WornBody

    @staticmethod
    def read(model: Path, config: PredictOffsetsConfig) -> _Dressed:
        """For a process; on one thread, so that any number of processes gives the same vertices."""
        torch.set_num_threads(1)
        known = load_drape_offsets(model)
        garment, person = known.parts.garment, with_shape(known.parts.body, known.parts.shape)
        at_rest = garment.template.vertices.astype(np.float64)
        edges = unique_edges(garment.template.faces)
        # the pattern, in metres, is what UVs of drapes are
        lengths = flat_edge_lengths(require_uvs(garment.template), garment.template.faces, edges)
        longest = config.longest or float("inf")
        removal = IntersectionRemoval(garment.template.faces, len(at_rest), lengths, longest, config.removal)
        assert garment.skin_weights is not None
        return _Dressed(known, person, edges, lengths, removal, WornBody(person, at_rest, garment.skin_weights))


def _write_frames(shared: FrameFiles, dressed: _Dressed, rows: Sequence[int]) -> None:
    placed = dressed.model.vertices(shared.poses.of_frames(shared.poses.frame_ids[list(rows)]))
    for row, vertices in zip(rows, placed, strict=True):
        body = pose_frame(dressed.person, shared.poses, row)
        removed = dressed.removal(vertices, dressed.worn.posed(body.vertices()))
        stretch = stretch_p99(edge_stretch(removed.vertices, dressed.edges, dressed.lengths))
        write_frame(shared, row, AnimatedFrame(removed.vertices.astype(np.float32), removed, stretch))
