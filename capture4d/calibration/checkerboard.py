"""A checkerboard in an image: found whole by OpenCV, and turned so that its first square is black."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64, Int32, UInt8

from capture4d.cameras.board import Board

__all__ = ["find_checkerboard"]

_FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE
"""CALIB_CB_EXHAUSTIVE finds no more and takes five times as long where there is none; with CALIB_CB_ACCURACY OpenCV 5.0
finds a board in an image one time and not the next."""
_CLEAR, _GOES_ON = 0.9, 0.5
"""Share of the squares that are of the right shade; contrast beyond the board, in parts of its own, with which it is a
part of a larger one."""
_LONGEST_PX = 1600
"""Larger images are searched at this size; the fit of the pattern works on all of their pixels."""


def find_checkerboard(
    image: UInt8[np.ndarray, "height width"], board: Board
) -> tuple[Int32[np.ndarray, " found"], Float64[np.ndarray, "found 2"]]:
    """All corners of a checkerboard, or none if a part of it is hidden (Duda and Frese, BMVC 2018).

    What has more squares is another board, though OpenCV finds this one in it now and then.
    """
    shape = board.rows - 1, board.columns - 1
    scale = max(1.0, max(image.shape) / _LONGEST_PX)
    small = image if scale == 1 else cv2.resize(image, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
    found, corners = cv2.findChessboardCornersSB(small, shape[::-1], flags=_FLAGS)
    if not found or corners is None or corners.size != 2 * shape[0] * shape[1]:
        return np.zeros(0, np.int32), np.zeros((0, 2))
    by_axis = np.array(image.shape[::-1]) / small.shape[::-1]
    grid = (corners.reshape(*shape, 2).astype(np.float64) + 0.5) * by_axis - 0.5
    along, down = (grid[:, -1] - grid[:, 0]).sum(axis=0), (grid[-1] - grid[0]).sum(axis=0)
    if along[0] * down[1] < along[1] * down[0]:  # numbered as in a mirror
        grid = grid[:, ::-1]
    squares = _grey(image, (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4)
    contrast = _alternation(squares)
    if contrast > 0:
        grid, squares = grid[::-1, ::-1], squares[::-1, ::-1]
    if not _clear(squares) or any(
        abs(_alternation(beyond)) > _GOES_ON * abs(contrast) for beyond in _beyond(image, grid)
    ):
        return np.zeros(0, np.int32), np.zeros((0, 2))
    return np.arange(shape[0] * shape[1], dtype=np.int32), grid.reshape(-1, 2).copy()


def _alternation(squares: Float64[np.ndarray, "rows columns"]) -> float:
    """How much lighter the squares of the first one's kind are than the others."""
    even = np.indices(squares.shape).sum(axis=0) % 2 == 0
    return float(squares[even].mean() - squares[~even].mean())


def _clear(squares: Float64[np.ndarray, "rows columns"]) -> bool:
    """Whether nearly every square is of the shade of its kind; those with markers are not."""
    even = np.indices(squares.shape).sum(axis=0) % 2 == 0
    middle = (np.median(squares[even]) + np.median(squares[~even])) / 2
    return bool(((squares < middle) == even).mean() >= _CLEAR)


def _beyond(
    image: UInt8[np.ndarray, "height width"], grid: Float64[np.ndarray, "rows columns 2"]
) -> list[Float64[np.ndarray, "1 squares"]]:
    """What lies next to the outermost squares, on each side of the board."""
    sides = (grid, grid[::-1], grid.swapaxes(0, 1), grid.swapaxes(0, 1)[::-1])
    middles = [side[:2, :-1] / 2 + side[:2, 1:] / 2 for side in sides]
    return [_grey(image, 2.5 * outer[None] - 1.5 * inner[None]) for outer, inner in middles]


def _grey(
    image: UInt8[np.ndarray, "height width"], places: Float64[np.ndarray, "rows columns 2"]
) -> Float64[np.ndarray, "rows columns"]:
    columns, rows = np.rint(places).astype(int).transpose(2, 0, 1)
    height, width = image.shape
    return image[rows.clip(0, height - 1), columns.clip(0, width - 1)].astype(np.float64)
