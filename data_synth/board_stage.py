"""Photographs of a waved board by any rig, as files: what `capture4d calibrate` starts from, without a lab."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64

from capture4d.atomic_files import file_digest, write_bytes
from capture4d.calibration_board import parse_board
from capture4d.errors import InputError
from capture4d.records import load_rig
from capture4d.types import Rig
from capture4d.workdir import Stage, open_stage
from capture4d.workers import run_jobs
from data_synth.board_images import photograph_board
from data_synth.board_views import visible_corners, wave_board
from data_synth.config import BoardConfig

__all__ = ["run", "shared_volume"]

SCHEMA = 1


@dataclass(frozen=True, slots=True)
class _Job:
    stage: Stage
    rig: Path
    config: BoardConfig
    pose: int


def run(rig_path: Path, images: Path, config: BoardConfig, *, workers: int = 1, overwrite: bool = False) -> str:
    """Photograph a board in the middle of a rig, as `images`/CAMERA/POSE.png; the digest of the images.

    A camera gets no image of a pose that it does not see.

    Raises:
        InputError: the board or the rig cannot be read, or the folder holds something else.
    """
    parse_board(config.board)
    rig = load_rig(rig_path)
    if config.poses < 1:
        raise InputError(f"--poses: expected at least 1, found {config.poses}")
    upstream = {"rig": file_digest([rig_path], root=rig_path.parent)}
    stage = open_stage(images, name="synth-board", schema=SCHEMA, config=config, upstream=upstream, overwrite=overwrite)
    wanted = [
        _image(images, rig.names[camera], pose) for pose in range(config.poses) for camera in _seeing(rig, config, pose)
    ]
    if stage.was_complete and all(path.is_file() for path in wanted):
        return stage.finish(wanted, changed=False)
    jobs = [_Job(stage, rig_path, config, pose) for pose in range(config.poses)]
    for _ in run_jobs(_photograph, jobs, workers=workers, label="Photographing"):
        pass
    return stage.finish(wanted)


def shared_volume(rig: Rig) -> tuple[Float64[np.ndarray, " 3"], float]:
    """The point nearest to all optical axes, metres, and the radius of the sphere about it that every camera sees."""
    forward = rig.T_camera_world[:, 2, :3]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    centre = np.linalg.lstsq(across.sum(axis=0), np.einsum("cij,cj->i", across, rig.centres), rcond=None)[0]
    focal = rig.intrinsics[:, [0, 1], [0, 1]]
    sine = np.sin(np.arctan(rig.image_sizes / (2 * focal))).min(axis=1)
    return centre, float((np.linalg.norm(rig.centres - centre, axis=1) * sine).min())


def _poses(rig: Rig, config: BoardConfig) -> np.ndarray:
    centre, radius = shared_volume(rig)
    side = 2 * radius / np.sqrt(3)
    board = parse_board(config.board)
    return wave_board(
        board, config.poses, rng=np.random.default_rng([config.seed, 0]), centre=centre, volume_m=(side, side, side)
    )


def _seeing(rig: Rig, config: BoardConfig, pose: int) -> list[int]:
    board, T_world_board = parse_board(config.board), _poses(rig, config)[pose]
    return [camera for camera in range(len(rig.names)) if len(visible_corners(rig, camera, board, T_world_board)[0])]


def _image(images: Path, camera: str, pose: int) -> Path:
    return images / camera / f"{pose + 1:03d}.png"


def _photograph(job: _Job) -> None:
    rig, board = load_rig(job.rig), parse_board(job.config.board)
    for camera in _seeing(rig, job.config, job.pose):
        path = _image(job.stage.path, rig.names[camera], job.pose)
        if path.is_file():
            continue
        rng = np.random.default_rng([job.config.seed, 1, job.pose, camera])
        image = photograph_board(rig, camera, board, _poses(rig, job.config)[job.pose], rng=rng)
        encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        write_bytes(path, encoded.tobytes())
