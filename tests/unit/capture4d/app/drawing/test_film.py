"""Films: consecutive frames, each whole in the animation and on the slider."""

import base64
import io

import numpy as np
from PIL import Image

from capture4d.app.drawing.film import CHECK_M, checks, make_film, rows_around, tiled
from capture4d.app.drawing.panels import WEBP
from tests.shapes import tube


def test_rows_are_consecutive_inside_the_take_and_hold_the_worst():
    for total in (1, 5, 48, 200):
        for worst in {0, total // 3, total - 1}:
            rows = rows_around(total, 48, worst)
            assert len(rows) == min(total, 48)
            assert worst in rows
            assert 0 <= rows[0] <= rows[-1] < total
    assert rows_around(200, 48, 100) == range(76, 124)


def test_an_animation_holds_every_frame_in_order():
    pictures = [np.full((16, 24, 3), 40 * index, np.uint8) for index in range(6)]
    film = make_film("a film", pictures, [f"frame {index}" for index in range(6)], seconds=0.1, note="")
    with Image.open(io.BytesIO(base64.b64decode(film.moving.removeprefix(WEBP)))) as moving:
        assert moving.n_frames == 6
        for index in range(6):
            moving.seek(index)
            assert abs(np.asarray(moving.convert("RGB")).mean() - 40 * index) < 4
            assert moving.info["duration"] == 100
    assert len(film.stills) == len(film.captions) == 6
    with Image.open(io.BytesIO(base64.b64decode(film.stills[3].removeprefix(WEBP)))) as still:
        assert abs(np.asarray(still).mean() - 120) < 4


def test_fast_takes_are_slowed_down_to_what_one_sees():
    film = make_film(
        "", [np.zeros((8, 8, 3), np.uint8), np.full((8, 8, 3), 255, np.uint8)], ["", ""], seconds=0, note=""
    )
    with Image.open(io.BytesIO(base64.b64decode(film.moving.removeprefix(WEBP)))) as moving:
        moving.seek(1)
        moving.load()
        assert moving.info["duration"] == 40


def test_pictures_are_laid_out_row_by_row():
    picture = [np.full((2, 3, 3), value, np.uint8) for value in range(4)]
    whole = tiled([picture[:2], picture[2:]])
    assert whole.shape == (4, 6, 3)
    np.testing.assert_array_equal(whole[::2, ::3, 0], [[0, 1], [2, 3]])


def test_checks_change_across_a_cell_and_stay_with_the_cloth():
    mesh = tube(40, 60, 0.2, 0.6)
    colours = checks(mesh)
    assert len(np.unique(colours, axis=0)) == 2
    cells = np.floor(mesh.vertices / CHECK_M + 1e-6).astype(int).sum(axis=1)
    for parity in (0, 1):
        assert len(np.unique(colours[cells % 2 == parity], axis=0)) == 1
