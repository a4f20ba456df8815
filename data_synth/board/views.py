"""What a lab does before it calibrates: a rig with imperfect lenses, and a board waved about in the volume.

`simulate_views` makes corner detections without rendering: true projections plus errors drawn from a pool, which
`measure_corner_errors` fills from rendered images and the real detector.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int32

from capture4d.cameras.board import Board
from capture4d.cameras.projection import project_world, rotation_from_vector, transform
from capture4d.types import Rig

__all__ = ["CENTRE", "SMALLEST_VIEW", "visible_corners", "wave_board"]

VOLUME_M = (1.2, 1.8, 1.2)
"""Width, height and depth of the volume, about its centre."""


CENTRE = (0.0, 1.1, 0.0)


WITHIN_M = 0.4
"""The middle of a board stays half of this within the volume."""


STEEPEST_COSINE = 0.35
"""A board seen at less than this, 70 degrees from its normal, is not detected."""


SMALLEST_VIEW = 12


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
