"""Which board a folder of images shows, where the one that was named is in none of them.

A few images are searched for boards that are mistaken for each other: printed by an older OpenCV, columns for rows,
inner corners for squares, another dictionary, no markers at all; and for all of these in a mirror. A board counts if
its corners lie as the corners of a plane do.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from capture4d.calibration.board_images import read_grey
from capture4d.calibration.corners import find_corners
from capture4d.cameras.board import Board, format_board

__all__ = ["what_is_shown"]

IMAGES, SECONDS = 3, 12.0
"""How many images are searched, and for how long."""
LONGEST_PX, LONGEST_PLAIN_PX = 1600, 800
"""At what size, for markers and without."""
MARKERS = 50
"""Of a dictionary that are looked for where a plain board was expected."""
LEAST_MARKERS, TELLING_MARKERS = 4, 6
"""Of a dictionary in an image, for boards with it to be tried, and for it to be named."""
AGREEING, REACH_PX = 0.8, 4.0
"""Share of the corners that have to lie on a plane, to within some pixels."""
_FAMILIES = (
    *(f"DICT_{bits}X{bits}_1000" for bits in (4, 5, 6, 7)),
    "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36h12",
    *(f"DICT_APRILTAG_{name}" for name in ("16h5", "25h9", "36h10", "36h11")),
)
"""Dictionaries that no other holds."""


def what_is_shown(paths: Sequence[Path], board: Board) -> str:
    """What to say of a board that is not found: which --board would find it, or what was tried."""
    deadline = time.monotonic() + SECONDS
    chosen = [paths[place] for place in np.unique(np.linspace(0, len(paths) - 1, IMAGES).astype(int))]
    images = [_small(read_grey(path), LONGEST_PX) for path in chosen]
    marked = [family for family in _FAMILIES if _most_markers(images, family, MARKERS) >= TELLING_MARKERS]
    if board.plain and marked:
        return f"they show markers of {marked[0]}, as a ChArUco board has; is --board the one filmed?"
    tried = dict[str, None]()
    for mirrored in (False,) if board.plain else (False, True):  # a checkerboard in a mirror is a checkerboard
        seen = [np.ascontiguousarray(image[:, ::-1]) for image in images] if mirrored else images
        for kind, others in _others(board, seen):
            scores = {other: sum(_score(image, other, deadline) for image in seen) for other in others}
            best = max(others, key=lambda other: scores[other])
            if scores[best] > 0:
                return _advice(board, best, mirrored=mirrored)
            if time.monotonic() < deadline:
                tried[f"{kind} in a mirror" if mirrored else kind] = None
    return f"in {len(images)} of them {', '.join(tried)} were tried as well; is --board the one filmed?"


def _advice(board: Board, shown: Board, *, mirrored: bool) -> str:
    spec = f"--board {format_board(shown)}"
    if not mirrored:
        return f"{spec} would find it"
    return f"the images are mirrored: undo that in the camera{'' if shown == board else f', and give {spec}'}"


def _small(image: UInt8[np.ndarray, "height width"], longest: int) -> UInt8[np.ndarray, "rows columns"]:
    scale = longest / max(image.shape)
    return image if scale >= 1 else cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _others(board: Board, images: Sequence[UInt8[np.ndarray, "height width"]]) -> Iterator[tuple[str, Sequence[Board]]]:
    """Boards that may have been meant, the likeliest first, by what is different; the board itself is among them."""
    if board.plain:
        yield "other counts", _counted_otherwise(board)
        return
    yield ":legacy and swapped counts", _printed_otherwise(board)
    needed = board.columns * board.rows // 2
    counts = {_smallest(family, needed): _most_markers(images, family, needed) for family in _FAMILIES}
    likeliest = sorted(counts, key=lambda name: -counts[name])[:2]
    likely = [replace(board, dictionary=name) for name in likeliest if counts[name] >= LEAST_MARKERS]
    yield "other dictionaries", [other for found in likely for other in _printed_otherwise(found)] or [board]
    if not likely:
        yield "checkerboards", _counted_otherwise(Board(board.columns, board.rows, board.square_m))


def _printed_otherwise(board: Board) -> list[Board]:
    """With columns and rows as they are and swapped, new and legacy, where that is a difference."""
    swapped = replace(board, columns=board.rows, rows=board.columns)
    every = [board, replace(board, legacy=not board.legacy), swapped, replace(swapped, legacy=not board.legacy)]
    return [other for other in every if other.legacy == board.legacy or other.rows % 2 == 0]


def _counted_otherwise(board: Board) -> list[Board]:
    """Inner corners taken for squares, and the other way round; swapped is the same board."""
    more = replace(board, columns=board.columns + 1, rows=board.rows + 1)
    fewer = replace(board, columns=board.columns - 1, rows=board.rows - 1)
    longer = [replace(board, columns=board.columns + 1), replace(board, rows=board.rows + 1)]
    usable = [board, more, fewer, *longer]
    return [other for other in usable if (other.columns + other.rows) % 2 and min(other.columns, other.rows) >= 4]


def _most_markers(images: Sequence[UInt8[np.ndarray, "height width"]], dictionary: str, first: int) -> int:
    """How many of the first markers of a dictionary, which are a board's, the image shows that shows most."""
    whole = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    part = cv2.aruco.Dictionary(whole.bytesList[:first].copy(), whole.markerSize, whole.maxCorrectionBits)
    found = [cv2.aruco.ArucoDetector(part).detectMarkers(image)[1] for image in images]
    return max((0 if ids is None else len(np.unique(ids)) for ids in found), default=0)


def _smallest(family: str, count: int) -> str:
    """The smallest dictionary that holds so many of the first markers of a family."""
    if not family.endswith("_1000"):
        return family
    sizes = (50, 100, 250, 1000)
    return family.removesuffix("1000") + str(next(size for size in sizes if count <= size or size == sizes[-1]))


def _score(image: UInt8[np.ndarray, "height width"], board: Board, deadline: float) -> int:
    """How many corners of a board an image shows where they can be; none if they contradict each other."""
    if time.monotonic() > deadline:
        return 0
    try:
        ids, pixels = find_corners(_small(image, LONGEST_PLAIN_PX) if board.plain else image, board)
    except cv2.error:
        return 0
    if not board.is_fixed_by(ids):
        return 0
    _, agree = cv2.findHomography(board.corners[ids, :2], pixels, cv2.RANSAC, REACH_PX)
    agreeing = 0 if agree is None else int(np.count_nonzero(agree))
    return agreeing if agreeing >= AGREEING * len(ids) else 0
