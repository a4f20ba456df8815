"""The board's geometry is OpenCV's, and its corners are found where they are."""

import numpy as np
import pytest

from capture4d.calibration_board import parse_board
from capture4d.corner_detection import detect_corners
from capture4d.errors import InputError
from data_synth.board_images import BoardImageConfig, photograph_board
from data_synth.board_views import calibration_rig, measure_corner_errors, visible_corners, wave_board

SPEC = "charuco:14x10:60:44:DICT_5X5_100"


def test_corners_are_opencvs():
    board = parse_board(SPEC)
    assert (board.columns, board.rows, board.square_m, board.marker_m) == (14, 10, 0.06, 0.044)
    np.testing.assert_allclose(board.corners, board.opencv().getChessboardCorners(), atol=1e-7)
    assert parse_board(f"{SPEC}:legacy").opencv().getLegacyPattern()


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("", "expected a board such as charuco:14x10"),
        ("checker:14x10:60:44:DICT_5X5_100", "expected a board such as charuco:14x10"),
        ("charuco:14:60:44:DICT_5X5_100", "expected a board such as"),
        ("charuco:14x10:60:DICT_5X5_100", "expected a board such as"),
        ("charuco:14x10:sixty:44:DICT_5X5_100", "expected a board such as"),
        ("charuco:2x10:60:44:DICT_5X5_100", "at least 3x3 squares, found 2x10"),
        ("charuco:14x10:44:60:DICT_5X5_100", "a marker smaller than its square, found 60 and 44 mm"),
        ("charuco:14x10:nan:44:DICT_5X5_100", "a marker smaller than its square"),
        ("charuco:14x10:60:44:DICT_5X5_99", "expected a dictionary of DICT_4X4_100"),
        ("charuco:14x10:60:44:DICT_4X4_50", "14x10 squares need 70 markers, DICT_4X4_50 has 50"),
    ],
)
def test_a_bad_board_is_one_line(spec: str, said: str):
    with pytest.raises(InputError) as caught:
        parse_board(spec)
    assert str(caught.value).startswith("--board: ")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_image_without_a_board_has_no_corners():
    ids, pixels = detect_corners(np.full((240, 320), 90, np.uint8), parse_board(SPEC))
    assert ids.shape == (0,)
    assert pixels.shape == (0, 2)


@pytest.mark.parametrize("seed", [0, 1])
def test_corners_of_a_picture_are_where_they_are(seed: int):
    """Half a pixel of convention would show as a bias of 0.5; the detector's own is a hundredth."""
    rng = np.random.default_rng(seed)
    board = parse_board(SPEC)
    rig = calibration_rig(4, rng=rng)
    pool = measure_corner_errors(rig, board, wave_board(board, 14, rng=rng), rng=rng, images=5)
    errors = np.concatenate(pool)
    assert len(pool) == 5
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.08
    assert np.abs(np.median(errors, axis=0)).max() < 0.015


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
    assert np.linalg.norm(places - pixels, axis=1).max() < 0.3
