"""The board's geometry is OpenCV's."""

import numpy as np
import pytest

from capture4d.cameras.board import Board, format_board, parse_board
from capture4d.errors import InputError

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
        ("checkerboard:10x7", "expected a board such as charuco:14x10"),
        ("checkerboard:10x7:25:20", "expected a board such as"),
        ("checkerboard:10x7:25:legacy", "expected a board such as"),
        ("checkerboard:10x:25", "checkerboard:10x7:25, found 'checkerboard:10x:25'"),
        ("checkerboard:10x3:25", "at least 4x4 squares of a checkerboard, found 10x3"),
        ("checkerboard:10x7:0", "the size of a square, found 0 mm"),
        ("checkerboard:10x7:inf", "the size of a square, found inf mm"),
        ("checkerboard:10x8:25", "an odd and an even number of squares, for another looks the same upside down"),
        ("checkerboard:9x7:25", "and cameras take it for two; found 9x7"),
        ("charuco:14x10:60:44:DICT_4X4_50", "14x10 squares need 70 markers, DICT_4X4_50 has 50"),
    ],
)
def test_a_bad_board_is_one_line(spec: str, said: str):
    with pytest.raises(InputError) as caught:
        parse_board(spec)
    assert str(caught.value).startswith("--board: ")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("rows", [6, 7])
@pytest.mark.parametrize("legacy", [False, True])
def test_white_squares_are_opencvs(rows: int, legacy: bool):
    """Markers lie in white squares; the one top left of a corner is white if paper falls."""
    board = Board(8, rows, 0.06, 0.044, "DICT_4X4_50", legacy)
    middles = [np.asarray(outline)[:, :2].mean(axis=0) / board.square_m for outline in board.opencv().getObjPoints()]
    white = {(int(column), int(row)) for column, row in middles}
    ids = np.arange(len(board.corners), dtype=np.int32)
    top_left = [(int(corner % 7), int(corner // 7)) for corner in ids]
    np.testing.assert_array_equal(board.paper_falls(ids), [square in white for square in top_left])
    assert board.cells_per_marker == 6


@pytest.mark.parametrize(
    "spec", [SPEC, f"{SPEC}:legacy", "checkerboard:10x7:25", "charuco:5x7:12.5:9.25:DICT_APRILTAG_36h11"]
)
def test_a_board_is_written_as_it_is_read(spec: str):
    assert format_board(parse_board(spec)) == spec


def test_a_checkerboard_has_the_corners_of_a_board_with_markers():
    plain, marked = parse_board("checkerboard:10x7:25"), parse_board("charuco:10x7:25:20:DICT_4X4_50")
    np.testing.assert_array_equal(plain.corners, marked.corners)
    ids = np.arange(len(plain.corners), dtype=np.int32)
    np.testing.assert_array_equal(plain.paper_falls(ids), marked.paper_falls(ids))
    assert plain.plain
    assert not marked.plain


def test_corners_on_a_line_do_not_fix_a_board():
    board = parse_board(SPEC)
    ids = np.arange(26, dtype=np.int32)
    assert not board.is_fixed_by(ids[:13])
    assert not board.is_fixed_by(ids)
    assert board.is_fixed_by(np.append(ids, 26).astype(np.int32))
    assert not board.is_fixed_by(np.array([0, 14, 28], np.int32))
