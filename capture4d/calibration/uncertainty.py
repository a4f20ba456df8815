"""How well a rig is known, and where a board is that a known rig sees.

Letters: c camera, p pose; q the 14 unknowns of a camera, its LENS_PARAMETERS and the twist of its axes; b the twist of
the board in its own axes; r residuals, pixels; w = 1 / (1 + r^2 / s^2), the weight of Cauchy's loss of scale s.

Covariances are those of an M-estimator (Huber and Ronchetti, Robust Statistics, 2nd ed., section 7.6), with board poses
eliminated. Where the world lies is a convention, not an uncertainty: the gauge is the one in which the camera centres,
as a body, neither move nor turn (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000, section 9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from capture4d.calibration.adjustment import RigEstimate, view_residuals
from capture4d.cameras.board import BoardView
from capture4d.cameras.projection import (
    LENS_PARAMETERS,
    camera_lens,
    cross_matrix,
    lens_jacobian,
    point_jacobian,
    project,
    rotation_from_vector,
    transform,
    twist_jacobian,
)

__all__ = [
    "CAMERA_UNKNOWNS",
    "ViewSystem",
    "camera_blocks",
    "camera_covariance",
    "centre_sigma_m",
    "fit_board",
    "linearise",
    "noise_of",
    "robust_cost",
    "robust_scale",
    "twisted",
]

CAMERA_UNKNOWNS = len(LENS_PARAMETERS) + 6
GAUGE_M = 1e-7
"""How firmly the gauge is held: far more than any camera is known."""
FIT_STEPS = 30


@dataclass(frozen=True, slots=True, eq=False)
class ViewSystem:
    """One view, linearised: r + by_camera q + by_board b."""

    view: BoardView
    residuals: Float64[np.ndarray, "found 2"]
    by_camera: Float64[np.ndarray, "found 2 14"]
    by_board: Float64[np.ndarray, "found 2 6"]


def linearise(estimate: RigEstimate, view: BoardView) -> ViewSystem:
    """Residuals of a view and their derivatives."""
    rig = estimate.rig
    lens = camera_lens(rig, view.camera)
    T_camera_board = rig.T_camera_world[view.camera] @ estimate.T_world_board[view.pose]
    points = estimate.corners[view.ids]
    local = transform(T_camera_board, points)
    by_point = point_jacobian(local, lens)
    by_camera = np.concatenate([lens_jacobian(local, lens), by_point @ twist_jacobian(local)], axis=2)
    by_board = by_point @ (T_camera_board[:3, :3] @ twist_jacobian(points))
    return ViewSystem(view, project(local, lens) - view.pixels, by_camera, by_board)


def robust_scale(residuals: Float64[np.ndarray, "corners 2"]) -> float:
    """Standard deviation of a coordinate, pixels, by the median of the lengths (Rayleigh's law)."""
    return float(np.median(np.linalg.norm(residuals, axis=1))) / np.sqrt(2 * np.log(2))


def noise_of(residuals: Float64[np.ndarray, "corners 2"], loss_px: float) -> float:
    """Variance of a coordinate, square pixels, as the loss lets it through: E[psi^2] / E[psi']^2."""
    squared = (residuals**2).sum(axis=1)
    weights = 1 / (1 + squared / loss_px**2)
    return float(0.5 * (weights**2 * squared).mean() / (weights**2).mean() ** 2)


def camera_covariance(
    estimate: RigEstimate, views: Sequence[BoardView], *, loss_px: float
) -> Float64[np.ndarray, "cameras 14 cameras 14"]:
    """Covariance of the unknowns of all cameras."""
    count = len(estimate.rig.names)
    size = CAMERA_UNKNOWNS * count
    information = np.zeros((size, size))
    boards: dict[int, np.ndarray] = {}
    mixed: dict[int, np.ndarray] = {}
    residuals = np.concatenate([view_residuals(estimate, view) for view in views])
    variance = noise_of(residuals, loss_px)
    for view in views:
        system = linearise(estimate, view)
        q, b = system.by_camera.reshape(-1, CAMERA_UNKNOWNS), system.by_board.reshape(-1, 6)
        own = slice(CAMERA_UNKNOWNS * view.camera, CAMERA_UNKNOWNS * (view.camera + 1))
        information[own, own] += q.T @ q / variance
        boards[view.pose] = boards.get(view.pose, np.zeros((6, 6))) + b.T @ b / variance
        mixed.setdefault(view.pose, np.zeros((size, 6)))[own] += q.T @ b / variance
    for pose, board in boards.items():
        information -= mixed[pose] @ np.linalg.solve(board, mixed[pose].T)
    gauge = _gauge(estimate)
    information += gauge.T @ gauge / GAUGE_M**2
    scale = 1 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * scale[:, None] * scale) * scale[:, None] * scale
    return ((covariance + covariance.T) / 2).reshape(count, CAMERA_UNKNOWNS, count, CAMERA_UNKNOWNS)


def camera_blocks(covariance: Float64[np.ndarray, "cameras 14 cameras 14"]) -> Float64[np.ndarray, "cameras 14 14"]:
    """The part of each camera on its own."""
    each = np.arange(len(covariance))
    return covariance[each, :, each]


def centre_sigma_m(covariance: Float64[np.ndarray, "cameras 14 cameras 14"]) -> Float64[np.ndarray, " cameras"]:
    """Standard deviation of the place of each camera: root mean square distance, metres."""
    return np.sqrt(np.trace(camera_blocks(covariance)[:, -3:, -3:], axis1=1, axis2=2))


def fit_board(
    estimate: RigEstimate, views: Sequence[BoardView], *, loss_px: float
) -> tuple[Float64[np.ndarray, "4 4"], list[ViewSystem]]:
    """Where the board was at the one pose of `views`, seen by a rig that is not to change.

    Args:
        estimate: its board pose is the start.
    Returns:
        T_world_board, and the views linearised there.
    """
    (pose,) = {view.pose for view in views}
    systems = [linearise(estimate, view) for view in views]
    cost, damping = robust_cost(systems, loss_px), 1e-6
    for _ in range(FIT_STEPS):
        r = np.concatenate([system.residuals.reshape(-1) for system in systems])
        J = np.concatenate([system.by_board.reshape(-1, 6) for system in systems])
        w = np.repeat(1 / (1 + (r.reshape(-1, 2) ** 2).sum(axis=1) / loss_px**2), 2)
        normal = J.T @ (w[:, None] * J)
        step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), J.T @ (w * r))
        moved = estimate.T_world_board.copy()
        moved[pose] = moved[pose] @ twisted(step)
        trial = replace(estimate, T_world_board=moved)
        trial_systems = [linearise(trial, view) for view in views]
        trial_cost = robust_cost(trial_systems, loss_px)
        if trial_cost > cost:
            damping = max(10 * damping, 1e-4)
            if damping > 1e6:
                break
            continue
        gained, cost = cost - trial_cost, trial_cost
        estimate, systems, damping = trial, trial_systems, damping / 10
        if gained <= 1e-10 * cost:
            break
    return estimate.T_world_board[pose], systems


def twisted(twist: Float64[np.ndarray, " 6"]) -> Float64[np.ndarray, "4 4"]:
    """The movement (w, t), whole."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_vector(twist[:3])
    matrix[:3, 3] = twist[3:]
    return matrix


def robust_cost(systems: Sequence[ViewSystem], loss_px: float) -> float:
    """Cauchy's loss of all residuals."""
    return sum(float(np.log1p((system.residuals**2).sum(axis=1) / loss_px**2).sum()) for system in systems)


def _gauge(estimate: RigEstimate) -> Float64[np.ndarray, "6 unknowns"]:
    """Mean shift, and mean turn times metres, of the camera centres."""
    rig = estimate.rig
    count = len(rig.names)
    arms = rig.centres - rig.centres.mean(axis=0)
    gauge = np.zeros((6, count, CAMERA_UNKNOWNS))
    for camera in range(count):
        by_shift = -rig.T_camera_world[camera, :3, :3].T
        gauge[:3, camera, -3:] = by_shift / count
        gauge[3:, camera, -3:] = cross_matrix(arms[camera]) @ by_shift / count
    return gauge.reshape(6, -1)
