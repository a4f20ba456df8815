"""Corners are found where they are, whatever lens, ink and light do to the picture."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.simulated_views import calibration_rig, measure_corner_errors
from capture4d.calibration.corners import detect_corners, find_corners
from capture4d.cameras.board import Board, parse_board
from capture4d.cameras.projection import project_world, rotation_from_vector, transform
from capture4d.types import Rig
from data_synth.board.images import DEFAULT, BoardImageConfig, photograph_board
from data_synth.board.views import visible_corners, wave_board

SPEC = "charuco:14x10:60:44:DICT_5X5_100"


def gamma(image: np.ndarray) -> np.ndarray:
    return np.rint(255 * (image / 255.0) ** 0.45).astype(np.uint8)


def shade(image: np.ndarray) -> np.ndarray:
    x, y = np.meshgrid(np.arange(image.shape[1]), np.arange(image.shape[0]))
    return np.rint(image * (0.65 + 0.3 * np.sin(x / 180) * np.cos(y / 150))).astype(np.uint8)


def shake(image: np.ndarray) -> np.ndarray:
    return cv2.filter2D(image, -1, np.eye(5) / 5)


def tilted_view(board: Board, config: BoardImageConfig) -> tuple[np.ndarray, np.ndarray]:
    """A picture of the whole board, through a bent lens, and its true corners."""
    K = np.array([[[1300.0, 0, 639.5], [0, 1301.0, 479.5], [0, 0, 1]]])
    rig = Rig(
        ("one",), K, np.array([[-0.12, 0.08, 3e-4, -2e-4, 0]]), np.eye(4)[None], np.array([[1280, 960]], np.int32)
    )
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(np.array([0.3, 0.6, 0.2]))
    pose[:3, 3] = np.array([0.02, -0.03, 1.4]) - pose[:3, :3] @ board.middle
    picture = photograph_board(rig, 0, board, pose, rng=np.random.default_rng(4), config=config)
    return picture, project_world(rig, 0, transform(pose, board.corners))[0]


@pytest.mark.parametrize(
    ("config", "spoil", "legacy"),
    [
        (DEFAULT, None, False),
        (DEFAULT, None, True),
        (replace(DEFAULT, blur_px=0.4), None, False),
        (replace(DEFAULT, blur_px=1.3), None, False),
        (replace(DEFAULT, noise=6.0), None, False),
        (replace(DEFAULT, paper=140.0), None, False),
        (DEFAULT, gamma, False),
        (DEFAULT, shade, False),
        (DEFAULT, shake, False),
        (replace(DEFAULT, hands=3), None, False),
    ],
)
def test_the_fit_is_far_better_than_opencv(
    config: BoardImageConfig, spoil: Callable[[np.ndarray], np.ndarray] | None, legacy: bool
):
    board = parse_board("charuco:10x8:60:44:DICT_5X5_100" + ":legacy" * legacy)
    picture, truth = tilted_view(board, config)
    picture = spoil(picture) if spoil else picture
    (theirs, before), (ids, after) = find_corners(picture, board), detect_corners(picture, board)
    errors, start = np.linalg.norm(after - truth[ids], axis=1), np.linalg.norm(before - truth[theirs], axis=1)
    assert len(ids) >= 0.95 * len(theirs) > 20
    assert np.sqrt((errors**2).mean()) < 0.6 * np.sqrt((start**2).mean())
    assert np.abs((after - truth[ids]).mean(axis=0)).max() < 0.006
    assert errors.max() < 0.15


def test_equal_pictures_have_equal_corners():
    board = parse_board("charuco:10x8:60:44:DICT_5X5_100")
    picture, _ = tilted_view(board, DEFAULT)
    for first, second in zip(detect_corners(picture, board), detect_corners(picture.copy(), board), strict=True):
        np.testing.assert_array_equal(first, second)


def test_a_corner_that_is_covered_is_left_out():
    board = parse_board("charuco:10x8:60:44:DICT_5X5_100")
    picture, truth = tilted_view(board, replace(DEFAULT, hands=0))
    ids, _ = detect_corners(picture, board)
    victim = int(ids[len(ids) // 2])
    x, y = np.rint(truth[victim]).astype(int)
    cv2.circle(picture, (int(x) + 5, int(y)), 4, 90, -1)
    kept, pixels = detect_corners(picture, board)
    assert victim not in kept
    assert np.linalg.norm(pixels - truth[kept], axis=1).max() < 0.15


def test_an_image_without_a_board_has_no_corners():
    ids, pixels = detect_corners(np.full((240, 320), 90, np.uint8), parse_board(SPEC))
    assert ids.shape == (0,)
    assert pixels.shape == (0, 2)


@pytest.mark.parametrize("seed", [0, 1])
def test_corners_of_a_picture_are_where_they_are(seed: int):
    """Half a pixel of convention would show as a bias of 0.5; the detector's own is a thousandth."""
    rng = np.random.default_rng(seed)
    board = parse_board(SPEC)
    rig = calibration_rig(4, rng=rng)
    pool = measure_corner_errors(rig, board, wave_board(board, 14, rng=rng), rng=rng, images=5)
    errors = np.concatenate(pool)
    assert len(pool) == 5
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.015
    assert np.linalg.norm(errors, axis=1).max() < 0.1
    assert np.abs(np.median(errors, axis=0)).max() < 0.002


def test_without_noise_hands_or_blur_every_corner_is_found():
    rng = np.random.default_rng(0)
    board = parse_board("charuco:7x5:120:88:DICT_4X4_50")
    rig = calibration_rig(4, rng=rng)
    clean = BoardImageConfig(noise=0.0, hands=0)
    views = [
        (camera, pose, *visible_corners(rig, camera, board, pose))
        for pose in wave_board(board, 10, rng=rng)
        for camera in range(4)
    ]
    camera, pose, ids, pixels = max(views, key=lambda view: np.ptp(view[3], axis=0).min() if len(view[2]) else 0)
    found, places = detect_corners(photograph_board(rig, camera, board, pose, rng=rng, config=clean), board)
    np.testing.assert_array_equal(found, ids)
    assert np.linalg.norm(places - pixels, axis=1).max() < 0.05
