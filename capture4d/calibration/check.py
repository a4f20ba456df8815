"""Which camera has moved since calibration? One board pose, seen by several cameras, is enough to tell.

For each camera in turn, the others say where the board is; what its own image then disagrees with is a movement m of
its axes, and m' S^-1 m follows a chi-square law with six degrees of freedom if it has not moved. S holds all that is
uncertain: the corners in this image, the calibration of this camera, and the board pose with the calibration of the
others. While some camera stands out, the one without which the rest agree best is set aside, so that a moved camera
does not put the blame on its neighbours.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float64
from scipy.special import chdtri

from capture4d.calibration.adjustment import RigEstimate
from capture4d.calibration.config import RIG_CHECK, RigCheckConfig
from capture4d.calibration.rig import LEAST_LOSS_PX
from capture4d.calibration.start import usable_views
from capture4d.calibration.uncertainty import CAMERA_UNKNOWNS, fit_board, linearise, noise_of, robust_scale
from capture4d.cameras.board import Board, BoardView
from capture4d.cameras.projection import camera_lens, undistort
from capture4d.errors import InputError
from capture4d.types import Rig

__all__ = ["CameraCheck", "check_rig"]

LEAST_CAMERAS = 3
"""At a pose: of two that disagree, nobody knows which has moved."""
FIT_LOSSES_PX = (10.0, 1.0)
"""Losses that lead up to the last one, so that a camera that was kicked does not drag the board along."""
MOVEMENT_STEPS = 12
LOSS_SIGMAS = 2.385
"""Cauchy's loss is then 95 % efficient on Gaussian noise."""


@dataclass(frozen=True, slots=True)
class CameraCheck:
    """What the check says of one camera."""

    name: str
    verdict: Literal["still", "moved", "unseen"]
    """`unseen`: it sees no pose of the board that others can vouch for."""
    score: float
    """Of the movement, in units of what an untouched rig stays under; above 1 it has moved. NaN if unseen."""
    shift_px: float
    """How far the board lies from where it should, root mean square over its corners."""
    translation_mm: float
    rotation_deg: float
    """Best explanation of the shift by a movement of the camera; the two trade off against each other."""
    translation_sigma_mm: float
    rotation_sigma_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class _Movement:
    twist: Float64[np.ndarray, " 6"]
    covariance: Float64[np.ndarray, "6 6"]
    shift_px: float
    score: float


def check_rig(
    rig: Rig,
    views: Sequence[BoardView],
    board: Board,
    *,
    covariance: Float64[np.ndarray, "cameras 14 cameras 14"] | None = None,
    config: RigCheckConfig = RIG_CHECK,
) -> list[CameraCheck]:
    """Test every camera of a rig.

    Args:
        views: of one pose of the board, or several.
        covariance: of the calibration, from `camera_covariance`; without them only the config's floor counts.
    Raises:
        InputError: no pose is seen by three cameras.
    """
    used = _seen_together(usable_views(views, board))
    if not used:
        raise InputError(f"images: expected a pose of the board that {LEAST_CAMERAS} cameras see, found none")
    if covariance is None:
        covariance = np.zeros((len(rig.names), CAMERA_UNKNOWNS) * 2)
    known = covariance
    scene = _scene(rig, used, board)
    limit = float(chdtri(6, config.false_alarms / len({view.camera for view in used})))

    def movement(camera: int, trusted: set[int]) -> _Movement | None:
        return _movement(scene, camera, trusted - {camera}, known, limit, config)

    def discord(trusted: set[int]) -> float:
        found = [movement(camera, trusted) for camera in sorted(trusted)]
        return max((entry.score for entry in found if entry is not None), default=0.0)

    trusted = {view.camera for view in used}
    while len(trusted) > 2 and discord(trusted) > 1:
        trusted.remove(min(sorted(trusted), key=lambda camera: discord(trusted - {camera})))
    return [_verdict(name, movement(camera, trusted)) for camera, name in enumerate(rig.names)]


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """The rig, the views, and a first idea of the board's poses and of the noise."""

    estimate: RigEstimate
    views: Sequence[BoardView]
    cameras: Mapping[int, frozenset[int]]
    """Which cameras see the board, by pose."""
    noise: Mapping[tuple[int, int], float]
    """Variance of a coordinate, square pixels, for each camera and pose: a steep or blurred view has more."""
    loss_px: float


def _seen_together(views: Sequence[BoardView]) -> list[BoardView]:
    counts = Counter(view.pose for view in views)
    return [view for view in views if counts[view.pose] >= LEAST_CAMERAS]


def _scene(rig: Rig, views: Sequence[BoardView], board: Board) -> _Scene:
    poses = np.tile(np.eye(4), (max(view.pose for view in views) + 1, 1, 1))
    for pose in {view.pose for view in views}:
        best = max((view for view in views if view.pose == pose), key=lambda view: len(view.ids))
        poses[pose] = _place_board(rig, best, board)
    estimate = RigEstimate(rig, poses, board.corners)
    residuals = {}
    for view in views:  # each on its own, so that what remains is the detector's noise and not the rig's
        alone = poses.copy()
        alone[view.pose] = _place_board(rig, view, board)
        _, (system,) = fit_board(replace(estimate, T_world_board=alone), [view], loss_px=FIT_LOSSES_PX[-1])
        residuals[view.camera, view.pose] = system.residuals
    loss_px = max(LOSS_SIGMAS * robust_scale(np.concatenate(list(residuals.values()))), LEAST_LOSS_PX)
    noise = {key: noise_of(left, loss_px) * len(left) / max(len(left) - 3, 1) for key, left in residuals.items()}
    cameras = {pose: frozenset(view.camera for view in views if view.pose == pose) for pose in {v.pose for v in views}}
    return _Scene(estimate, views, cameras, noise, loss_px)


def _place_board(rig: Rig, view: BoardView, board: Board) -> Float64[np.ndarray, "4 4"]:
    """T_world_board from one view."""
    flat = undistort(view.pixels, camera_lens(rig, view.camera))
    _, turn, shift = cv2.solvePnP(board.corners[view.ids], flat, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE)
    T_camera_board = np.eye(4)
    T_camera_board[:3, :3], T_camera_board[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    return np.linalg.inv(rig.T_camera_world[view.camera]) @ T_camera_board


def _movement(
    scene: _Scene,
    camera: int,
    witnesses: set[int],
    calibrated: Float64[np.ndarray, "cameras 14 cameras 14"],
    limit: float,
    config: RigCheckConfig,
) -> _Movement | None:
    """How a camera has moved, if the witnesses have not; None if none of them sees a board that it sees."""
    own, boards = [], []
    for view in scene.views:
        others = frozenset(witnesses & scene.cameras[view.pose])
        if view.camera == camera and others:
            board = _witnessed_board(scene, view.pose, others)
            own.append(linearise(board.estimate, view))
            boards.append(board)
    if not own:
        return None
    r = np.concatenate([system.residuals.reshape(-1) for system in own])
    by_camera = np.concatenate([system.by_camera.reshape(-1, CAMERA_UNKNOWNS) for system in own])
    J = by_camera[:, -6:]
    twist, solver = _robust_twist(r, J, scene.loss_px)
    noise = np.concatenate([np.full(s.residuals.size, scene.noise[camera, s.view.pose]) for s in own])
    plain = np.linalg.solve(J.T @ J, J.T)
    covariance = (plain * noise) @ plain.T
    covariance += np.diag(np.repeat([np.radians(config.floor_deg) ** 2, (config.floor_mm / 1e3) ** 2], 3))
    influence = np.zeros((6, *calibrated.shape[:2]))
    influence[:, camera] = solver @ by_camera
    ends = np.cumsum([system.residuals.size for system in own])
    for system, board, end in zip(own, boards, ends, strict=True):
        by_board = solver[:, end - system.residuals.size : end] @ system.by_board.reshape(-1, 6)
        covariance += by_board @ board.covariance @ by_board.T
        for witness, influenced in board.by_witness.items():
            influence[:, witness] += by_board @ influenced
    covariance += np.einsum("icq,cqdr,jdr->ij", influence, calibrated, influence, optimize=True)
    score = float(twist @ np.linalg.solve(covariance, twist)) / limit
    shift_px = float(np.sqrt(2 * ((J @ twist) ** 2).mean()))
    return _Movement(twist, covariance, shift_px, score)


@dataclass(frozen=True, slots=True, eq=False)
class _WitnessedBoard:
    estimate: RigEstimate
    covariance: Float64[np.ndarray, "6 6"]
    """Of the board's twist, from the noise in the witnesses' images."""
    by_witness: dict[int, Float64[np.ndarray, "6 14"]]
    """What an error in a witness's calibration does to the board's twist."""


@lru_cache(maxsize=256)
def _witnessed_board(scene: _Scene, pose: int, witnesses: frozenset[int]) -> _WitnessedBoard:
    """Where some cameras say the board was at one pose."""
    views = [view for view in scene.views if view.pose == pose and view.camera in witnesses]
    estimate, systems = scene.estimate, []
    for loss_px in (*FIT_LOSSES_PX, scene.loss_px):
        placed, systems = fit_board(estimate, views, loss_px=loss_px)
        poses = estimate.T_world_board.copy()
        poses[pose] = placed
        estimate = replace(estimate, T_world_board=poses)
    weights = [_weights(system.residuals, scene.loss_px) for system in systems]
    jacobians = [system.by_board.reshape(-1, 6) for system in systems]
    normal = sum(J.T @ (w[:, None] * J) for J, w in zip(jacobians, weights, strict=True))
    inverse = np.linalg.inv(normal)
    by_witness = {
        system.view.camera: -inverse @ (J.T * w) @ system.by_camera.reshape(-1, CAMERA_UNKNOWNS)
        for system, J, w in zip(systems, jacobians, weights, strict=True)
    }
    plain = np.linalg.inv(sum(J.T @ J for J in jacobians))
    spread = sum(scene.noise[system.view.camera, pose] * J.T @ J for system, J in zip(systems, jacobians, strict=True))
    return _WitnessedBoard(estimate, plain @ spread @ plain, by_witness)


def _robust_twist(
    r: Float64[np.ndarray, " rows"], J: Float64[np.ndarray, "rows 6"], loss_px: float
) -> tuple[Float64[np.ndarray, " 6"], Float64[np.ndarray, "6 rows"]]:
    """The twist that best explains residuals, and the linear map that finds it: twist = map @ r."""
    w = np.ones(len(r))
    solver = np.zeros((6, len(r)))
    for step in range(MOVEMENT_STEPS):
        solver = -np.linalg.solve(J.T @ (w[:, None] * J), J.T * w)
        left = (r + J @ (solver @ r)).reshape(-1, 2)
        w = _weights(left, loss_px * max(1.0, 100.0 * 0.25**step))
    return solver @ r, solver


def _weights(residuals: Float64[np.ndarray, "corners 2"], loss_px: float) -> Float64[np.ndarray, " rows"]:
    """Cauchy's weight of each coordinate."""
    return np.repeat(1 / (1 + (residuals**2).sum(axis=1) / loss_px**2), 2)


def _verdict(name: str, movement: _Movement | None) -> CameraCheck:
    if movement is None:
        return CameraCheck(name, "unseen", *[float("nan")] * 6)
    turn, shift = movement.twist[:3], movement.twist[3:]
    sigmas = np.sqrt(np.diag(movement.covariance))
    return CameraCheck(
        name=name,
        verdict="moved" if movement.score > 1 else "still",
        score=movement.score,
        shift_px=movement.shift_px,
        translation_mm=1e3 * float(np.linalg.norm(shift)),
        rotation_deg=float(np.degrees(np.linalg.norm(turn))),
        translation_sigma_mm=1e3 * float(np.linalg.norm(sigmas[3:])),
        rotation_sigma_deg=float(np.degrees(np.linalg.norm(sigmas[:3]))),
    )
