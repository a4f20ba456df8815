"""Who moved? Found when it is half a millimetre, and nobody else blamed."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.simulated_views import calibration_rig, simulate_views
from capture4d.calibration.check import check_rig
from capture4d.calibration.rig import Calibration, calibrate_rig
from capture4d.cameras.board import BoardView, parse_board
from capture4d.cameras.projection import rotation_from_vector
from capture4d.errors import InputError
from capture4d.types import Rig
from data_synth.board.views import wave_board

BOARD = parse_board("charuco:14x10:60:44:DICT_5X5_100")
CAMERAS, POSES = 5, 24


@pytest.fixture(scope="module")
def calibrated() -> tuple[Rig, Calibration]:
    rng = np.random.default_rng(0)
    rig = calibration_rig(CAMERAS, rng=rng, arc_deg=100)
    poses = wave_board(BOARD, POSES, rng=rng, arc_deg=100)
    views = simulate_views(rig, BOARD, poses, errors=[0.035 * rng.normal(size=(2000, 2))], rng=rng)
    return rig, calibrate_rig(views, BOARD, names=rig.names, image_sizes=rig.image_sizes, poses=POSES)


def look(rig: Rig, seed: int, *, poses: int = 1, least: int = 4) -> list[BoardView]:
    rng = np.random.default_rng(seed)
    while True:
        placed = wave_board(BOARD, poses, rng=rng, arc_deg=100)
        views = simulate_views(rig, BOARD, placed, errors=[0.035 * rng.normal(size=(2000, 2))], rng=rng)
        if len({view.camera for view in views}) >= least:
            return views


def moved(rig: Rig, camera: int, *, turn_deg: float = 0.0, shift_m: float = 0.0, seed: int = 0) -> Rig:
    axis = np.random.default_rng(seed).normal(size=3)
    axis /= np.linalg.norm(axis)
    movement = np.eye(4)
    movement[:3, :3] = rotation_from_vector(np.radians(turn_deg) * axis)
    movement[:3, 3] = shift_m * axis
    T = rig.T_camera_world.copy()
    T[camera] = movement @ T[camera]
    return replace(rig, T_camera_world=T)


def blamed(calibration: Calibration, views: list[BoardView]) -> list[str]:
    checks = check_rig(calibration.estimate.rig, views, BOARD, covariance=calibration.covariance)
    return [check.name for check in checks if check.verdict == "moved"]


@pytest.mark.parametrize("seed", range(4))
def test_an_untouched_rig_is_not_blamed(calibrated: tuple[Rig, Calibration], seed: int):
    rig, calibration = calibrated
    assert blamed(calibration, look(rig, seed)) == []


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("turn_deg", "shift_m"), [(0.02, 0.0), (0.0, 0.5e-3), (3.0, 0.03)])
def test_the_one_that_moved_is_named(calibrated: tuple[Rig, Calibration], seed: int, turn_deg: float, shift_m: float):
    rig, calibration = calibrated
    camera = look(rig, seed)[seed % 3].camera
    after = moved(rig, camera, turn_deg=turn_deg, shift_m=shift_m, seed=seed)
    assert blamed(calibration, look(after, seed)) == [rig.names[camera]]


def test_how_far_it_moved_is_measured(calibrated: tuple[Rig, Calibration]):
    rig, calibration = calibrated
    views = look(moved(rig, 2, shift_m=5e-3), 1, poses=2)
    check = check_rig(calibration.estimate.rig, views, BOARD, covariance=calibration.covariance)[2]
    assert abs(check.translation_mm - 5) < 4 * check.translation_sigma_mm < 2
    assert check.rotation_deg < 4 * check.rotation_sigma_deg


def test_wrong_corners_are_no_movement(calibrated: tuple[Rig, Calibration]):
    rig, calibration = calibrated
    views = look(rig, 3)
    rng = np.random.default_rng(0)
    spoilt = [
        replace(view, pixels=view.pixels + 6.0 * (rng.random((len(view.ids), 1)) < 0.03) * [1, -1]) for view in views
    ]
    assert blamed(calibration, spoilt) == []


def test_who_sees_no_board_is_not_judged(calibrated: tuple[Rig, Calibration]):
    rig, calibration = calibrated
    views = [view for view in look(rig, 0) if view.camera != 1]
    checks = check_rig(calibration.estimate.rig, views, BOARD)
    assert checks[1].verdict == "unseen"
    assert np.isnan(checks[1].score)


def test_two_cameras_cannot_tell(calibrated: tuple[Rig, Calibration]):
    rig, calibration = calibrated
    with pytest.raises(InputError, match="a pose of the board that 3 cameras see"):
        check_rig(calibration.estimate.rig, look(rig, 0)[:2], BOARD)
