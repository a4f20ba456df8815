"""The ChArUco board: its geometry, and its corners in an image.

Board axes: the origin at the outer corner of the first square, x along the rows, y down the columns, z away from who
looks at the printed side. Corners are numbered row by row, as OpenCV does.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, Int32, UInt8

from capture4d.errors import InputError

__all__ = ["Board", "BoardView", "detect_corners", "parse_board"]

EXAMPLE = "charuco:14x10:60:44:DICT_5X5_100"
FINE_WINDOW = 5
"""Half the side, pixels, of the square in which a corner is refined at most."""


@dataclass(frozen=True, slots=True)
class Board:
    """A flat ChArUco board."""

    columns: int
    """Squares along x."""
    rows: int
    """Squares along y."""
    square_m: float
    marker_m: float
    dictionary: str
    """OpenCV's name of the markers, such as DICT_5X5_100."""
    legacy: bool = False
    """Printed by OpenCV before 4.6, with a marker in the first square if the number of rows is even."""

    @property
    def corners(self) -> Float64[np.ndarray, "corners 3"]:
        """Inner corners of the squares, metres."""
        y, x = np.mgrid[1 : self.rows, 1 : self.columns]
        flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        return flat * self.square_m

    @property
    def middle(self) -> Float64[np.ndarray, " 3"]:
        return np.array([self.columns * self.square_m / 2, self.rows * self.square_m / 2, 0.0])

    def opencv(self) -> Any:
        """The cv2.aruco.CharucoBoard."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, dictionary)
        board.setLegacyPattern(self.legacy)
        return board


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """The corners of the board that one camera sees at one pose."""

    camera: int
    pose: int
    ids: Int32[np.ndarray, " found"]
    pixels: Float64[np.ndarray, "found 2"]
    """Centres at integers."""

    def __post_init__(self) -> None:
        if len(self.ids) != len(self.pixels) or not np.isfinite(self.pixels).all():
            raise InputError(f"BoardView: expected a finite pixel for each of {len(self.ids)} corners")


def parse_board(spec: str) -> Board:
    """A board from `charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY[:legacy]`.

    Raises:
        InputError: malformed, impossible, or with a dictionary that OpenCV lacks or that has too few markers.
    """
    kind, *parts = spec.split(":")
    legacy = parts[-1:] == ["legacy"]
    if legacy:
        parts.pop()
    try:
        size, square, marker, dictionary = parts
        columns, rows = (int(count) for count in size.lower().split("x"))
        square_m, marker_m = float(square) / 1e3, float(marker) / 1e3
    except ValueError:
        kind, columns, rows, square_m, marker_m, dictionary = "", 0, 0, 0.0, 0.0, ""
    if kind != "charuco":
        raise InputError(f"--board: expected a board such as {EXAMPLE}, found '{spec}'")
    if min(columns, rows) < 3:
        raise InputError(f"--board: expected at least 3x3 squares, found {columns}x{rows}")
    if not 0 < marker_m < square_m < float("inf"):
        raise InputError(
            f"--board: expected a marker smaller than its square, found {1e3 * marker_m:g} and {1e3 * square_m:g} mm"
        )
    names = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
    if dictionary not in names:
        raise InputError(f"--board: expected a dictionary of {', '.join(names)}, found '{dictionary}'")
    held = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)).bytesList)
    if held < columns * rows // 2:
        raise InputError(
            f"--board: {columns}x{rows} squares need {columns * rows // 2} markers, {dictionary} has {held}"
        )
    return Board(columns, rows, square_m, marker_m, dictionary, legacy)


def detect_corners(
    image: UInt8[np.ndarray, "height width"], board: Board
) -> tuple[Int32[np.ndarray, " found"], Float64[np.ndarray, "found 2"]]:
    """Find the corners of a board in a grey image.

    Returns:
        ids: corner numbers, ascending; empty where no board is seen.
        pixels: centres at integers.
    """
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
