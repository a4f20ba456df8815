"""Photographs of a calibration board, through real lenses: distortion, blur, noise, tilt, and hands in the way.

Every pixel is the mean of a grid of rays through the inverse of the lens, each tested against the exact pattern, which
has no texels; then a Gaussian blur for the lens, and Gaussian noise for the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float64, Int32, UInt8
from numba import njit

from capture4d.calibration_board import Board
from capture4d.projection import project, transform, undistort
from capture4d.types import Rig

__all__ = ["DEFAULT", "BoardImageConfig", "photograph_board"]

LENS_STEP = 4
"""The inverse of the lens is computed at every 4th pixel and interpolated, to within a thousandth of a pixel."""
NEAREST_M = 0.05
RAYS, RAY_STEP = 21, 13
"""Averaged in a pixel, on a Fibonacci lattice."""
ROW_SHIFT, COLUMN_SHIFT = (0.7548776662, 0.5698402910), (0.4142135624, 0.7320508076)
"""Of the lattice, in x and in y, from row to row and from column to column: irrational, so that no edge runs along the
rays. With the same rays in every pixel, edges along rows or diagonals would move corners by hundredths of a pixel."""
BLACK = -1
"""In the table of squares: no marker, all ink."""


@dataclass(frozen=True, slots=True)
class BoardImageConfig:
    """What stands between the board and the pixels."""

    blur_px: float = 0.7
    """Standard deviation of the lens's blur."""
    noise: float = 2.5
    """Standard deviation of the sensor's noise, grey levels of 255."""
    ink: float = 30.0
    paper: float = 215.0
    background: float = 95.0
    """Grey levels."""
    margin_m: float = 0.02
    """White border around the squares."""
    hands: int = 1
    """Discs that hide a part of the board's rim."""
    hand_radius_m: float = 0.08


DEFAULT = BoardImageConfig()


def photograph_board(
    rig: Rig,
    camera: int,
    board: Board,
    T_world_board: Float64[np.ndarray, "4 4"],
    *,
    rng: np.random.Generator,
    config: BoardImageConfig = DEFAULT,
) -> UInt8[np.ndarray, "height width"]:
    """The image of one camera. The back of the board is blank paper."""
    width, height = (int(size) for size in rig.image_sizes[camera])
    image = np.full((height, width), config.background, np.float32)
    T_camera_board = rig.T_camera_world[camera] @ T_world_board
    size = np.array([board.columns, board.rows]) * board.square_m
    hands = _on_the_rim(size, config.hands, rng)
    local = transform(T_camera_board, _rim(size, config.margin_m))
    if local[:, 2].min() > NEAREST_M:
        pixels = project(local, rig.intrinsics[camera], rig.distortion[camera])
        low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - 2, 0, (width, height))
        high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + 3, 0, (width, height))
        if (high > low).all():
            squares, bits = _pattern(board)
            _render(
                image[low[1] : high[1], low[0] : high[0]],
                _inverse_lens(rig, camera, low, high),
                np.linalg.inv(T_camera_board),
                squares,
                bits,
                np.array([board.square_m, board.marker_m, config.margin_m, config.hand_radius_m]),
                np.array([config.ink, config.paper, config.background]),
                hands,
            )
    blurred = cv2.GaussianBlur(image, (0, 0), config.blur_px) if config.blur_px > 0 else image
    noisy = blurred + rng.normal(0, config.noise, blurred.shape).astype(np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _rim(size: np.ndarray, margin: float) -> Float64[np.ndarray, "points 3"]:
    """Points along the edge of the sheet."""
    along = np.linspace(0, 1, 9)
    unit = np.concatenate([np.stack([along, 0 * along + end], 1) for end in (0, 1)])
    unit = np.concatenate([unit, unit[:, ::-1]])
    return np.concatenate([unit * (size + 2 * margin) - margin, np.zeros((len(unit), 1))], axis=1)


def _on_the_rim(size: np.ndarray, count: int, rng: np.random.Generator) -> Float64[np.ndarray, "hands 2"]:
    places = rng.uniform(0, 1, (count, 2))
    side = rng.integers(0, 2, count)
    places[np.arange(count), side] = rng.integers(0, 2, count)
    return places * size


def _inverse_lens(rig: Rig, camera: int, low: np.ndarray, high: np.ndarray) -> Float64[np.ndarray, "rows columns 2"]:
    """Normalised coordinates at every LENS_STEP-th pixel of a window, from half a pixel outside it."""
    columns, rows = (np.arange(0, length + 2 * LENS_STEP, LENS_STEP) - 0.5 for length in high - low)
    u, v = np.meshgrid(columns + low[0], rows + low[1])
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    return undistort(pixels, rig.intrinsics[camera], rig.distortion[camera]).reshape(*u.shape, 2)


def _pattern(board: Board) -> tuple[Int32[np.ndarray, "rows columns"], UInt8[np.ndarray, "markers cells cells"]]:
    """Which marker lies in each square, or BLACK; and the cells of each marker, 1 for paper."""
    opencv = board.opencv()
    dictionary = opencv.getDictionary()
    cells = dictionary.markerSize + 2
    squares = np.full((board.rows, board.columns), BLACK, np.int32)
    markers = opencv.getIds().ravel()
    for marker, outline in zip(markers, opencv.getObjPoints(), strict=True):
        column, row = (np.asarray(outline)[:, :2].mean(axis=0) / board.square_m).astype(int)
        squares[row, column] = marker
    bits = np.stack([dictionary.generateImageMarker(int(marker), cells) > 127 for marker in markers])
    return squares, bits.astype(np.uint8)


@no_type_check  # keeps the type-checking import hook off the function that numba compiles
@njit(cache=True)
def _render(image, lens, T_board_camera, squares, bits, lengths, greys, hands):
    """Average RAYS in every pixel of a window."""
    square, marker, margin, hand = lengths
    ink, paper, skin = greys
    rows, columns = squares.shape
    cells = bits.shape[1]
    border = (square - marker) / 2
    rotation, origin = T_board_camera[:3, :3], T_board_camera[:3, 3]
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            total = 0.0
            shift_x = row * ROW_SHIFT[0] + column * COLUMN_SHIFT[0]
            shift_y = row * ROW_SHIFT[1] + column * COLUMN_SHIFT[1]
            for ray in range(RAYS):
                u = (column + (ray / RAYS + shift_x) % 1.0) / LENS_STEP
                v = (row + (ray * RAY_STEP / RAYS + shift_y) % 1.0) / LENS_STEP
                i, j = int(v), int(u)
                a, b = v - i, u - j
                x = (1 - a) * ((1 - b) * lens[i, j, 0] + b * lens[i, j + 1, 0]) + a * (
                    (1 - b) * lens[i + 1, j, 0] + b * lens[i + 1, j + 1, 0]
                )
                y = (1 - a) * ((1 - b) * lens[i, j, 1] + b * lens[i, j + 1, 1]) + a * (
                    (1 - b) * lens[i + 1, j, 1] + b * lens[i + 1, j + 1, 1]
                )
                depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]
                reach = -origin[2] / depth if depth != 0.0 else -1.0
                if reach <= 0:
                    total += image[row, column]
                    continue
                px = origin[0] + reach * (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2])
                py = origin[1] + reach * (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2])
                hidden = False
                for k in range(len(hands)):
                    if (px - hands[k, 0]) ** 2 + (py - hands[k, 1]) ** 2 < hand * hand:
                        hidden = True
                if hidden:
                    total += skin
                    continue
                c, r = int(np.floor(px / square)), int(np.floor(py / square))
                if c < 0 or r < 0 or c >= columns or r >= rows:
                    outside = px < -margin or py < -margin or px > columns * square + margin
                    if outside or py > rows * square + margin:
                        total += image[row, column]
                    else:
                        total += paper
                    continue
                if depth < 0:  # the blank back
                    total += paper
                    continue
                if squares[r, c] == BLACK:
                    total += ink
                    continue
                s, t = (px - c * square - border) / marker, (py - r * square - border) / marker
                if s < 0 or t < 0 or s >= 1 or t >= 1 or bits[squares[r, c], int(t * cells), int(s * cells)]:
                    total += paper
                else:
                    total += ink
            image[row, column] = total / RAYS
