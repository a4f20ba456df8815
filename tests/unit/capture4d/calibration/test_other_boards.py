"""A board that is not found is named by what is in the images."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from capture4d.calibration.other_boards import what_is_shown
from capture4d.cameras.board import parse_board


def picture(path: Path, spec: str, *, mirrored: bool = False) -> Path:
    """A board as it is printed, from a little aside, amid grey."""
    board = parse_board(spec)
    if board.plain:
        squares = np.indices((board.rows, board.columns)).sum(axis=0) % 2 * 190 + 30
        sheet = np.kron(squares, np.ones((60, 60))).astype(np.uint8)
        sheet = np.pad(sheet, 30, constant_values=220)
    else:
        sheet = board.opencv().generateImage((60 * board.columns, 60 * board.rows), marginSize=20)
    height, width = sheet.shape
    ends = np.array([[60, 40], [width, 70], [width + 20, height + 40], [30, height + 20]], np.float32)
    starts = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    image = cv2.warpPerspective(
        sheet, cv2.getPerspectiveTransform(starts, ends), (width + 80, height + 80), borderValue=120
    )
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    cv2.imwrite(str(path), image[:, ::-1] if mirrored else image)
    return path


CHARUCO = "charuco:8x6:100:74:DICT_4X4_50"


@pytest.mark.parametrize(
    ("shown", "said", "advice"),
    [
        (CHARUCO, f"{CHARUCO}:legacy", f"--board {CHARUCO} would find it"),
        (f"{CHARUCO}:legacy", CHARUCO, f"--board {CHARUCO}:legacy would find it"),
        (CHARUCO, "charuco:6x8:100:74:DICT_4X4_50", f"--board {CHARUCO} would find it"),
        (f"{CHARUCO}:legacy", "charuco:6x8:100:74:DICT_4X4_50", f"--board {CHARUCO}:legacy would find it"),
        ("charuco:7x5:30:22:DICT_6X6_250", "charuco:7x5:30:22:DICT_4X4_50", "7x5:30:22:DICT_6X6_50 would find it"),
        ("charuco:9x7:30:22:DICT_APRILTAG_36h11", "charuco:9x7:30:22:DICT_5X5_50", "DICT_APRILTAG_36h11 would find it"),
        (
            "charuco:5x7:30:22:DICT_ARUCO_ORIGINAL",
            "charuco:7x5:30:22:DICT_7X7_50",
            "5x7:30:22:DICT_ARUCO_ORIGINAL",
        ),
        ("checkerboard:10x7:25", "checkerboard:9x6:25", "--board checkerboard:10x7:25 would find it"),
        ("checkerboard:9x6:25", "checkerboard:10x7:25", "--board checkerboard:9x6:25 would find it"),
        ("checkerboard:9x6:25", CHARUCO.replace("8x6", "9x6"), "--board checkerboard:9x6:100 would find it"),
        (CHARUCO, "checkerboard:9x6:25", "they show markers of DICT_4X4_1000, as a ChArUco board has; is --board"),
    ],
)
def test_what_would_find_it_is_said(tmp_path: Path, shown: str, said: str, advice: str):
    paths = [picture(tmp_path / f"{index}.png", shown) for index in range(2)]
    assert advice in what_is_shown(paths, parse_board(said))


@pytest.mark.parametrize("legacy", ["", ":legacy"])
def test_a_mirror_is_told(tmp_path: Path, legacy: str):
    path = picture(tmp_path / "x.png", CHARUCO, mirrored=True)
    advice = what_is_shown([path], parse_board(CHARUCO + legacy))
    assert advice.startswith("the images are mirrored: undo that in the camera")
    assert advice.endswith(f", and give --board {CHARUCO}") == bool(legacy)


def test_where_nothing_is_found_it_is_told_what_was_tried(tmp_path: Path):
    path = tmp_path / "x.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (240, 320), np.uint8))
    advice = what_is_shown([path], parse_board(CHARUCO))
    for word in ("in 1 of them", ":legacy and swapped counts", "other dictionaries", "in a mirror", "the one filmed?"):
        assert word in advice
