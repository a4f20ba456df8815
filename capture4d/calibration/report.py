"""How good a calibration is, and what to film next: residuals, coverage, hold-out poses, the volume, flatness.

Lengths are in millimetres, as in every report. Residuals are distances in the image; medians tell the noise, root mean
squares the few bad corners.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from capture4d.calibration.adjustment import RigEstimate, adjust_rig, view_residuals
from capture4d.calibration.config import CalibrationConfig
from capture4d.calibration.rig import Calibration
from capture4d.calibration.start import require_connected
from capture4d.calibration.uncertainty import camera_blocks, centre_sigma_m, fit_board
from capture4d.cameras.board import Board, BoardView
from capture4d.cameras.projection import rotation_angle_deg, transform, triangulate
from capture4d.errors import InputError

__all__ = ["calibration_report", "coverage_grid", "rig_difference", "rigid_alignment"]

COLUMNS, ROWS = 6, 4
"""Cells of the coverage of an image."""
LEAST_COVERAGE, LEAST_TILT_DEG, LEAST_POSES = 0.6, 25.0, 8
UNCERTAIN_RATIO, UNCERTAIN_MM = 2.0, 0.15
"""A camera is filmed more if it is twice as uncertain as the middle one, and more than this."""
BAD_VIEW_RATIO = 4.0
MOST_HELD_OUT = 8
_SIDES = (("top", "middle", "bottom"), ("left", "centre", "right"))


def calibration_report(
    calibration: Calibration, board: Board, *, pose_names: Sequence[str], config: CalibrationConfig
) -> dict[str, Any]:
    """Everything about a calibration as plain values, for calibration.json.

    Runs the bundle adjustment up to twice more: without the held-out poses, and with a free board.
    """
    names = calibration.estimate.rig.names
    cameras, grids = _cameras(calibration, board)
    residuals = _stacked(view_residuals(calibration.estimate, view) for view in calibration.views)
    links = _links(calibration.views, len(names))
    held_out = _hold_out(calibration, board, config) if config.held_out > 0 else []
    return {
        "residual_median_px": _median(residuals),
        "residual_rms_px": _rms(residuals),
        "noise_px": calibration.noise_px,
        "loss_px": calibration.loss_px,
        "adjust_cpu_s": calibration.adjust_cpu_s,
        "views": len(calibration.views),
        "corners": len(residuals),
        "cameras": [{"name": name, **row} for name, row in zip(names, cameras, strict=True)],
        "poses": [{"name": pose_names[row.pop("pose")], **row} for row in _poses(calibration)],
        "hold_out": [{"name": pose_names[row.pop("pose")], **row} for row in held_out],
        "volume": [{"name": pose_names[row.pop("pose")], **row} for row in _volume(calibration)],
        "flatness": _flatness(calibration) if config.flatness else None,
        "shared_poses": links.tolist(),
        "advice": list(_advice(calibration, cameras, grids, links, pose_names)),
    }


def coverage_grid(views: Iterable[BoardView], image_size: np.ndarray) -> Bool[np.ndarray, "rows columns"]:
    """Which cells of a camera's image have had a corner in them."""
    grid = np.zeros((ROWS, COLUMNS), bool)
    for view in views:
        cells = np.floor((view.pixels + 0.5) / image_size * (COLUMNS, ROWS)).astype(int)
        column, row = np.clip(cells, 0, (COLUMNS - 1, ROWS - 1)).T
        grid[row, column] = True
    return grid


def rigid_alignment(
    points: Float64[np.ndarray, "points 3"], target: Float64[np.ndarray, "points 3"]
) -> Float64[np.ndarray, "4 4"]:
    """The rotation and shift that bring points closest to a target (Kabsch)."""
    middle, target_middle = points.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - target_middle).T @ (points - middle))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, target_middle - rotation @ middle
    return matrix


def rig_difference(
    first: RigEstimate, second: RigEstimate
) -> tuple[Float64[np.ndarray, " cameras"], Float64[np.ndarray, " cameras"]]:
    """Distances of camera centres, metres, and angles of their axes, degrees, with the centres rigidly aligned."""
    T = rigid_alignment(first.rig.centres, second.rig.centres)
    distances = np.linalg.norm(transform(T, first.rig.centres) - second.rig.centres, axis=1)
    turned = first.rig.T_camera_world[:, :3, :3] @ T[:3, :3].T
    angles = rotation_angle_deg(turned @ np.swapaxes(second.rig.T_camera_world[:, :3, :3], 1, 2))
    return distances, angles


# --- residuals and coverage --------------------------------------------------------------------------------------


def _cameras(calibration: Calibration, board: Board) -> tuple[list[dict[str, Any]], list[np.ndarray]]:
    estimate, blocks = calibration.estimate, camera_blocks(calibration.covariance)
    sigmas = 1e3 * centre_sigma_m(calibration.covariance)
    turns = np.degrees(np.sqrt(np.trace(blocks[:, 8:11, 8:11], axis1=1, axis2=2)))
    rows, grids = [], []
    for camera in range(len(estimate.rig.names)):
        own = [view for view in calibration.views if view.camera == camera]
        lengths = np.linalg.norm(np.concatenate([view_residuals(estimate, view) for view in own]), axis=1)
        grid = coverage_grid(own, estimate.rig.image_sizes[camera])
        tilts = [_tilt_deg(estimate, view, board) for view in own]
        grids.append(grid)
        rows.append(
            {
                "poses": len(own),
                "corners": len(lengths),
                "median_px": float(np.median(lengths)),
                "rms_px": float(np.sqrt((lengths**2).mean())),
                "p95_px": float(np.percentile(lengths, 95)),
                "coverage_percent": 100 * float(grid.mean()),
                "tilt_least_deg": min(tilts),
                "tilt_most_deg": max(tilts),
                "centre_sigma_mm": float(sigmas[camera]),
                "rotation_sigma_deg": float(turns[camera]),
                "focal_sigma_px": float(np.sqrt(blocks[camera, 0, 0])),
                "coverage": grid.astype(int).tolist(),
            }
        )
    return rows, grids


def _poses(calibration: Calibration) -> list[dict[str, Any]]:
    rows = []
    for pose, views in _by_pose(calibration.views).items():
        residuals = _stacked(view_residuals(calibration.estimate, view) for view in views)
        rows.append({"pose": pose, "cameras": len(views), "median_px": _median(residuals), "rms_px": _rms(residuals)})
    return rows


def _tilt_deg(estimate: RigEstimate, view: BoardView, board: Board) -> float:
    """Angle between the board's normal and the line of sight to its middle."""
    T_camera_board = estimate.rig.T_camera_world[view.camera] @ estimate.T_world_board[view.pose]
    sight = transform(T_camera_board, board.middle[None])[0]
    cosine = float(T_camera_board[:3, 2] @ sight / np.linalg.norm(sight))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _links(views: Sequence[BoardView], cameras: int) -> np.ndarray:
    """(C, C) int: poses that two cameras both see; its diagonal is what each sees."""
    seen = np.zeros((cameras, max(view.pose for view in views) + 1), int)
    for view in views:
        seen[view.camera, view.pose] = 1
    return seen @ seen.T


# --- what was not fitted -----------------------------------------------------------------------------------------


def _hold_out(calibration: Calibration, board: Board, config: CalibrationConfig) -> list[dict[str, Any]]:
    """Calibrate without some poses, and see how the rig that comes out sees them."""
    names = calibration.estimate.rig.names
    poses = [pose for pose, views in _by_pose(calibration.views).items() if len(views) >= 2]
    wanted = min(max(1, round(config.held_out * len(poses))), MOST_HELD_OUT)
    held: set[int] = set()
    for index in np.linspace(0, len(poses) - 1, wanted + 2)[1:-1]:
        trial = held | {poses[round(float(index))]}
        try:
            require_connected([view for view in calibration.views if view.pose not in trial], names)
        except InputError:  # this pose cannot be spared
            continue
        held = trial
    if not held:
        return []
    rest = [view for view in calibration.views if view.pose not in held]
    without = adjust_rig(calibration.estimate, rest, loss_px=calibration.loss_px)
    rows = []
    for pose in sorted(held):
        views = [view for view in calibration.views if view.pose == pose]
        placed, systems = fit_board(without, views, loss_px=calibration.loss_px)
        moved = without.T_world_board.copy()
        moved[pose] = placed
        residuals = _stacked(system.residuals for system in systems)
        measured = _triangulated(replace(without, T_world_board=moved), views)
        rows.append(
            {
                "pose": pose,
                "cameras": len(views),
                "median_px": _median(residuals),
                "rms_px": _rms(residuals),
                "corner_median_mm": measured["corner_median_mm"],
                "corner_rms_mm": measured["corner_rms_mm"],
                "scale_ppm": measured["scale_ppm"],
            }
        )
    return rows


def _volume(calibration: Calibration) -> list[dict[str, Any]]:
    """Triangulate the board at every pose, and compare it with the board that was made."""
    return [
        {"pose": pose, "cameras": len(views), **_triangulated(calibration.estimate, views)}
        for pose, views in _by_pose(calibration.views).items()
        if len(views) >= 2
    ]


def _triangulated(estimate: RigEstimate, views: Sequence[BoardView]) -> dict[str, Any]:
    rig, count = estimate.rig, len(estimate.corners)
    pixels = np.zeros((len(rig.names), count, 2))
    seen = np.zeros((len(rig.names), count), bool)
    for view in views:
        pixels[view.camera, view.ids], seen[view.camera, view.ids] = view.pixels, True
    points = triangulate(rig, pixels, seen)
    known = np.isfinite(points).all(axis=1)
    if known.sum() < 4:
        return {"corner_median_mm": None, "corner_rms_mm": None, "scale_ppm": None, "place_m": None}
    points, made = points[known], estimate.corners[known]
    aligned = transform(rigid_alignment(points, made), points)
    errors = 1e3 * np.linalg.norm(aligned - made, axis=1)
    spread, made_spread = (np.linalg.norm(p - np.median(p, axis=0), axis=1).sum() for p in (aligned, made))
    return {
        "corner_median_mm": float(np.median(errors)),
        "corner_rms_mm": float(np.sqrt((errors**2).mean())),
        "scale_ppm": 1e6 * float(spread / made_spread - 1),
        "place_m": points.mean(axis=0).tolist(),
    }


def _flatness(calibration: Calibration) -> dict[str, float]:
    """What changes if the shape of the board is solved for as well."""
    fixed = calibration.estimate
    free = adjust_rig(fixed, calibration.views, loss_px=calibration.loss_px, free_board=True)
    seen = np.unique(np.concatenate([view.ids for view in calibration.views]))
    aligned = transform(rigid_alignment(free.corners[seen], fixed.corners[seen]), free.corners[seen])
    apart = 1e3 * (aligned - fixed.corners[seen])
    centres, turns = rig_difference(free, fixed)
    return {
        "out_of_plane_rms_mm": float(np.sqrt((apart[:, 2] ** 2).mean())),
        "out_of_plane_max_mm": float(np.abs(apart[:, 2]).max()),
        "in_plane_rms_mm": float(np.sqrt((apart[:, :2] ** 2).sum(axis=1).mean())),
        "centre_change_max_mm": 1e3 * float(centres.max()),
        "rotation_change_max_deg": float(turns.max()),
    }


# --- advice ------------------------------------------------------------------------------------------------------


def _advice(
    calibration: Calibration,
    cameras: Sequence[Mapping[str, Any]],
    grids: Sequence[np.ndarray],
    links: np.ndarray,
    pose_names: Sequence[str],
) -> Iterable[str]:
    """What to film next, and which views to look at."""
    names = calibration.estimate.rig.names
    middle = float(np.median([row["centre_sigma_mm"] for row in cameras]))
    for camera, (name, row, grid) in enumerate(zip(names, cameras, grids, strict=True)):
        if row["poses"] < LEAST_POSES:
            more = LEAST_POSES - row["poses"]
            yield f"{name}: sees the board at {row['poses']} poses only; film {more} more in its view"
        if grid.mean() < LEAST_COVERAGE:
            yield (
                f"{name}: the board has covered {row['coverage_percent']:.0f} % of its image; "
                f"film it in the {_emptiest(grid)} of the image"
            )
        if row["tilt_most_deg"] < LEAST_TILT_DEG:
            tilt = row["tilt_most_deg"]
            yield f"{name}: the board was never tilted by more than {tilt:.0f} degrees; tilt it by 30 to 50"
        sigma = row["centre_sigma_mm"]
        if sigma > UNCERTAIN_MM and sigma > UNCERTAIN_RATIO * middle:
            others = [other for other in np.argsort(links[camera], kind="stable")[::-1] if other != camera]
            near = ", ".join(names[other] for other in others[:2])
            yield f"{name}: its place is known to {sigma:.2f} mm only; film poses that it shares with {near}"
    usual = float(np.median([row["median_px"] for row in cameras]))
    for view in calibration.views:
        median = _median(view_residuals(calibration.estimate, view))
        if median > BAD_VIEW_RATIO * usual:
            where = f"{names[view.camera]}, pose {pose_names[view.pose]}"
            yield f"{where}: off by {median:.2f} px, {median / usual:.0f} times the usual; blurred, or the board moved?"


def _emptiest(grid: Bool[np.ndarray, "rows columns"]) -> str:
    """The ninth of the image with the fewest cells covered, in words."""
    best, words = 2.0, ""
    for i, vertical in enumerate(_SIDES[0]):
        for j, horizontal in enumerate(_SIDES[1]):
            rows = slice(*np.round(np.array([i, i + 1]) * ROWS / 3).astype(int))
            columns = slice(*np.round(np.array([j, j + 1]) * COLUMNS / 3).astype(int))
            share = float(grid[rows, columns].mean())
            if share < best:
                best, words = share, f"{vertical} {horizontal}".replace("middle centre", "middle")
    return words


def _by_pose(views: Sequence[BoardView]) -> dict[int, list[BoardView]]:
    poses: dict[int, list[BoardView]] = {}
    for view in views:
        poses.setdefault(view.pose, []).append(view)
    return dict(sorted(poses.items()))


def _stacked(residuals: Iterable[np.ndarray]) -> Float64[np.ndarray, "corners 2"]:
    return np.concatenate(list(residuals))


def _median(residuals: Float64[np.ndarray, "corners 2"]) -> float:
    return float(np.median(np.linalg.norm(residuals, axis=1)))


def _rms(residuals: Float64[np.ndarray, "corners 2"]) -> float:
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))
