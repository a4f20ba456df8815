"""The board, ChArUco or a plain checkerboard: its geometry, and what a camera sees of it.

Board axes: the origin at the outer corner of the first square, x along the rows, y down the columns, z away from who
looks at the printed side. The first square of a checkerboard is black. Corners are numbered row by row, as OpenCV does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int32

from capture4d.errors import InputError

__all__ = ["LEAST_CORNERS", "Board", "BoardView", "format_board", "markers_in", "parse_board"]

EXAMPLE, PLAIN_EXAMPLE = "charuco:14x10:60:44:DICT_5X5_100", "checkerboard:10x7:25"
LEAST_CORNERS = 8
"""Of a view that takes part."""


@dataclass(frozen=True, slots=True)
class Board:
    """A flat board of black and white squares, with markers in the white ones if it has a dictionary."""

    columns: int
    """Squares along x."""
    rows: int
    """Squares along y."""
    square_m: float
    marker_m: float = 0.0
    dictionary: str = ""
    """OpenCV's name of the markers, such as DICT_5X5_100; none on a plain checkerboard."""
    legacy: bool = False
    """Printed by OpenCV before 4.6, with a marker in the first square if the number of rows is even."""

    @property
    def plain(self) -> bool:
        """Whether it is a checkerboard without markers."""
        return not self.dictionary

    @property
    def corners(self) -> Float64[np.ndarray, "corners 3"]:
        """Inner corners of the squares, metres."""
        y, x = np.mgrid[1 : self.rows, 1 : self.columns]
        flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        return flat * self.square_m

    @property
    def middle(self) -> Float64[np.ndarray, " 3"]:
        return np.array([self.columns * self.square_m / 2, self.rows * self.square_m / 2, 0.0])

    @property
    def cells_per_marker(self) -> int:
        """Along a side, with the black rim."""
        return 0 if self.plain else int(self.opencv().getDictionary().markerSize) + 2

    def paper_falls(self, ids: Int32[np.ndarray, " found"]) -> Bool[np.ndarray, " found"]:
        """Whether the white squares at a corner are those top left and bottom right."""
        inverted = self.legacy and self.rows % 2 == 0
        return (ids % (self.columns - 1) + ids // (self.columns - 1) + inverted) % 2 == 1

    def is_fixed_by(self, ids: Int32[np.ndarray, " found"]) -> bool:
        """Whether a view of these corners tells where the board is: enough, and not all on one line of squares."""
        return len(ids) >= LEAST_CORNERS and bool((np.ptp(self.corners[ids], axis=0)[:2] > 1.5 * self.square_m).all())

    def opencv(self) -> Any:
        """The cv2.aruco.CharucoBoard; a checkerboard has none."""
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
    """A board from its description, which counts squares.

    Args:
        spec: charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY[:legacy] or checkerboard:COLUMNSxROWS:SQUARE_MM.
    Raises:
        InputError: malformed, impossible, with a dictionary that OpenCV lacks or that has too few markers, or a
            checkerboard that looks the same upside down.
    """
    kind, *parts = spec.split(":")
    legacy = kind == "charuco" and parts[-1:] == ["legacy"]
    if legacy:
        parts.pop()
    try:
        size, square, *markers = parts
        columns, rows = (int(count) for count in size.lower().split("x"))
        square_m = float(square) / 1e3
        marker, dictionary = markers if kind == "charuco" else (0.0, *markers, "")
        marker_m = float(marker) / 1e3
    except ValueError:
        kind, columns, rows, square_m, marker_m, dictionary = "", 0, 0, 0.0, 0.0, ""
    if kind == "checkerboard":
        return _checkerboard(columns, rows, square_m)
    if kind != "charuco":
        raise InputError(f"--board: expected a board such as {EXAMPLE} or {PLAIN_EXAMPLE}, found '{spec}'")
    if min(columns, rows) < 3:
        raise InputError(f"--board: expected at least 3x3 squares, found {columns}x{rows}")
    if not 0 < marker_m < square_m < float("inf"):
        raise InputError(
            f"--board: expected a marker smaller than its square, found {1e3 * marker_m:g} and {1e3 * square_m:g} mm"
        )
    names = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
    if dictionary not in names:
        raise InputError(f"--board: expected a dictionary of {', '.join(names)}, found '{dictionary}'")
    held = markers_in(dictionary)
    if held < columns * rows // 2:
        raise InputError(
            f"--board: {columns}x{rows} squares need {columns * rows // 2} markers, {dictionary} has {held}"
        )
    return Board(columns, rows, square_m, marker_m, dictionary, legacy)


def _checkerboard(columns: int, rows: int, square_m: float) -> Board:
    if min(columns, rows) < 4:
        raise InputError(f"--board: expected at least 4x4 squares of a checkerboard, found {columns}x{rows}")
    if not 0 < square_m < float("inf"):
        raise InputError(f"--board: expected the size of a square, found {1e3 * square_m:g} mm")
    if (columns + rows) % 2 == 0:
        raise InputError(
            "--board: expected a checkerboard with an odd and an even number of squares, for another looks the same "
            f"upside down, and cameras take it for two; found {columns}x{rows}"
        )
    return Board(columns, rows, square_m)


def format_board(board: Board) -> str:
    """What `parse_board` makes the board of."""
    size = f"{board.columns}x{board.rows}:{1e3 * board.square_m:.10g}"
    if board.plain:
        return f"checkerboard:{size}"
    return f"charuco:{size}:{1e3 * board.marker_m:.10g}:{board.dictionary}{':legacy' * board.legacy}"


def markers_in(dictionary: str) -> int:
    """How many markers one of OpenCV's dictionaries has."""
    return len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)).bytesList)
