"""From detected board corners to a calibrated rig: start values, bundle adjustment, uncertainty, a level world."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int32

from capture4d.calibration.adjustment import RigEstimate, adjust_rig, view_residuals
from capture4d.calibration.config import CALIBRATION, CalibrationConfig
from capture4d.calibration.start import require_connected, start_rig, usable_views
from capture4d.calibration.uncertainty import camera_covariance, robust_scale
from capture4d.cameras.board import Board, BoardView

__all__ = ["Calibration", "calibrate_rig", "final_loss", "level_world"]

LEAST_LOSS_PX = 0.01
"""Below this a loss would only fit the rounding of the detector."""
UPRIGHT = 0.3
"""Mean of the cameras' up vectors that is still taken for up."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A calibrated rig, and how it came about."""

    estimate: RigEstimate
    start: RigEstimate
    views: Sequence[BoardView]
    """Those that were used."""
    covariance: Float64[np.ndarray, "cameras 14 cameras 14"]
    """Of every camera's fx fy cx cy k1 k2 p1 p2 (k3 k4 of a fisheye) and the twist (radians, metres) of its axes."""
    noise_px: float
    """Standard deviation of a coordinate of a detected corner."""
    loss_px: float
    adjust_cpu_s: float
    """Process time of the bundle adjustment."""


def calibrate_rig(
    views: Sequence[BoardView],
    board: Board,
    *,
    names: Sequence[str],
    image_sizes: Int32[np.ndarray, "cameras 2"],
    poses: int,
    floor: int | None = None,
    config: CalibrationConfig = CALIBRATION,
) -> Calibration:
    """Calibrate lenses and places of all cameras together.

    Args:
        views: of poses 0 to poses - 1; those with too few corners are left out.
        floor: pose at which the board lies on the floor.
    Raises:
        InputError: a camera sees too little, or shares no pose with the others; names it.
    """
    used = usable_views(views, board)
    require_connected(used, names)
    start = start_rig(used, board, names=names, image_sizes=image_sizes, poses=poses, lens=config.lens)
    started = time.process_time()
    near = adjust_rig(start, used, loss_px=config.start_loss_px, iterations=15)
    loss_px = final_loss(near, used, config)
    estimate = adjust_rig(near, used, loss_px=loss_px)
    adjust_cpu_s = time.process_time() - started
    residuals = np.concatenate([view_residuals(estimate, view) for view in used])
    middle = board.middle
    return Calibration(
        estimate=level_world(estimate, middle, used, floor=floor),
        start=level_world(start, middle, used, floor=floor),
        views=used,
        covariance=camera_covariance(estimate, used, loss_px=loss_px),
        noise_px=robust_scale(residuals),
        loss_px=loss_px,
        adjust_cpu_s=adjust_cpu_s,
    )


def final_loss(estimate: RigEstimate, views: Sequence[BoardView], config: CalibrationConfig) -> float:
    """Scale of the loss that suits the noise of these views."""
    residuals = np.concatenate([view_residuals(estimate, view) for view in views])
    return max(config.loss_sigmas * robust_scale(residuals), LEAST_LOSS_PX)


def level_world(
    estimate: RigEstimate,
    middle: Float64[np.ndarray, " 3"],
    views: Sequence[BoardView],
    *,
    floor: int | None = None,
) -> RigEstimate:
    """Put the world's axes where people expect them, Y up.

    With a board on the floor: the origin is its first corner, X runs along its rows, Y out of its printed side. Else Y
    is where the cameras' images point up on average, the origin amid the board's poses, and Z towards the first camera.

    Args:
        middle: of the board, in its axes.
    """
    rig = estimate.rig
    T_old_new = np.eye(4)
    if floor is not None:
        x, y, z, origin = estimate.T_world_board[floor, :3].T
        T_old_new[:3] = np.stack([x, -z, y, origin], axis=1)
    else:
        poses = sorted({view.pose for view in views})
        middles = estimate.T_world_board[poses, :3, :3] @ middle + estimate.T_world_board[poses, :3, 3]
        origin = middles.mean(axis=0)
        up = -rig.T_camera_world[:, 1, :3].mean(axis=0)
        if np.linalg.norm(up) < UPRIGHT:
            up = -rig.T_camera_world[0, 1, :3]
        up = up / np.linalg.norm(up)
        z = rig.centres[0] - origin
        z -= up * (z @ up)
        if np.linalg.norm(z) < 1e-6:  # the first camera looks straight down
            z = np.cross(rig.T_camera_world[0, 0, :3], up)
        z /= np.linalg.norm(z)
        T_old_new[:3] = np.stack([np.cross(up, z), up, z, origin], axis=1)
    return replace(
        estimate,
        rig=replace(rig, T_camera_world=rig.T_camera_world @ T_old_new),
        T_world_board=np.linalg.inv(T_old_new) @ estimate.T_world_board,
    )
