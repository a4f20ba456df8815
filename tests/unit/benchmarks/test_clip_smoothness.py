"""The benchmark of smooth motions: paths end where they should, and flicker does not fall with the rate."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.clip_smoothness import path_between, second_differences_mm
from capture4d.types import PoseSequence


def test_a_path_goes_from_one_pose_to_the_other_and_rests_at_both():
    ends = Rotation.from_rotvec([[0, 0, 0], [0.2, 0, 0], [0, 1.2, 0], [0.2, 0, 0]])
    matrices = ends.as_matrix().reshape(2, 2, 3, 3).astype(np.float32)
    poses = PoseSequence(matrices, np.zeros((2, 3), np.float32), np.zeros(1, np.float32), np.array([1, 2], np.int32),
                         60.0, ("root", "arm"))  # fmt: skip
    path = path_between(poses, poses.rotations, 31)
    np.testing.assert_allclose(path.rotations[[0, -1]], matrices, atol=1e-6)
    angles = Rotation.from_matrix(path.rotations[:, 0]).magnitude()
    assert angles[15] == pytest.approx(0.6, abs=1e-5)
    steps = np.diff(angles)
    assert steps[0] < 0.1 * steps[15]
    assert steps[-1] < 0.1 * steps[15]
    np.testing.assert_allclose(path.rotations[:, 1], np.broadcast_to(matrices[0, 1], (31, 3, 3)), atol=1e-6)


def test_twice_the_rate_quarters_the_differences_of_smooth_motion_alone():
    rng = np.random.default_rng(0)

    def moved(count: int, noise: float) -> np.ndarray:
        times = np.linspace(0, 1, count)[:, None, None]
        return np.sin(2 * times + np.arange(5)[:, None]) * np.ones(3) + noise * rng.normal(size=(count, 5, 3))

    smooth = second_differences_mm(moved(121, 0.0)) / second_differences_mm(moved(61, 0.0))
    assert smooth == pytest.approx(0.25, abs=0.01)
    flickering = second_differences_mm(moved(121, 0.1)) / second_differences_mm(moved(61, 0.1))
    assert flickering == pytest.approx(1.0, abs=0.15)
    # 0, 1, 0, 1 mm
    to_and_fro = np.zeros((4, 1, 3))
    to_and_fro[1::2, 0, 2] = 1e-3
    assert second_differences_mm(to_and_fro) == pytest.approx(2.0)
