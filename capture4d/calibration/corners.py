"""Corners of a board in an image: found by OpenCV, placed by fitting the printed pattern.

OpenCV's gradients around a corner (cornerSubPix) are pulled by markers that reach into their window, and leave most of
the edges unused. Here each corner is the shift of a patch of the board's known pattern, as it should look through lens
and sensor, that explains the pixels around it best, as Lucas and Kanade did (An Iterative Image Registration Technique,
IJCAI 1981). How the patch lies in the image is taken from all corners of the view: a homography after a polynomial, for
the lens, fitted robustly. Blur and shading are unknowns of each patch.

The patch is the part of the pattern that is the same upside down: edges of squares, and the black rim of markers but
not their bits; a checkerboard has edges alone. So a wrong guess of the blur, of how far ink has bled, or of the
sensor's response does not move it.

Letters: q board coordinates, metres; x pixels; d the shift, s the standard deviation of the blur, pixels; P the pattern
through lens and sensor, 0 ink and 1 paper; u, v squares from a corner. Grey levels are ink (x) + contrast (x) P, both
linear in x.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64, UInt8
from scipy.special import ndtr

from capture4d.calibration.checkerboard import find_checkerboard
from capture4d.cameras.board import Board

__all__ = ["detect_corners", "find_corners"]

REACH_PX = 12
"""Half the side of a patch."""
PADDING_PX = 5
"""Around a patch, what blur and shift bring into it."""
SAMPLES = 2
"""Of the pattern along a pixel."""
STEPS = 4
"""Of Gauss and Newton; the first finds the shading alone."""
PATCH = np.arange(-REACH_PX, REACH_PX + 1)
SAMPLE = (np.arange(2 * SAMPLES * (REACH_PX + PADDING_PX) + SAMPLES) + 0.5) / SAMPLES - 0.5 - REACH_PX - PADDING_PX
"""Where the pixels of a patch, and the samples of its pattern, lie about the middle: in x and in y."""
SLOPES = [1, 3]
"""Rows of y and of x in a polynomial of degree two, as `_monomials` orders it."""
FIRST_BLUR_PX = 0.7
BLUR_RANGE_PX = (0.25, 2.5)
BLUR_STEP_PX = (-0.3, 0.5)
LARGEST_SHIFT_PX = 2.0
DEGREES = ((30, 3), (15, 2))
"""Corners it takes for a lens polynomial of a degree."""
MISFIT = 3.0
"""Residual of a patch, in medians of the view, beyond which something covers it."""
ROBUST_STEPS = 8


def detect_corners(
    image: UInt8[np.ndarray, "height width"], board: Board
) -> tuple[Int32[np.ndarray, " found"], Float64[np.ndarray, "found 2"]]:
    """Find the corners of a board in a grey image.

    Views that are too small to calibrate with keep the corners of OpenCV.

    Returns:
        ids: corner numbers, ascending; empty where no board is seen.
        pixels: centres at integers.
    """
    ids, pixels = find_corners(image, board)
    if not board.is_fixed_by(ids):
        return ids, pixels
    points = board.corners[ids, :2]
    view = _fit_map(pixels, points)
    if view is None or not np.median(np.abs(view.to_image(points) - pixels)) < LARGEST_SHIFT_PX:
        return ids, pixels
    pixels, good = _fit_patches(image, board, ids, view)
    return ids[good], pixels[good]


def find_corners(
    image: UInt8[np.ndarray, "height width"], board: Board
) -> tuple[Int32[np.ndarray, " found"], Float64[np.ndarray, "found 2"]]:
    """The same by OpenCV alone, a few hundredths of a pixel off."""
    if board.plain:
        return find_checkerboard(image, board)
    corners, ids, _, _ = _detector(board).detectBoard(image)
    if ids is None or not len(ids):
        return np.zeros(0, np.int32), np.zeros((0, 2))
    order = np.argsort(ids.ravel(), kind="stable")
    return ids.ravel()[order].astype(np.int32), corners.reshape(-1, 2)[order].astype(np.float64)


@functools.lru_cache(maxsize=4)
def _detector(board: Board) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.CharucoDetector(board.opencv())
    detector.setDetectorParameters(parameters)
    return detector


# --- where the board lies in the image -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _ViewMap:
    """Pixels to the board: q ~ homography (x + polynomial(x))."""

    homography: Float64[np.ndarray, "3 3"]
    coefficients: Float64[np.ndarray, "terms 2"]
    centre: Float64[np.ndarray, " 2"]
    scale: float
    degree: int

    def straighten(self, pixels: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, "points 2"]:
        return pixels + _monomials((pixels - self.centre) / self.scale, self.degree) @ self.coefficients

    def to_board(self, pixels: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, "points 2"]:
        return _through(self.homography, self.straighten(pixels))

    def to_image(self, points: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, "points 2"]:
        straight = _through(np.linalg.inv(self.homography), points)
        pixels = straight
        for _ in range(ROBUST_STEPS):
            pixels = pixels + straight - self.straighten(pixels)
        return pixels


def _fit_map(pixels: Float64[np.ndarray, "corners 2"], points: Float64[np.ndarray, "corners 2"]) -> _ViewMap | None:
    """The map that most corners agree on; None if there is none."""
    homography, _ = cv2.findHomography(pixels, points, cv2.LMEDS)
    if homography is None or np.linalg.matrix_rank(homography) < 3:
        return None
    centre = pixels.mean(axis=0)
    scale = float(np.abs(pixels - centre).max())
    degree = next((degree for least, degree in DEGREES if len(pixels) >= least), 0)
    terms = _monomials((pixels - centre) / scale, degree)
    bend = _through(np.linalg.inv(homography), points) - pixels
    weights = np.ones(len(pixels))
    coefficients = np.zeros((terms.shape[1], 2))
    for _ in range(ROBUST_STEPS):
        root = np.sqrt(weights)[:, None]
        coefficients = np.linalg.lstsq(root * terms, root * bend, rcond=None)[0]
        squared = ((bend - terms @ coefficients) ** 2).sum(axis=1)
        weights = 1 / (1 + squared / max(2 * float(np.median(squared)), 1e-12))
    return _ViewMap(homography, coefficients, centre, scale, degree)


def _monomials(x: Float64[np.ndarray, "points 2"], degree: int) -> Float64[np.ndarray, "points terms"]:
    return np.stack([x[:, 0] ** i * x[:, 1] ** j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)


def _through(
    homography: Float64[np.ndarray, "3 3"], points: Float64[np.ndarray, "points 2"]
) -> Float64[np.ndarray, "points 2"]:
    moved = points @ homography[:, :2].T + homography[:, 2]
    return moved[:, :2] / moved[:, 2:]


# --- the pattern around each corner ----------------------------------------------------------------------------------


def _fit_patches(
    image: UInt8[np.ndarray, "height width"],
    board: Board,
    ids: Int32[np.ndarray, " corners"],
    view: _ViewMap,
) -> tuple[Float64[np.ndarray, "corners 2"], Bool[np.ndarray, " corners"]]:
    """Pixels of the corners, and which of them look like the pattern."""
    predicted = view.to_image(board.corners[ids, :2])
    middle = np.rint(predicted).astype(int)
    samples, known = _draw_patches(board, ids, view, middle)
    grey, inside = _cut_patches(image, middle)
    weights = (known & inside).astype(np.float64)
    x, y = np.meshgrid(PATCH / REACH_PX, PATCH / REACH_PX)
    linear = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
    ink = np.broadcast_to(linear, (len(ids), *linear.shape))
    contrast, residuals = np.zeros((len(ids), 3)), grey
    shift, blur = np.zeros((len(ids), 2)), np.full(len(ids), FIRST_BLUR_PX)
    for _ in range(STEPS):
        P, slopes = _seen(samples, shift, blur)
        design = np.concatenate([ink, P[:, :, None] * linear, slopes * (contrast @ linear.T)[:, :, None]], axis=2)
        solution = _least_squares(design, grey, weights)
        residuals = grey - (design @ solution[:, :, None])[:, :, 0]
        contrast = solution[:, 3:6]
        shift = (shift + solution[:, 6:8]).clip(-LARGEST_SHIFT_PX, LARGEST_SHIFT_PX)
        blur = (blur + solution[:, 8].clip(*BLUR_STEP_PX)).clip(*BLUR_RANGE_PX)
    misfit = np.sqrt((weights * residuals**2).sum(axis=1) / weights.sum(axis=1).clip(1))
    good = (misfit <= MISFIT * np.median(misfit)) & (contrast[:, 0] > 0)
    good &= np.abs(shift).max(axis=1) < LARGEST_SHIFT_PX
    return predicted + shift, good


def _cut_patches(
    image: UInt8[np.ndarray, "height width"], middle: Int64[np.ndarray, "corners 2"]
) -> tuple[Float64[np.ndarray, "corners pixels"], Bool[np.ndarray, "corners pixels"]]:
    """Grey levels, and which lie inside the image."""
    height, width = image.shape
    rows, columns = middle[:, 1, None, None] + PATCH[:, None], middle[:, 0, None, None] + PATCH
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    grey = image[rows.clip(0, height - 1), columns.clip(0, width - 1)]
    return grey.reshape(len(middle), -1).astype(np.float64), inside.reshape(len(middle), -1)


def _draw_patches(
    board: Board, ids: Int32[np.ndarray, " corners"], view: _ViewMap, middle: Int64[np.ndarray, "corners 2"]
) -> tuple[Float64[np.ndarray, "corners rows columns"], Bool[np.ndarray, "corners pixels"]]:
    """Samples of the sharp pattern around each corner, and the pixels in which it is known."""
    knots = _grid(np.linspace(SAMPLE[0], SAMPLE[-1], 5))
    q = view.to_board((middle[:, None] + knots).reshape(-1, 2)).reshape(len(ids), -1, 2)
    squares = (q - board.corners[ids, None, :2]) / board.square_m
    taylor = np.linalg.pinv(_monomials(knots, 2)) @ squares
    marker = board.marker_m / board.square_m
    gap, rim = (1 - marker) / 2, 0.0 if board.plain else marker / board.cells_per_marker

    u, v = np.moveaxis(_monomials(_grid(SAMPLE), 2) @ taylor, -1, 0)
    across, down = np.abs(taylor[:, SLOPES]).sum(axis=1).T[:, :, None] / SAMPLES
    right, below = _above(u, across), _above(v, down)
    far_right, far_below = _above(u - gap, across), _above(v - gap, down)
    far_left, far_above = _above(-u - gap, across), _above(-v - gap, down)
    falling = right * below + (1 - right) * (1 - below)  # the squares top left and bottom right
    paper_falls = falling - far_right * far_below - far_left * far_above
    paper_rises = 1 - falling - far_right * far_above - far_left * far_below
    samples = np.where(board.paper_falls(ids)[:, None], paper_falls, paper_rises)

    apart = np.abs(_monomials(_grid(PATCH), 2) @ taylor)
    known = (apart.min(axis=2) < gap + rim / 2) & (apart.max(axis=2) < 0.5)
    return samples.reshape(len(ids), len(SAMPLE), len(SAMPLE)), known


def _seen(
    samples: Float64[np.ndarray, "corners rows columns"],
    shift: Float64[np.ndarray, "corners 2"],
    blur: Float64[np.ndarray, " corners"],
) -> tuple[Float64[np.ndarray, "corners pixels"], Float64[np.ndarray, "corners pixels 3"]]:
    """P, and its derivatives by d and s: samples under a Gaussian that is spread over the square of each pixel."""
    apart = PATCH[:, None] - SAMPLE - shift.T[:, :, None, None]
    s = blur[:, None, None]
    above, below = (apart + 0.5) / s, (apart - 0.5) / s
    bell_above, bell_below = (np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi) for z in (above, below))
    kernel = (ndtr(above) - ndtr(below)) / SAMPLES
    by_shift = (bell_below - bell_above) / (s * SAMPLES)
    by_blur = (below * bell_below - above * bell_above) / (s * SAMPLES)
    rows, rows_by_shift, rows_by_blur = (k[1] @ samples for k in (kernel, by_shift, by_blur))
    columns, columns_by_shift, columns_by_blur = (np.swapaxes(k[0], 1, 2) for k in (kernel, by_shift, by_blur))
    slopes = [rows @ columns_by_shift, rows_by_shift @ columns, rows_by_blur @ columns + rows @ columns_by_blur]
    pixels = len(samples), PATCH.size**2
    return (rows @ columns).reshape(pixels), np.stack([slope.reshape(pixels) for slope in slopes], axis=-1)


def _least_squares(
    design: Float64[np.ndarray, "corners pixels unknowns"],
    target: Float64[np.ndarray, "corners pixels"],
    weights: Float64[np.ndarray, "corners pixels"],
) -> Float64[np.ndarray, "corners unknowns"]:
    """What does not show in the target stays zero."""
    weighted = np.swapaxes(design * weights[:, :, None], 1, 2)
    normal = weighted @ design
    size = np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-300
    return np.linalg.solve(normal + 1e-9 * size * np.eye(normal.shape[1]), weighted @ target[:, :, None])[:, :, 0]


def _grid(along: np.ndarray) -> Float64[np.ndarray, "points 2"]:
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2).astype(np.float64)


def _above(x: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Share of a sample of some width that lies above zero."""
    return (x / width + 0.5).clip(0, 1)
