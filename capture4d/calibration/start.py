"""Start values of a rig calibration: each camera alone, then a chain through the board poses that cameras share.

Lenses come from OpenCV's calibrateCamera (Zhang, A Flexible New Technique for Camera Calibration, PAMI 2000), which
also places the board before the camera in every view; those of fisheyes from a search for the focal length. Cameras and
board poses are the nodes of a graph, views its edges; every camera is reached from the first along the best-seen views
(Dijkstra).
"""

from __future__ import annotations

import contextlib
import heapq
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float64

from capture4d.calibration.adjustment import RigEstimate
from capture4d.calibration.uncertainty import ViewSystem, linearise, robust_cost, twisted
from capture4d.cameras.board import Board, BoardView
from capture4d.cameras.projection import Lens, project, transform, undistort
from capture4d.errors import InputError
from capture4d.types import LensModel, Rig

__all__ = ["LEAST_VIEWS", "require_connected", "start_rig", "usable_views"]

FISHEYE_FOCALS = np.geomspace(0.15, 2.0, 24)
"""Tried as the focal length of a fisheye, in parts of the longer side of its image."""
FISHEYE_LOSSES_PX, FISHEYE_STEPS = (100.0, 10.0, 2.0), 12
LEAST_VIEWS = 3
"""Of one camera: Zhang's method needs two, and the noise one more."""


def usable_views(views: Sequence[BoardView], board: Board) -> list[BoardView]:
    """Views with enough corners, and not all on one line of squares."""
    return [view for view in views if board.is_fixed_by(view.ids)]


def require_connected(views: Sequence[BoardView], names: Sequence[str]) -> None:
    """Raise unless every camera sees the board, often enough, and shares poses with the others.

    Raises:
        InputError: names the cameras at fault.
    """
    counts = np.bincount([view.camera for view in views], minlength=len(names))
    if not counts.any():
        raise InputError("images: expected the board in some of them, found it nowhere; is --board the one filmed?")
    if (counts == 0).any():
        blind = ", ".join(name for name, count in zip(names, counts, strict=True) if count == 0)
        raise InputError(f"images: expected the board in images of every camera, found none of {blind}")
    if (counts < LEAST_VIEWS).any():
        short = np.flatnonzero(counts < LEAST_VIEWS).tolist()
        few = ", ".join(f"{names[camera]} ({counts[camera]})" for camera in short)
        raise InputError(f"images: expected at least {LEAST_VIEWS} poses with the board per camera, found {few}")
    groups = _groups(views)
    if len(groups) > 1:
        named = " | ".join(", ".join(names[camera] for camera in group) for group in groups)
        raise InputError(f"images: expected cameras linked by shared views of the board, found separate ones: {named}")


def start_rig(
    views: Sequence[BoardView],
    board: Board,
    *,
    names: Sequence[str],
    image_sizes: np.ndarray,
    poses: int,
    lens: LensModel = "brown",
) -> RigEstimate:
    """Lenses, cameras and board poses, good to a few millimetres. The world is the camera with the most views.

    Args:
        image_sizes: (C, 2) int32, width and height.
    Raises:
        InputError: a camera's lens cannot be found; names the camera.
    """
    count = len(names)
    intrinsics, distortion = np.zeros((count, 3, 3)), np.zeros((count, 5))
    T_camera_board: dict[tuple[int, int], np.ndarray] = {}
    with _one_thread():
        for camera in range(count):
            own = [view for view in views if view.camera == camera]
            size = int(image_sizes[camera, 0]), int(image_sizes[camera, 1])
            calibrate = _calibrate_fisheye if lens == "fisheye" else _calibrate_camera
            intrinsics[camera], distortion[camera], placed = calibrate(own, board, size, names[camera])
            T_camera_board |= {(camera, view.pose): matrix for view, matrix in zip(own, placed, strict=True)}
    weights = {(view.camera, view.pose): len(view.ids) for view in views}
    T_camera_world, T_world_board = _chain(T_camera_board, weights, count, poses)
    sizes = np.asarray(image_sizes, np.int32)
    rig = Rig(tuple(names), intrinsics, distortion, T_camera_world, sizes, (lens,) * count)
    return RigEstimate(rig, T_world_board, board.corners)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """OpenCV's sums in the same order every time: on several threads, two calibrations of the same corners differ."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def _calibrate_camera(
    views: Sequence[BoardView], board: Board, size: tuple[int, int], name: str
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 5"], list[np.ndarray]]:
    corners = board.corners.astype(np.float32)
    objects = [corners[view.ids] for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    guess = np.eye(3)
    try:
        _, K, D, turns, shifts = cv2.calibrateCamera(objects, pixels, size, guess, np.zeros(5), flags=cv2.CALIB_FIX_K3)
    except cv2.error as error:
        reason = " ".join(str(error.err or error).split())
        raise InputError(f"camera {name}: expected board views that fix its lens, found none ({reason})") from None
    _require_sane(K, D, size, name)
    placed = []
    for turn, shift in zip(turns, shifts, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3] = cv2.Rodrigues(turn)[0]
        matrix[:3, 3] = np.ravel(shift)
        placed.append(matrix)
    return np.asarray(K, np.float64), np.ravel(D)[:5].astype(np.float64), placed


def _require_sane(K: np.ndarray, D: np.ndarray, size: tuple[int, int], name: str) -> None:
    if not (np.isfinite(K).all() and np.isfinite(D).all() and 0.1 < K[0, 0] / max(size) < 50):
        raise InputError(f"camera {name}: expected board views that fix its lens, found a focal length of {K[0, 0]:g}")


def _calibrate_fisheye(
    views: Sequence[BoardView], board: Board, size: tuple[int, int], name: str
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 5"], list[np.ndarray]]:
    """The best of a few focal lengths, then Gauss and Newton: cv2.fisheye.calibrate gives up where views are steep."""
    best, best_error, placed = None, np.inf, np.zeros((0, 4, 4))
    middle = (np.array(size) - 1) / 2
    for focal in max(size) * FISHEYE_FOCALS:
        K = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]])
        lens = Lens(K, np.zeros(5), "fisheye")
        poses = [_place_flat(view, board, lens) for view in views]
        errors = [
            np.inf if pose is None else _misfit(view, board, lens, pose)
            for view, pose in zip(views, poses, strict=True)
        ]
        if np.median(errors) < best_error:
            best_error, best = float(np.median(errors)), lens
            placed = np.stack([np.eye(4) if pose is None else pose for pose in poses])
            kept = np.isfinite(errors)
    if best is None or kept.sum() < LEAST_VIEWS:
        raise InputError(f"camera {name}: expected board views that fix the lens of a fisheye, found none")
    rig = Rig(
        (name,), best.intrinsics[None], best.distortion[None], np.eye(4)[None], np.array([size], np.int32), ("fisheye",)
    )
    own = [replace(view, camera=0, pose=index) for index, view in enumerate(views)]
    estimate = RigEstimate(rig, placed, board.corners)
    for loss_px in FISHEYE_LOSSES_PX:
        estimate = _refine_lens(estimate, [view for view in own if kept[view.pose]], loss_px)
    K, D = estimate.rig.intrinsics[0], estimate.rig.distortion[0]
    _require_sane(K, D, size, name)
    lens = Lens(K, D, "fisheye")
    poses = estimate.T_world_board
    for view in own:
        if not kept[view.pose]:
            pose = _place_flat(view, board, lens)
            poses[view.pose] = poses[view.pose] if pose is None else pose
    return K, D, list(poses)


def _place_flat(view: BoardView, board: Board, lens: Lens) -> Float64[np.ndarray, "4 4"] | None:
    """T_camera_board of a view through a known lens; None if parts of it would lie sideways or beyond."""
    flat = undistort(view.pixels, lens)
    if not (np.abs(flat) < 20).all():
        return None
    done, turn, shift = cv2.solvePnP(board.corners[view.ids], flat, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE)
    if not done or not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        return None
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    return matrix


def _misfit(view: BoardView, board: Board, lens: Lens, T_camera_board: Float64[np.ndarray, "4 4"]) -> float:
    """Root mean square, pixels."""
    apart = project(transform(T_camera_board, board.corners[view.ids]), lens) - view.pixels
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


def _refine_lens(estimate: RigEstimate, views: Sequence[BoardView], loss_px: float) -> RigEstimate:
    """Lens and board poses of one camera, by Levenberg's and Marquardt's method with Cauchy's loss."""
    systems = [linearise(estimate, view) for view in views]
    cost, damping = robust_cost(systems, loss_px), 1e-3
    for _ in range(FISHEYE_STEPS):
        trial = _stepped(estimate, systems, loss_px, damping)
        trial_systems = [linearise(trial, view) for view in views] if trial is not None else systems
        trial_cost = robust_cost(trial_systems, loss_px)
        if trial is None or not trial_cost < cost:
            damping *= 10
            if damping > 1e6:
                break
            continue
        gained, cost = cost - trial_cost, trial_cost
        estimate, systems, damping = trial, trial_systems, damping / 10
        if gained <= 1e-3 * cost:
            break
    return estimate


def _stepped(
    estimate: RigEstimate, systems: Sequence[ViewSystem], loss_px: float, damping: float
) -> RigEstimate | None:
    """One step, the poses eliminated; None if it leaves what a lens can be."""
    normal, target, parts = np.zeros((8, 8)), np.zeros(8), []
    for system in systems:
        r, q = system.residuals.reshape(-1), system.by_camera[:, :, :8].reshape(-1, 8)
        b = system.by_board.reshape(-1, 6)
        w = np.repeat(1 / (1 + (system.residuals**2).sum(axis=1) / loss_px**2), 2)[:, None]
        own, board, mixed = q.T @ (w * q), b.T @ (w * b), q.T @ (w * b)
        inverse = np.linalg.inv(board + damping * np.diag(np.diag(board)))
        downhill = b.T @ (w[:, 0] * r)
        normal += own + damping * np.diag(np.diag(own)) - mixed @ inverse @ mixed.T
        target += q.T @ (w[:, 0] * r) - mixed @ inverse @ downhill
        parts.append((system.view.pose, inverse, mixed, downhill))
    step = -np.linalg.solve(normal, target)
    K, D = estimate.rig.intrinsics.copy(), estimate.rig.distortion.copy()
    K[0, [0, 1, 0, 1], [0, 1, 2, 2]] += step[:4]
    D[0, :4] += step[4:]
    if not (np.isfinite(step).all() and K[0, 0, 0] > 0 and K[0, 1, 1] > 0):
        return None
    poses = estimate.T_world_board.copy()
    for pose, inverse, mixed, downhill in parts:
        poses[pose] = poses[pose] @ twisted(-inverse @ (downhill + mixed.T @ step))
    return RigEstimate(replace(estimate.rig, intrinsics=K, distortion=D), poses, estimate.corners)


def _chain(
    T_camera_board: Mapping[tuple[int, int], np.ndarray],
    weights: Mapping[tuple[int, int], int],
    cameras: int,
    poses: int,
) -> tuple[np.ndarray, np.ndarray]:
    """T_camera_world (C, 4, 4) and T_world_board (P, 4, 4) along the shortest paths; a view costs 1 / its corners."""
    neighbours = defaultdict(list)
    for camera, pose in T_camera_board:
        neighbours["camera", camera].append(("pose", pose))
        neighbours["pose", pose].append(("camera", camera))
    totals = np.zeros(cameras)
    for (camera, _), corners in weights.items():
        totals[camera] += corners
    T_camera_world, T_world_board = np.tile(np.eye(4), (cameras, 1, 1)), np.tile(np.eye(4), (poses, 1, 1))
    queue = [(0.0, ("camera", int(np.argmax(totals))), -1)]
    done = set()
    while queue:
        cost, node, before = heapq.heappop(queue)
        if node in done:
            continue
        done.add(node)
        kind, index = node
        if before >= 0:
            if kind == "pose":
                T_world_board[index] = np.linalg.inv(T_camera_world[before]) @ T_camera_board[before, index]
            else:
                T_camera_world[index] = T_camera_board[index, before] @ np.linalg.inv(T_world_board[before])
        for other in neighbours[node]:
            edge = (index, other[1]) if kind == "camera" else (other[1], index)
            if other not in done:
                heapq.heappush(queue, (cost + 1 / weights[edge], other, index))
    return T_camera_world, T_world_board


def _groups(views: Sequence[BoardView]) -> list[list[int]]:
    """Cameras that are linked by poses they share, the largest group first."""
    owner: dict[int, set[int]] = {}
    for pose in {view.pose for view in views}:
        together = {view.camera for view in views if view.pose == pose}
        merged = set().union(together, *(owner.get(camera, set()) for camera in together))
        owner.update(dict.fromkeys(merged, merged))
    unique = {min(group): sorted(group) for group in owner.values()}
    return sorted(unique.values(), key=lambda group: (-len(group), group))
