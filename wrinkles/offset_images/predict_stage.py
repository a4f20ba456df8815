"""The stage that puts a garment learned from drapes on a motion: MODEL and poses in, OUTPUT out.

stage.json
garment.npz body.npz poses.npz   what moves, and how
vertices.npy                     (frames, vertices, 3), metres

Nothing is known of time: every frame is the drape of its pose.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from capture4d.files.atomic import file_digest, write_npy
from capture4d.files.outputs import require_apart
from capture4d.files.records import save_body, save_garment, save_poses
from capture4d.motions.motion_files import read_motion, told
from capture4d.runs.stage import StageResult, complete_record, open_stage
from wrinkles.offset_images.drape_model import load_drape_offsets
from wrinkles.offset_images.train_stage import STAGE as TRAINED

__all__ = ["run"]

STAGE, SCHEMA = "offsets predict", 1
FILES = ("garment.npz", "body.npz", "poses.npz", "vertices.npy")


def run(model: Path, poses: Path, output: Path, *, workers: int = 1, overwrite: bool = False) -> StageResult:
    """Predict a garment in every frame of a motion, on the person it was draped on.

    Args:
        model: what `offsets train` wrote.
        poses: a motion file.
    Raises:
        InputError: a file is missing or damaged, or the motion does not fit the body.
    """
    require_apart([output / name for name in FILES], [poses])
    record = complete_record(model, TRAINED, f"capture4d offsets train DRAPES --output {model}")
    known = load_drape_offsets(model)
    motion = read_motion(poses, known.parts.body, say=told(poses))
    motion = replace(motion, shape=known.parts.shape)
    upstream = {"model": record["digest"], "poses": file_digest([poses], root=poses.parent)}
    stage = open_stage(
        output, name=STAGE, schema=SCHEMA, config={}, upstream=upstream, sources={"model": model, "poses": poses},
        overwrite=overwrite,
    )  # fmt: skip
    paths, count = [output / name for name in FILES], len(motion.frame_ids)
    if stage.was_complete and all(path.is_file() for path in paths):
        return stage.finish(paths, changed=False, frames=count)
    torch.set_num_threads(workers)
    write_npy(output / "vertices.npy", known.vertices(motion).astype(np.float32))
    save_garment(output / "garment.npz", known.parts.garment)
    save_body(output / "body.npz", known.parts.body)
    save_poses(output / "poses.npz", motion)
    return stage.finish(paths, frames=count)
