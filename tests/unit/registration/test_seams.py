"""How two segments go together, and the frames between them."""

from itertools import pairwise

import numpy as np
import pytest

from registration.seams import blended, faded, seam_of, share_of_later, step_mm


@pytest.fixture
def apart() -> tuple[np.ndarray, np.ndarray]:
    """Two versions of a frame, 2 mm from each other everywhere."""
    first = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    return first, first + np.array([0.002, 0, 0], np.float32)


def test_one_fades_into_the_other_evenly(apart) -> None:
    first, second = apart
    count = faded(24)
    assert count == 16
    way = [first, *(blended(first, second, share_of_later(at, count)) for at in range(count)), second]
    steps = [1e3 * np.linalg.norm(after - before, axis=1).mean() for before, after in pairwise(way)]
    np.testing.assert_allclose(steps, step_mm(first, second, count), rtol=1e-2)
    assert sum(steps) == pytest.approx(2.0, rel=1e-2)


def test_a_segment_that_is_too_far_off_is_to_be_registered_anew(apart) -> None:
    first, second = apart
    near = seam_of([(first, True)] * 4, [(second, True)] * 4, largest_step_mm=0.41)
    assert near.step_mm == pytest.approx(0.4, rel=1e-3)
    assert not near.continues
    assert seam_of([(first, True)] * 4, [(second, True)] * 4, largest_step_mm=0.39).continues


def test_frames_that_failed_say_nothing_and_nothing_is_built_upon_them(apart) -> None:
    first, second = apart
    far = second + np.float32(1)
    before, after = [(first, True), (far, False)], [(second, True), (second, True)]
    assert seam_of(before, after, largest_step_mm=1.0).step_mm == pytest.approx(2 / 3, rel=1e-3)
    nothing = seam_of([(first, False)] * 2, after, largest_step_mm=1.0)
    assert (nothing.step_mm, nothing.continues) == (None, False)
    assert seam_of(before, [(second, False)] * 2, largest_step_mm=1.0).continues, "the earlier one has found its way"


def test_without_an_overlap_there_is_nothing_to_compare() -> None:
    assert not seam_of([], [], largest_step_mm=0.5).continues
    assert faded(0) == 0
