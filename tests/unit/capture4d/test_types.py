"""What the values that pass between stages tell about themselves."""

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.types import PoseSequence


def motion(frame_ids: list[int]) -> PoseSequence:
    count = len(frame_ids)
    rotations = np.tile(np.eye(3, dtype=np.float32), (count, 1, 1, 1))
    still, shape = np.zeros((count, 3), np.float32), np.zeros(1, np.float32)
    return PoseSequence(rotations, still, shape, np.array(frame_ids, np.int32), 60.0, ("root",))


def test_a_frame_has_one_row_in_a_motion() -> None:
    assert [motion([9, 4, 7]).row(frame_id) for frame_id in (9, 4, 7)] == [0, 1, 2]
    with pytest.raises(InputError, match="expected a pose for frame 5, found frames 9 to 7"):
        motion([9, 4, 7]).row(5)
    with pytest.raises(InputError, match="expected a pose for frame 5, found no frames"):
        motion([]).row(5)


def test_poses_of_some_frames_are_theirs_in_their_order() -> None:
    ids = np.array([3, 5, 9], np.int32)
    rotations = (
        np.tile(np.eye(3, dtype=np.float32), (3, 2, 1, 1)) * np.arange(1, 4, dtype=np.float32)[:, None, None, None]
    )
    places = np.arange(9, dtype=np.float32).reshape(3, 3)
    poses = PoseSequence(rotations, places, np.zeros(1, np.float32), ids, 60.0, ("root", "elbow"))
    some = poses.of_frames(np.array([9, 3], np.int32))
    assert some.frame_ids.tolist() == [9, 3]
    np.testing.assert_array_equal(some.rotations, rotations[[2, 0]])
    np.testing.assert_array_equal(some.translations, places[[2, 0]])
    assert (some.fps, some.joint_names) == (poses.fps, poses.joint_names)
    with pytest.raises(InputError, match="found none for frame 4"):
        poses.of_frames(np.array([3, 4], np.int32))
