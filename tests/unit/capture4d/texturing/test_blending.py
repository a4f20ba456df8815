"""What most frames say holds; holes take what is near on the cloth."""

import numpy as np

from capture4d.texturing.blending import blend, fill_holes, spread_out


def frame(levels: np.ndarray, weight: int) -> np.ndarray:
    return np.concatenate([levels, np.full((len(levels), 1), weight)], axis=1).astype(np.uint8)


def test_frames_that_agree_keep_their_levels_and_one_that_does_not_hardly_counts():
    rng = np.random.default_rng(0)
    levels = rng.integers(20, 236, (70_000, 3))
    good = [frame(levels + rng.integers(-2, 3, levels.shape), 200) for _ in range(6)]
    colours, seen, spread = blend([*good, frame(255 - levels, 200)])
    assert seen.all()
    assert np.abs(colours - levels).max() < 3.5
    assert np.abs(colours - levels).mean() < 1
    assert np.median(spread) < 30


def test_a_frame_of_no_weight_says_nothing():
    levels = np.full((5, 3), 90)
    colours, seen, _ = blend([frame(levels, 0), frame(levels + 50, 3)])
    assert np.abs(colours - 140).max() < 0.1
    assert seen.all()
    assert not blend([frame(levels, 0)])[1].any()


def test_holes_take_the_colours_around_them_on_the_cloth_not_in_the_picture():
    places = np.stack([np.arange(50) * 0.001, np.zeros(50), np.zeros(50)], axis=1)[::-1].copy()
    colours = np.where(np.arange(50)[:, None] < 25, 200.0, 40.0).repeat(3, axis=1).astype(np.float32)
    wanted, seen = colours.copy(), np.ones(50, bool)
    seen[[3, 4, 45]] = False
    colours[~seen] = 0
    fill_holes(colours, seen, places)
    assert np.abs(colours - wanted).max() < 1e-3


def test_texels_without_cloth_have_the_nearest_colour():
    picture = np.zeros((20, 30, 3), np.uint8)
    known = np.zeros((20, 30), bool)
    known[5, 5], known[15, 25] = True, True
    picture[5, 5], picture[15, 25] = 10, 250
    full = spread_out(picture, known)
    assert (full[0, 0] == 10).all()
    assert (full[19, 29] == 250).all()
    assert set(np.unique(full)) == {10, 250}
