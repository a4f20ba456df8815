"""Coefficients between the frames that a regressor answered."""

import numpy as np
import pytest

from retarget.animation.frame_rates import coefficients_at, seconds


def test_known_frames_stay_and_nothing_lies_beyond_the_ends() -> None:
    known = np.array([0.0, 0.05, 0.1, 0.2])
    said = np.random.default_rng(0).standard_normal((4, 3)).astype(np.float32)
    np.testing.assert_allclose(coefficients_at(said, known, known), said, atol=1e-6)
    found = coefficients_at(said, known, np.array([0.0, 0.2, 0.25]))
    np.testing.assert_allclose(found[1:], np.stack([said[-1]] * 2), atol=1e-6)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_short_motions_are_straight_lines(frames: int) -> None:
    known = np.arange(frames) / 20
    found = coefficients_at(np.arange(frames, dtype=np.float32)[:, None], known, np.arange(frames * 3 - 2) / 60)
    np.testing.assert_allclose(found[:, 0], np.arange(frames * 3 - 2) / 3, atol=1e-6)


def test_smooth_motion_is_met_better_than_by_straight_lines() -> None:
    known, wanted = np.arange(41) / 20, np.arange(121) / 60
    true = np.sin(2 * np.pi * 1.5 * wanted)
    said = np.sin(2 * np.pi * 1.5 * known).astype(np.float32)[:, None]
    error = np.abs(coefficients_at(said, known, wanted)[:, 0] - true)
    straight = np.abs(np.interp(wanted, known, said[:, 0]) - true)
    assert error.max() < 0.5 * straight.max()
    assert error[12:-12].max() < 0.1 * straight[12:-12].max()


def test_seconds_count_from_the_first_frame(motion) -> None:
    poses = motion(4, 0, 50.0)
    np.testing.assert_allclose(seconds(poses), np.arange(4) / 50)
