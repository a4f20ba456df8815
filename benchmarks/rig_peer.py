"""The peer of the rig calibration: OpenCV alone, with its own defaults.

`cv2.aruco.CharucoDetector` finds the corners. `cv2.calibrateCamera` calibrates every camera by itself; with the lens
that comes out, `cv2.solvePnP` places the board before the camera in every view. Two cameras that see the same pose are
then known relative to each other, and the mean over all poses that they share is kept. From the camera with the most
corners, a chain over the pairs that share most corners reaches all others.

The peer is told what the rig is told, the board and that k3 is 0, and nothing else: no true pose, lens or world.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float64, Int32, UInt8

from capture4d.cameras.board import Board, BoardView
from capture4d.types import Rig

__all__ = ["calibrate_with_opencv", "find_corners_with_opencv"]


def find_corners_with_opencv(
    image: UInt8[np.ndarray, "height width"], board: Board
) -> tuple[Int32[np.ndarray, " found"], Float64[np.ndarray, "found 2"]]:
    """Numbers and pixels of the corners; empty where no board is seen."""
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board.opencv()).detectBoard(image)
    if ids is None:
        return np.zeros(0, np.int32), np.zeros((0, 2))
    return ids.ravel().astype(np.int32), corners.reshape(-1, 2).astype(np.float64)


def calibrate_with_opencv(
    views: Sequence[BoardView], board: Board, *, names: Sequence[str], image_sizes: np.ndarray
) -> Rig:
    """Lenses, and cameras in the axes of the one with the most corners.

    Args:
        views: with corners enough for a pose, and poses enough to link all cameras.
        image_sizes: (C, 2), width and height.
    """
    count = len(names)
    intrinsics, distortion = np.zeros((count, 3, 3)), np.zeros((count, 5))
    T_camera_board: dict[tuple[int, int], np.ndarray] = {}
    for camera in range(count):
        own = [view for view in views if view.camera == camera]
        K, D = _lens(own, board, (int(image_sizes[camera, 0]), int(image_sizes[camera, 1])))
        intrinsics[camera], distortion[camera] = K, D
        T_camera_board |= {(camera, view.pose): _placed(view, board, K, D) for view in own}
    corners = {(view.camera, view.pose): len(view.ids) for view in views}
    chained = _chain(T_camera_board, corners, count)
    return Rig(tuple(names), intrinsics, distortion, chained, np.asarray(image_sizes, np.int32))


def _lens(views: Sequence[BoardView], board: Board, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    objects = [board.corners[view.ids].astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    _, K, D, _, _ = cv2.calibrateCamera(objects, pixels, size, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3)
    return np.asarray(K, np.float64), np.ravel(D)[:5].astype(np.float64)


def _placed(view: BoardView, board: Board, K: np.ndarray, D: np.ndarray) -> Float64[np.ndarray, "4 4"]:
    """T_camera_board."""
    found, turn, shift = cv2.solvePnP(board.corners[view.ids], view.pixels, K, D)
    assert found
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return matrix


def _chain(
    T_camera_board: dict[tuple[int, int], np.ndarray], corners: dict[tuple[int, int], int], count: int
) -> Float64[np.ndarray, "cameras 4 4"]:
    """T_camera_world along the tree of the best linked pairs (Prim); the world is the first camera of the tree."""
    poses = [{pose for seen_by, pose in corners if seen_by == camera} for camera in range(count)]
    links = np.zeros((count, count))
    for first in range(count):
        for second in range(count):
            shared = (poses[first] & poses[second]) if first != second else set()
            links[first, second] = sum(min(corners[first, pose], corners[second, pose]) for pose in shared)
    T_camera_world = np.tile(np.eye(4), (count, 1, 1))
    reached = [int(np.argmax([sum(corners[camera, pose] for pose in poses[camera]) for camera in range(count)]))]
    while len(reached) < count:
        rest = [camera for camera in range(count) if camera not in reached]
        strongest = np.unravel_index(np.argmax(links[np.ix_(reached, rest)]), (len(reached), len(rest)))
        known, new = reached[strongest[0]], rest[strongest[1]]
        relative = [
            T_camera_board[new, pose] @ np.linalg.inv(T_camera_board[known, pose]) for pose in poses[known] & poses[new]
        ]
        T_camera_world[new] = _mean(relative) @ T_camera_world[known]
        reached.append(new)
    return T_camera_world


def _mean(transforms: Sequence[np.ndarray]) -> Float64[np.ndarray, "4 4"]:
    """Mean shift, and the rotation nearest to the mean of the rotations."""
    mean = np.mean(transforms, axis=0)
    u, _, vt = np.linalg.svd(mean[:3, :3])
    mean[:3, :3] = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return mean
