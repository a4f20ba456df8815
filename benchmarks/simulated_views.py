"""A rig to be calibrated, and detections of a board that nobody photographed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

from capture4d.calibration.corners import detect_corners
from capture4d.cameras.board import Board, BoardView
from capture4d.cameras.projection import project_world, transform
from capture4d.types import Rig
from data_synth.board.images import DEFAULT, BoardImageConfig, photograph_board
from data_synth.board.views import CENTRE, SMALLEST_VIEW, visible_corners
from data_synth.scanner.rig import look_at

__all__ = ["calibration_rig", "measure_corner_errors", "simulate_views"]


def calibration_rig(
    cameras: int = 14,
    *,
    rng: np.random.Generator,
    distance_m: float = 2.4,
    image_size: tuple[int, int] = (2048, 1536),
    focal_px: float = 2000.0,
    arc_deg: float = 360.0,
) -> Rig:
    """Cameras in three rings, or arcs, about the volume, no two lenses alike, none mounted quite as planned."""
    heights = np.array([-0.9, 0.0, 0.9])
    transforms = []
    for index in range(cameras):
        ring = index % 3
        azimuth = np.radians(arc_deg) * (index / cameras) + 0.1 * rng.normal()
        level = np.sqrt(distance_m**2 - heights[ring] ** 2)
        eye = np.array([level * np.sin(azimuth), heights[ring], level * np.cos(azimuth)])
        target = 0.1 * rng.normal(size=3)
        transforms.append(look_at(eye + CENTRE, target + CENTRE))
    width, height = image_size
    intrinsics = np.zeros((cameras, 3, 3))
    intrinsics[:, 0, 0] = focal_px * (1 + 0.01 * rng.normal(size=cameras))
    intrinsics[:, 1, 1] = intrinsics[:, 0, 0] * (1 + 0.001 * rng.normal(size=cameras))
    intrinsics[:, 0, 2] = (width - 1) / 2 + 0.006 * width * rng.normal(size=cameras)
    intrinsics[:, 1, 2] = (height - 1) / 2 + 0.006 * width * rng.normal(size=cameras)
    intrinsics[:, 2, 2] = 1
    distortion = np.zeros((cameras, 5))
    distortion[:, :4] = [-0.11, 0.09, 0, 0] + rng.normal(size=(cameras, 4)) * [0.02, 0.02, 4e-4, 4e-4]
    return Rig(
        names=tuple(f"cam{index:02d}" for index in range(cameras)),
        intrinsics=intrinsics,
        distortion=distortion,
        T_camera_world=np.stack(transforms),
        image_sizes=np.tile(np.array(image_size, np.int32), (cameras, 1)),
    )


def simulate_views(
    rig: Rig,
    board: Board,
    poses: Float64[np.ndarray, "poses 4 4"],
    *,
    errors: list[np.ndarray],
    rng: np.random.Generator,
) -> list[BoardView]:
    """Detections of every camera at every pose; each view takes its errors from one image of the pool."""
    views = []
    for pose, T_world_board in enumerate(poses):
        for camera in range(len(rig.names)):
            ids, pixels = visible_corners(rig, camera, board, T_world_board)
            if len(ids):
                pool = errors[rng.integers(len(errors))]
                noisy = pixels + pool[rng.integers(len(pool), size=len(ids))]
                views.append(BoardView(camera, pose, ids, noisy))
    return views


def measure_corner_errors(
    rig: Rig,
    board: Board,
    poses: Float64[np.ndarray, "poses 4 4"],
    *,
    rng: np.random.Generator,
    config: BoardImageConfig = DEFAULT,
    images: int = 20,
    detect: Callable[[np.ndarray, Board], tuple[np.ndarray, np.ndarray]] = detect_corners,
) -> list[Float64[np.ndarray, "corners 2"]]:
    """Detected less true corners, pixels, of rendered images of a rig: one array an image that shows the board."""
    pool = []
    for pose in poses:
        seeing = [c for c in range(len(rig.names)) if len(visible_corners(rig, c, board, pose)[0])]
        if not seeing or len(pool) == images:
            continue
        camera = int(rng.choice(seeing))
        found, pixels = detect(photograph_board(rig, camera, board, pose, rng=rng, config=config), board)
        everywhere, _ = project_world(rig, camera, transform(pose, board.corners))
        if len(found) >= SMALLEST_VIEW:
            pool.append(pixels - everywhere[found])
    return pool
