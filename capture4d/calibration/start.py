"""Start values of a rig calibration: each camera alone, then a chain through the board poses that cameras share.

Lenses come from OpenCV's calibrateCamera (Zhang, A Flexible New Technique for Camera Calibration, PAMI 2000), which
also places the board before the camera in every view. Cameras and board poses are the nodes of a graph, views its
edges; every camera is reached from the first along the best-seen views (Dijkstra).
"""

from __future__ import annotations

import contextlib
import heapq
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Float64

from capture4d.calibration.adjustment import RigEstimate
from capture4d.cameras.board import Board, BoardView
from capture4d.errors import InputError
from capture4d.types import Rig

__all__ = ["LEAST_VIEWS", "require_connected", "start_rig", "usable_views"]

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
            intrinsics[camera], distortion[camera], placed = _calibrate_camera(own, board, size, names[camera])
            T_camera_board |= {(camera, view.pose): matrix for view, matrix in zip(own, placed, strict=True)}
    weights = {(view.camera, view.pose): len(view.ids) for view in views}
    T_camera_world, T_world_board = _chain(T_camera_board, weights, count, poses)
    rig = Rig(tuple(names), intrinsics, distortion, T_camera_world, np.asarray(image_sizes, np.int32))
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
    lens_is_sane = np.isfinite(K).all() and np.isfinite(D).all() and 0.1 < K[0, 0] / max(size) < 50
    if not lens_is_sane:
        raise InputError(f"camera {name}: expected board views that fix its lens, found a focal length of {K[0, 0]:g}")
    placed = []
    for turn, shift in zip(turns, shifts, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3] = cv2.Rodrigues(turn)[0]
        matrix[:3, 3] = np.ravel(shift)
        placed.append(matrix)
    return np.asarray(K, np.float64), np.ravel(D)[:5].astype(np.float64), placed


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
