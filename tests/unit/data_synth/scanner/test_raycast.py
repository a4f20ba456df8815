"""A print is seen finer than the mesh below it, where it lies, and multiplies the colours there."""

from dataclasses import replace

import numpy as np
import pytest

from capture4d.types import Mesh, Rig
from data_synth.scanner.raycast import NOTHING, Print, Surface, SurfaceScene

SIZE = 64


@pytest.fixture
def rig() -> Rig:
    """One camera that looks down at a square metre from 2 m above."""
    K = np.array([[[60.0, 0, 31.5], [0, 60.0, 31.5], [0, 0, 1]]])
    T = np.eye(4)
    T[:3, :3], T[2, 3] = np.diag([1.0, -1.0, -1.0]), 2.0
    return Rig(("top",), K, np.zeros((1, 5)), T[None], np.array([[SIZE, SIZE]], np.int32))


@pytest.fixture
def sheet() -> Surface:
    """Two triangles, printed with a board of squares but for one corner."""
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    board = np.indices((80, 80)).sum(axis=0) // 10 % 2
    image = np.where(board[..., None] == 1, 1.0, np.array([0.2, 0.5, 0.8])).astype(np.float32)
    places = ((corners[faces][..., :2] + 0.5) * 79).astype(np.float32)
    share = np.ones((2, 3), np.float32)
    return Surface(Mesh(corners, faces), np.full((4, 3), 200, np.uint8), 1, 0.01, print=Print(image, places, share))


def test_each_pixel_shows_the_print_below_it(rig: Rig, sheet: Surface) -> None:
    bare = SurfaceScene([replace(sheet, print=None)]).view(rig, 0)
    printed = SurfaceScene([sheet]).view(rig, 0)
    assert bare is not None
    assert printed is not None
    assert sheet.print is not None
    np.testing.assert_array_equal(bare.depth, printed.depth)
    seen = printed.surface != NOTHING
    rows, columns = np.nonzero(seen)
    x = (columns + printed.origin[1] - 31.5) / 60 * 2
    y = -(rows + printed.origin[0] - 31.5) / 60 * 2
    column, row = np.rint((np.column_stack([x, y]) + 0.5) * 79).astype(int).clip(0, 79).T
    ink = printed.colours[seen] / bare.colours[seen]
    agree = np.abs(ink - sheet.print.image[row, column]).max(axis=1) < 0.05
    assert agree.mean() > 0.75  # squares are 4 to 5 pixels wide, and blend at their edges
    assert len(np.unique(np.round(ink[:, 0], 1))) > 3


def test_what_is_not_printed_keeps_its_colour(rig: Rig, sheet: Surface) -> None:
    assert sheet.print is not None
    none = replace(sheet, print=replace(sheet.print, share=np.zeros((2, 3), np.float32)))
    bare = replace(sheet, print=None)
    views = [SurfaceScene([each]).view(rig, 0) for each in (none, bare)]
    assert views[0] is not None
    assert views[1] is not None
    np.testing.assert_array_equal(views[0].colours, views[1].colours)
