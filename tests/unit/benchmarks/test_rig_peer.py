"""OpenCV as a peer: right where corners are, and told nothing of the truth."""

import numpy as np
import pytest

from benchmarks.rig_peer import calibrate_with_opencv, find_corners_with_opencv
from benchmarks.simulated_views import calibration_rig, simulate_views
from capture4d.calibration.adjustment import RigEstimate
from capture4d.calibration.report import rig_difference
from capture4d.cameras.board import BoardView, parse_board
from capture4d.types import Rig
from data_synth.board.views import wave_board

BOARD = parse_board("charuco:14x10:60:44:DICT_5X5_100")
ARC_DEG = 110.0


@pytest.fixture(scope="module")
def seen() -> tuple[Rig, list[BoardView]]:
    rng = np.random.default_rng(5)
    rig = calibration_rig(4, rng=rng, arc_deg=ARC_DEG)
    poses = wave_board(BOARD, 10, rng=rng, arc_deg=ARC_DEG)
    return rig, simulate_views(rig, BOARD, poses, errors=[np.zeros((1, 2))], rng=rng)


def centres_apart_mm(rig: Rig, truth: Rig) -> float:
    found, known = (RigEstimate(each, np.zeros((0, 4, 4)), BOARD.corners) for each in (rig, truth))
    return 1e3 * float(rig_difference(found, known)[0].max())


def test_exact_corners_give_the_exact_rig(seen: tuple[Rig, list[BoardView]]):
    truth, views = seen
    rig = calibrate_with_opencv(views, BOARD, names=truth.names, image_sizes=truth.image_sizes)
    assert centres_apart_mm(rig, truth) < 0.01
    np.testing.assert_allclose(rig.intrinsics, truth.intrinsics, atol=0.01)


def test_the_chain_reaches_cameras_that_share_no_pose(seen: tuple[Rig, list[BoardView]]):
    truth, views = seen
    first = {view.pose for view in views if view.camera == 0}
    split = [view for view in views if view.camera != 3 or view.pose not in first or view.pose >= 6]
    split = [view for view in split if view.camera != 0 or view.pose < 6]
    assert not {v.pose for v in split if v.camera == 0} & {v.pose for v in split if v.camera == 3}
    rig = calibrate_with_opencv(split, BOARD, names=truth.names, image_sizes=truth.image_sizes)
    assert centres_apart_mm(rig, truth) < 0.02


def test_an_empty_image_has_no_corners():
    ids, pixels = find_corners_with_opencv(np.full((200, 300), 128, np.uint8), BOARD)
    assert len(ids) == len(pixels) == 0
