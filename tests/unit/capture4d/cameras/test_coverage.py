"""What a rig sees, on rigs for which the answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.cameras.coverage import best_share, camera_counts, rig_middle
from capture4d.types import Rig
from tests.shapes import ring


def test_cameras_count_what_lies_in_their_images():
    T = np.eye(4)
    rig = Rig(
        ("a",),
        np.array([[[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]]),
        np.zeros((1, 5)),
        T[None],
        np.array([[101, 101]], np.int32),
    )
    points = np.array([[0.0, 0, 1], [0.49, 0, 1], [0.6, 0, 1], [0, 0, -1]])
    np.testing.assert_array_equal(camera_counts(rig, points), [1, 1, 0, 0])


@pytest.mark.parametrize("shift", [(0.0, 0, 0), (0.3, 0, -1.1)])
def test_the_middle_of_a_rig_is_where_its_cameras_look(shift: tuple[float, float, float]):
    rig = ring()
    rig.T_camera_world[:, :3, 3] -= rig.T_camera_world[:, :3, :3] @ np.array(shift)
    np.testing.assert_allclose(rig_middle(rig), np.array([0, 1.2, 0]) + shift, atol=1e-9)
    one = Rig(("a",), rig.intrinsics[:1], rig.distortion[:1], rig.T_camera_world[:1], rig.image_sizes[:1])
    np.testing.assert_allclose(rig_middle(one), one.centres[0], atol=1e-9)


def test_in_the_middle_of_a_ring_every_camera_sees():
    """Wherever the subject stands, as long as it stands as high: that is what it is compared with."""
    points = np.array([0, 1.2, 0]) + 0.05 * np.random.default_rng(0).standard_normal((50, 3))
    assert best_share(ring(), points) == best_share(ring(), points + np.array([5.0, 0, -3.0])) == 1.0
    assert best_share(ring(), points + np.array([0, 5.0, 0])) < 0.5
