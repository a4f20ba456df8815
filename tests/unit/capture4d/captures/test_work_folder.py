"""The body and the poses that move a template."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from capture4d.body.anny import load_anny
from capture4d.captures.capture import Capture
from capture4d.files.records import save_body, save_poses
from capture4d.types import PoseSequence


def test_poses_without_a_body_move_the_built_in_one(tmp_path: Path) -> None:
    capture, body = Capture(tmp_path, "take", 60.0, (3, 4), None), load_anny()
    assert capture.posed_body is None
    count = len(body.joint_names)
    still = np.tile(np.eye(3, dtype=np.float32), (2, count, 1, 1))
    ids = np.array([3, 4], np.int32)
    poses = PoseSequence(still, np.zeros((2, 3), np.float32), np.zeros(1, np.float32), ids, 60.0, body.joint_names)
    save_poses(tmp_path / "poses.npz", poses)
    moving = replace(capture).posed_body
    assert moving is not None
    assert moving[0].joint_names == body.joint_names
    np.testing.assert_array_equal(moving[1].frame_ids, ids)
    fewer = body.shape_directions[:3]
    save_body(tmp_path / "body.npz", replace(body, shape_directions=fewer, joint_directions=body.joint_directions[:3]))
    moving = replace(capture).posed_body
    assert moving is not None
    assert len(moving[0].shape_directions) == 3
