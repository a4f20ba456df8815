"""Photographs of a calibration board, through real lenses: distortion, blur, noise, tilt, and hands in the way.

The corners of every pixel are traced to the plane of the board, through the inverse of the lens. Between them lies a
quadrilateral, and the pixel is the mean of the pattern in it, by area: the pattern is cells of one grey level between
straight lines, so nothing is sampled, and no edge is jagged. Then come a Gaussian blur for the lens, and Gaussian noise
for the sensor.
"""

from __future__ import annotations

from typing import Annotated, no_type_check

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numba import njit

from capture4d.cameras.board import Board
from capture4d.cameras.projection import camera_lens, project, transform, undistort
from capture4d.settings import NonNegative, Range, Whole, settings
from capture4d.types import Rig

__all__ = ["DEFAULT", "BoardImageConfig", "photograph_board"]

LENS_STEP = 4
"""The inverse of the lens is computed at every 4th pixel and interpolated, to within a thousandth of a pixel."""
NEAREST_M = 0.05
FAR_M = 1e6
"""Where the outermost cells of the pattern end, the background."""


Grey = Annotated[float, Range(least=0, most=255)]


@settings
class BoardImageConfig:
    """What stands between the board and the pixels."""

    blur_px: NonNegative = 0.7
    """Standard deviation of the lens's blur."""
    noise: NonNegative = 2.5
    """Standard deviation of the sensor's noise, grey levels of 255."""
    ink: Grey = 30.0
    paper: Grey = 215.0
    background: Grey = 95.0
    """Grey levels."""
    margin_m: NonNegative = 0.02
    """White border around the squares."""
    hands: Whole = 1
    """Discs that hide a part of the board's rim."""
    hand_radius_m: NonNegative = 0.08


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
        pixels = project(local, camera_lens(rig, camera))
        low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - 2, 0, (width, height))
        high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + 3, 0, (width, height))
        if (high > low).all():
            T_board_camera = np.linalg.inv(T_camera_board)
            _render(
                image[low[1] : high[1], low[0] : high[0]],
                _inverse_lens(rig, camera, low, high),
                T_board_camera,
                *_pattern(board, config, printed_side=bool(T_board_camera[2, 3] < 0)),
                hands,
                config.hand_radius_m,
                config.background,
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
    return undistort(pixels, camera_lens(rig, camera)).reshape(*u.shape, 2)


def _pattern(
    board: Board, config: BoardImageConfig, *, printed_side: bool
) -> tuple[Float64[np.ndarray, " across"], Float64[np.ndarray, " down"], Float64[np.ndarray, "rows columns"]]:
    """The sheet as cells of one grey level each: the lines between them in x and in y, metres, and the levels."""
    cells = board.cells_per_marker
    border = (board.square_m - board.marker_m) / 2
    marks = border + np.arange(cells + 1) * board.marker_m / max(cells, 1)
    within = np.concatenate([[0], marks[: 0 if board.plain else None]])
    x, y = (
        np.concatenate(
            [
                [-FAR_M, -config.margin_m],
                (np.arange(count)[:, None] * board.square_m + within).ravel(),
                [count * board.square_m, count * board.square_m + config.margin_m, FAR_M],
            ]
        )
        for count in (board.columns, board.rows)
    )
    tones = np.full((len(y) - 1, len(x) - 1), config.background)
    tones[1:-1, 1:-1] = config.paper
    if not printed_side:
        return x, y, tones
    per_square = len(within)
    squares = tones[2:-2, 2:-2].reshape(board.rows, per_square, board.columns, per_square).swapaxes(1, 2)
    squares[:] = config.ink
    if board.plain:
        squares[np.indices(squares.shape[:2]).sum(axis=0) % 2 == 1] = config.paper
    else:
        _print_markers(squares, board, config)
    tones[2:-2, 2:-2] = squares.swapaxes(1, 2).reshape(board.rows * per_square, board.columns * per_square)
    return x, y, tones


def _print_markers(
    squares: Float64[np.ndarray, "rows columns down across"], board: Board, config: BoardImageConfig
) -> None:
    """Onto squares that are all ink."""
    opencv = board.opencv()
    dictionary, cells = opencv.getDictionary(), board.cells_per_marker
    for marker, outline in zip(opencv.getIds().ravel(), opencv.getObjPoints(), strict=True):
        column, row = (np.asarray(outline)[:, :2].mean(axis=0) / board.square_m).astype(int)
        bits = dictionary.generateImageMarker(int(marker), cells) > 127
        squares[row, column] = config.paper
        squares[row, column, 1:-1, 1:-1] = np.where(bits, config.paper, config.ink)


@no_type_check  # keeps the type-checking import hook off the functions that numba compiles
@njit(cache=True)
def _render(image, lens, T_board_camera, x_lines, y_lines, tones, hands, hand, skin):
    """Mean of the pattern in every pixel of a window."""
    above, below = np.empty((image.shape[1] + 1, 2)), np.empty((image.shape[1] + 1, 2))
    quad, strip, piece, spare = np.empty((4, 2)), np.empty((8, 2)), np.empty((8, 2)), np.empty((8, 2))
    _trace(lens, T_board_camera, 0, above)
    for row in range(image.shape[0]):
        _trace(lens, T_board_camera, row + 1, below)
        for column in range(image.shape[1]):
            for axis in range(2):
                quad[0, axis], quad[1, axis] = above[column, axis], above[column + 1, axis]
                quad[3, axis], quad[2, axis] = below[column, axis], below[column + 1, axis]
            if not np.isfinite(quad).all():
                continue
            left, right = _cells(quad, 0, x_lines)
            top, bottom = _cells(quad, 1, y_lines)
            grey = tones[top, left]
            if left < right or top < bottom:
                total = whole = 0.0
                for i in range(left, right + 1):
                    count = _cut(quad, 4, 0, x_lines[i], x_lines[i + 1], strip, spare)
                    for j in range(top, bottom + 1):
                        area = _area(piece, _cut(strip, count, 1, y_lines[j], y_lines[j + 1], piece, spare))
                        total += area * tones[j, i]
                        whole += area
                grey = total / whole
            x, y, width = (quad[0, 0] + quad[2, 0]) / 2, (quad[0, 1] + quad[2, 1]) / 2, np.sqrt(_area(quad, 4))
            for k in range(len(hands)):
                inside = (hand - np.hypot(x - hands[k, 0], y - hands[k, 1])) / width
                grey += min(max(inside + 0.5, 0.0), 1.0) * (skin - grey)
            image[row, column] = grey
        above, below = below, above


@no_type_check
@njit(cache=True)
def _trace(lens, T_board_camera, row, points):
    """Where rays through the upper corners of a row of pixels meet the board; NaN where they do not, or far away."""
    rotation, origin = T_board_camera[:3, :3], T_board_camera[:3, 3]
    i = row // LENS_STEP
    a = row / LENS_STEP - i
    for column in range(len(points)):
        j = column // LENS_STEP
        b = column / LENS_STEP - j
        p, q, r, s = (1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b
        x = p * lens[i, j, 0] + q * lens[i, j + 1, 0] + r * lens[i + 1, j, 0] + s * lens[i + 1, j + 1, 0]
        y = p * lens[i, j, 1] + q * lens[i, j + 1, 1] + r * lens[i + 1, j, 1] + s * lens[i + 1, j + 1, 1]
        depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]
        reach = -origin[2] / depth if depth != 0.0 else -1.0
        for axis in range(2):
            ray = rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2]
            points[column, axis] = origin[axis] + reach * ray if 0 < reach < FAR_M / 100 else np.nan


@no_type_check
@njit(cache=True)
def _cells(quad, axis, lines):
    """First and last of the cells between lines that a quadrilateral reaches into."""
    low = min(min(quad[0, axis], quad[1, axis]), min(quad[2, axis], quad[3, axis]))
    high = max(max(quad[0, axis], quad[1, axis]), max(quad[2, axis], quad[3, axis]))
    first = np.searchsorted(lines, low, side="right") - 1
    last = first
    while lines[last + 1] <= high:
        last += 1
    return first, last


@no_type_check
@njit(cache=True)
def _cut(polygon, count, axis, low, high, out, spare):
    """The part of a convex polygon between two lines (Sutherland and Hodgman); its number of corners."""
    return _halve(spare, _halve(polygon, count, axis, low, 1.0, spare), axis, high, -1.0, out)


@no_type_check
@njit(cache=True)
def _halve(polygon, count, axis, bound, sign, out):
    kept = 0
    for k in range(count):
        after = k + 1 if k + 1 < count else 0
        depth, next_depth = sign * (polygon[k, axis] - bound), sign * (polygon[after, axis] - bound)
        if depth >= 0:
            out[kept, 0], out[kept, 1] = polygon[k, 0], polygon[k, 1]
            kept += 1
        if (depth < 0 < next_depth) or (next_depth < 0 < depth):
            share = depth / (depth - next_depth)
            for other in range(2):
                out[kept, other] = polygon[k, other] + share * (polygon[after, other] - polygon[k, other])
            kept += 1
    return kept


@no_type_check
@njit(cache=True)
def _area(polygon, count):
    doubled = 0.0
    for k in range(1, count - 1):
        ax, ay = polygon[k, 0] - polygon[0, 0], polygon[k, 1] - polygon[0, 1]
        bx, by = polygon[k + 1, 0] - polygon[0, 0], polygon[k + 1, 1] - polygon[0, 1]
        doubled += ax * by - ay * bx
    return abs(doubled) / 2
