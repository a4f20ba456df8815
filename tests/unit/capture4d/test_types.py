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
