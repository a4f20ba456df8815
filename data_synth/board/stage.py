"""Photographs of a waved board by any rig, as files: what `capture4d calibrate` starts from, without a lab."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from capture4d.cameras.board import Board, parse_board
from capture4d.captures.names import require_plain_names
from capture4d.errors import InputError
from capture4d.files.atomic import file_digest, write_bytes
from capture4d.files.records import load_rig
from capture4d.runs.stage import StageResult, open_stage
from capture4d.runs.workers import run_jobs
from capture4d.types import Rig
from data_synth.board.images import photograph_board
from data_synth.board.views import visible_corners, wave_board
from data_synth.config import BoardConfig

__all__ = ["run", "shared_volume"]

SCHEMA = 1


CANDIDATES = 3
"""Poses drawn for each that is taken."""


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """One pose, and the cameras that see it."""

    images: Path
    rig: Rig
    config: BoardConfig
    pose: int
    T_world_board: np.ndarray
    cameras: tuple[int, ...]

    def path(self, camera: int) -> Path:
        return self.images / self.rig.names[camera] / f"{self.pose + 1:03d}.png"


def run(rig_path: Path, images: Path, config: BoardConfig, *, workers: int = 1, overwrite: bool = False) -> StageResult:
    """Photograph a board in the middle of a rig, as `images`/CAMERA/POSE.png; the digest of the images.

    A camera gets no image of a pose that it does not see.

    Raises:
        InputError: the board or the rig cannot be read, or the folder holds something else.
    """
    board, rig = parse_board(config.board), load_rig(rig_path)
    _require_folder_names(rig, rig_path)
    upstream = {"rig": file_digest([rig_path], root=rig_path.parent)}
    stage = open_stage(images, name="synth-board", schema=SCHEMA, config=config, upstream=upstream, overwrite=overwrite)
    poses, seen = _shoot(rig, board, config)
    jobs = [
        _Job(images, rig, config, pose, T_world_board, tuple(np.flatnonzero(seen[pose]).tolist()))
        for pose, T_world_board in enumerate(poses)
    ]
    lost = [job for job in jobs if not all(job.path(camera).is_file() for camera in job.cameras)]
    for _ in run_jobs(_photograph, lost, workers=workers, label="photograph"):
        pass
    return stage.finish((job.path(camera) for job in jobs for camera in job.cameras), changed=bool(lost))


def shared_volume(rig: Rig) -> tuple[Float64[np.ndarray, " 3"], float]:
    """The point nearest to all optical axes, metres, and the radius of the sphere about it that every camera sees."""
    forward = rig.T_camera_world[:, 2, :3]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    centre = np.linalg.lstsq(across.sum(axis=0), np.einsum("cij,cj->i", across, rig.centres), rcond=None)[0]
    focal = rig.intrinsics[:, [0, 1], [0, 1]]
    half = rig.image_sizes / (2 * focal)
    fisheye = np.array([lens == "fisheye" for lens in rig.lenses])[:, None]
    sine = np.sin(np.where(fisheye, half.clip(max=np.pi / 2), np.arctan(half))).min(axis=1)
    return centre, float((np.linalg.norm(rig.centres - centre, axis=1) * sine).min())


def _require_folder_names(rig: Rig, rig_path: Path) -> None:
    """Cameras name the folders of their images."""
    try:
        require_plain_names(rig.names, "camera")
    except InputError as error:
        raise error.at(rig_path) from None


def _shoot(
    rig: Rig, board: Board, config: BoardConfig
) -> tuple[Float64[np.ndarray, "poses 4 4"], Bool[np.ndarray, "poses cameras"]]:
    """T_world_board of every pose and who sees it, by an operator who looks after the cameras that saw least so far."""
    centre, radius = shared_volume(rig)
    side = 2 * radius / np.sqrt(3)
    drawn = wave_board(
        board,
        CANDIDATES * config.poses,
        rng=np.random.default_rng([config.seed, 0]),
        centre=centre,
        volume_m=(side, side, side),
    )
    seen = np.array(
        [[len(visible_corners(rig, camera, board, pose)[0]) > 0 for camera in range(len(rig.names))] for pose in drawn]
    )
    taken: list[int] = []
    for _ in range(config.poses):
        worth = (seen / (1.0 + seen[taken].sum(axis=0)) ** 2).sum(axis=1)
        worth[taken] = -1.0
        taken.append(int(worth.argmax()))
    return drawn[taken], seen[taken]


def _photograph(job: _Job) -> None:
    board = parse_board(job.config.board)
    for camera in job.cameras:
        if job.path(camera).is_file():
            continue
        rng = np.random.default_rng([job.config.seed, 1, job.pose, camera])
        image = photograph_board(job.rig, camera, board, job.T_world_board, rng=rng)
        encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        write_bytes(job.path(camera), encoded.tobytes())
