"""What a lab does before it calibrates: a rig with imperfect lenses, and a board waved about in the volume.

`simulate_views` makes corner detections without rendering: true projections plus errors drawn from a pool, which
`measure_corner_errors` fills from rendered images and the real detector.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float64, Int32

from capture4d.calibration_board import Board, BoardView
from capture4d.corner_detection import detect_corners
from capture4d.projection import project_world, rotation_from_vector, transform
from capture4d.types import Rig
from data_synth.board_images import DEFAULT, BoardImageConfig, photograph_board
from data_synth.rig import look_at

__all__ = ["calibration_rig", "measure_corner_errors", "simulate_views", "visible_corners", "wave_board"]

VOLUME_M = (1.2, 1.8, 1.2)
"""Width, height and depth of the volume, about its centre."""
CENTRE = (0.0, 1.1, 0.0)
WITHIN_M = 0.4
"""The middle of a board stays half of this within the volume."""
STEEPEST_COSINE = 0.35
"""A board seen at less than this, 70 degrees from its normal, is not detected."""
SMALLEST_VIEW = 12


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


def wave_board(
    board: Board,
    count: int,
    *,
    rng: np.random.Generator,
    arc_deg: float = 360.0,
    centre: Sequence[float] | np.ndarray = CENTRE,
    volume_m: tuple[float, float, float] = VOLUME_M,
) -> Float64[np.ndarray, "poses 4 4"]:
    """T_world_board of a board held anywhere in the volume, facing anywhere in the arc, or up, or a little down."""
    room = np.maximum(np.array(volume_m) - WITHIN_M, 0.0)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose in poses:
        azimuth, rise = np.radians(rng.uniform(0, arc_deg)), np.radians(rng.uniform(-35, 50))
        away = -np.array([np.sin(azimuth) * np.cos(rise), np.sin(rise), np.cos(azimuth) * np.cos(rise)])
        x = np.cross((0.0, -1.0, 0.0), away)
        x /= np.linalg.norm(x)
        upright = np.stack([x, np.cross(away, x), away], axis=1)
        pose[:3, :3] = upright @ rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        middle = centre + rng.uniform(-0.5, 0.5, 3) * room
        pose[:3, 3] = middle - pose[:3, :3] @ board.middle
    return poses


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


def visible_corners(
    rig: Rig, camera: int, board: Board, T_world_board: Float64[np.ndarray, "4 4"]
) -> tuple[Int32[np.ndarray, " seen"], Float64[np.ndarray, "seen 2"]]:
    """Ids and true pixels of the corners a camera sees; none if the board is too steep, or nearly out of the image."""
    sight = transform(T_world_board, board.middle[None])[0] - rig.centres[camera]
    pixels, seen = project_world(rig, camera, transform(T_world_board, board.corners))
    facing = T_world_board[:3, 2] @ sight >= STEEPEST_COSINE * np.linalg.norm(sight)
    ids = np.flatnonzero(seen & facing)
    if len(ids) < SMALLEST_VIEW:
        ids = ids[:0]
    return ids.astype(np.int32), pixels[ids]


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
