"""Calibration of simulated rigs: exact without noise, as good as predicted with it, and plain about what is missing."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.simulated_views import calibration_rig, simulate_views
from capture4d.calibration.adjustment import RigEstimate, adjust_rig, view_residuals
from capture4d.calibration.check import check_rig
from capture4d.calibration.config import CalibrationConfig
from capture4d.calibration.report import calibration_report, coverage_grid, rig_difference, rigid_alignment
from capture4d.calibration.rig import Calibration, calibrate_rig
from capture4d.calibration.uncertainty import centre_sigma_m, fit_board, noise_of, robust_scale
from capture4d.cameras.board import Board, BoardView, parse_board
from capture4d.cameras.projection import rotation_from_vector, transform
from capture4d.errors import InputError
from capture4d.types import Rig
from data_synth.board.views import wave_board

BOARD = parse_board("charuco:10x8:80:60:DICT_5X5_100")
POSES = 16


def scene(seed: int, noise_px: float, *, cameras: int = 4) -> tuple[Rig, np.ndarray, list[BoardView]]:
    rng = np.random.default_rng(seed)
    rig = calibration_rig(cameras, rng=rng, arc_deg=100)
    poses = wave_board(BOARD, POSES, rng=rng, arc_deg=100)
    errors = [noise_px * rng.normal(size=(2000, 2))]
    return rig, poses, simulate_views(rig, BOARD, poses, errors=errors, rng=rng)


def calibrated(rig: Rig, views: list[BoardView], board: Board = BOARD, floor: int | None = None) -> Calibration:
    return calibrate_rig(views, board, names=rig.names, image_sizes=rig.image_sizes, poses=POSES, floor=floor)


def test_without_noise_the_rig_is_found_exactly():
    rig, poses, views = scene(0, 0.0)
    found = calibrated(rig, views).estimate
    distances, angles = rig_difference(found, RigEstimate(rig, poses, BOARD.corners))
    assert distances.max() < 1e-6
    assert angles.max() < 1e-5
    np.testing.assert_allclose(found.rig.intrinsics, rig.intrinsics, atol=1e-2)
    np.testing.assert_allclose(found.rig.distortion, rig.distortion, atol=1e-4)
    assert max(np.abs(view_residuals(found, view)).max() for view in views) < 2e-3


def test_errors_are_as_large_as_predicted():
    """Root mean square of normalised errors of the camera centres, over rigs."""
    ratios = []
    for seed in range(4):
        rig, poses, views = scene(seed, 0.05)
        calibration = calibrated(rig, views)
        distances, _ = rig_difference(calibration.estimate, RigEstimate(rig, poses, BOARD.corners))
        ratios.append((distances**2).sum() / (centre_sigma_m(calibration.covariance) ** 2).sum())
        assert abs(calibration.noise_px / 0.05 - 1) < 0.1
        assert distances.max() < 1e-3
    assert 0.5 < np.sqrt(np.mean(ratios)) < 1.6


def test_wrong_corners_hardly_matter():
    rig, poses, views = scene(1, 0.04)
    truth = RigEstimate(rig, poses, BOARD.corners)
    rng = np.random.default_rng(0)
    spoilt = [
        replace(
            view, pixels=view.pixels + 8 * rng.normal(size=(len(view.ids), 2)) * (rng.random((len(view.ids), 1)) < 0.02)
        )
        for view in views
    ]
    clean, _ = rig_difference(calibrated(rig, views).estimate, truth)
    robust, _ = rig_difference(calibrated(rig, spoilt).estimate, truth)
    assert robust.max() < 2 * clean.max()


def test_equal_input_gives_equal_output():
    """Bit for bit, or a rig.json would change when nothing else did."""
    rig, _, views = scene(2, 0.04)
    first, second = (calibrated(rig, views) for _ in range(2))
    for name in ("T_camera_world", "intrinsics", "distortion"):
        np.testing.assert_array_equal(getattr(first.estimate.rig, name), getattr(second.estimate.rig, name))
    np.testing.assert_array_equal(first.covariance, second.covariance)


def test_the_world_is_level():
    rig, _, views = scene(3, 0.04)
    auto = calibrated(rig, views).estimate
    up = -auto.rig.T_camera_world[:, 1, :3].mean(axis=0)
    np.testing.assert_allclose(up / np.linalg.norm(up), [0, 1, 0], atol=1e-9)
    assert auto.rig.centres[0, 2] > 0
    assert abs(auto.rig.centres[0, 0]) < 1e-9
    floor = views[0].pose
    lying = calibrated(rig, views, floor=floor).estimate
    corners = transform(lying.T_world_board[floor], BOARD.corners)
    np.testing.assert_allclose(corners[:, 1], 0, atol=1e-12)
    np.testing.assert_allclose(corners[0], [0.08, 0, 0.08], atol=1e-12)
    facing = lying.T_world_board[floor, :3, 2] @ (lying.rig.centres[views[0].camera] - corners.mean(axis=0))
    assert facing < 0
    assert lying.rig.centres[views[0].camera, 1] > 0, "the camera sees the printed side, from above the floor"


def test_cameras_that_share_no_view_are_named():
    rig, _, views = scene(0, 0.04)
    apart = [view for view in views if (view.camera < 2) == (view.pose < POSES // 2)]
    with pytest.raises(InputError, match=r"separate ones: cam0\d, cam0\d \| cam0\d, cam0\d"):
        calibrated(rig, apart)


def test_too_little_to_see_is_named():
    rig, _, views = scene(0, 0.04)
    with pytest.raises(InputError, match="found it nowhere"):
        calibrated(rig, [])
    with pytest.raises(InputError, match="found none of cam02"):
        calibrated(rig, [view for view in views if view.camera != 2])
    of_one = [view for view in views if view.camera == 1]
    with pytest.raises(InputError, match=r"at least 3 poses with the board per camera, found cam01 \(2\)"):
        calibrated(rig, [view for view in views if view.camera != 1] + of_one[:2])
    few = [BoardView(view.camera, view.pose, view.ids[:5], view.pixels[:5]) for view in views]
    with pytest.raises(InputError, match="found it nowhere"):
        calibrated(rig, few)


def test_a_bent_board_shows_in_the_flatness():
    rig, poses, _ = scene(0, 0.0)
    bent = BOARD.corners.copy()
    bent[:, 2] = 1e-3 * np.sin(np.pi * bent[:, 0] / (BOARD.columns * BOARD.square_m))
    rng = np.random.default_rng(0)

    class Bent(Board):
        corners = bent

    warped = Bent(BOARD.columns, BOARD.rows, BOARD.square_m, BOARD.marker_m, BOARD.dictionary)
    views = simulate_views(rig, warped, poses, errors=[0.03 * rng.normal(size=(500, 2))], rng=rng)
    config = CalibrationConfig(held_out=0)
    names = [f"{pose:03d}" for pose in range(POSES)]
    report = calibration_report(calibrated(rig, views), BOARD, pose_names=names, config=config)
    assert report["flatness"]["out_of_plane_max_mm"] > 0.3
    assert report["hold_out"] == []
    straight = scene(0, 0.03)[2]
    report = calibration_report(calibrated(rig, straight), BOARD, pose_names=names, config=config)
    assert report["flatness"]["out_of_plane_max_mm"] < 0.1


def test_the_report_tells_what_to_film_next():
    rig, _, views = scene(1, 0.04)
    few = [view for view in views if view.camera == 3][:4]
    worse = [view for view in views if view.camera != 3] + few
    spoilt = next(view for view in worse if view.camera == 0)
    rng = np.random.default_rng(0)
    worse[worse.index(spoilt)] = replace(spoilt, pixels=spoilt.pixels + rng.normal(0, 1.0, spoilt.pixels.shape))
    calibration = calibrated(rig, worse)
    names = [f"{pose:03d}" for pose in range(POSES)]
    report = calibration_report(calibration, BOARD, pose_names=names, config=CalibrationConfig(flatness=False))
    advice = "\n".join(report["advice"])
    assert "cam03: sees the board at 4 poses only; film 4 more" in advice
    assert "cam03: the board has covered" in advice
    assert f"cam00, pose {spoilt.pose:03d}: off by" in advice
    assert report["flatness"] is None
    assert len(report["hold_out"]) >= 1
    assert all(row["corner_median_mm"] < 0.3 for row in report["hold_out"])
    assert np.array_equal(np.diag(report["shared_poses"]), [row["poses"] for row in report["cameras"]])


def test_the_scale_of_a_pose_does_not_depend_on_how_the_board_is_held():
    """Of few corners, far from symmetric, the median of each coordinate moves with the axes."""
    rig, _, views = scene(0, 0.01)
    few = [replace(view, ids=view.ids[view.ids < 20], pixels=view.pixels[view.ids < 20]) for view in views]
    few = [view for view in few if BOARD.is_fixed_by(view.ids)]
    calibration = calibrated(rig, views)
    report = calibration_report(
        replace(calibration, views=few),
        BOARD,
        pose_names=[f"{pose:03d}" for pose in range(POSES)],
        config=CalibrationConfig(held_out=0, flatness=False),
    )
    scales = [row["scale_ppm"] for row in report["volume"] if row["scale_ppm"] is not None]
    assert len(scales) > 4
    assert np.abs(scales).max() < 500


def test_the_scale_is_the_boards():
    """A board printed 1 % too small makes a rig 1 % too large; nothing in the images tells."""
    rig, _, views = scene(0, 0.03)
    small = replace(BOARD, square_m=0.99 * BOARD.square_m, marker_m=0.99 * BOARD.marker_m)
    found = calibrated(rig, views, small).estimate.rig.centres
    spread, made = np.linalg.norm(found[0] - found[3]), np.linalg.norm(rig.centres[0] - rig.centres[3])
    np.testing.assert_allclose(spread / made, 0.99, rtol=1e-3)


def test_a_board_is_placed_by_a_known_rig():
    rig, poses, views = scene(2, 0.03)
    pose = views[0].pose
    shifted = poses.copy()
    shifted[pose, :3, 3] += 0.02
    shifted[pose, :3, :3] = rotation_from_vector(np.array([0.02, -0.03, 0.01])) @ shifted[pose, :3, :3]
    start = RigEstimate(rig, shifted, BOARD.corners)
    placed, _ = fit_board(start, [view for view in views if view.pose == pose], loss_px=5.0)
    assert np.linalg.norm(placed[:3, 3] - poses[pose, :3, 3]) < 1e-4


def test_adjusting_what_is_right_changes_nothing():
    rig, poses, views = scene(5, 0.0)
    truth = RigEstimate(rig, poses, BOARD.corners)
    again = adjust_rig(truth, views, loss_px=0.1)
    np.testing.assert_allclose(again.rig.T_camera_world, rig.T_camera_world, atol=1e-6)
    np.testing.assert_array_equal(again.corners, BOARD.corners)


def test_noise_is_measured_despite_a_tail():
    rng = np.random.default_rng(0)
    residuals = 0.04 * rng.normal(size=(20000, 2))
    residuals[:200] *= 100
    assert abs(robust_scale(residuals) / 0.04 - 1) < 0.03
    assert 1 < noise_of(residuals, 0.1) / 0.04**2 < 1.3


def test_coverage_counts_cells():
    pixels = np.array([[0.0, 0.0], [599.4, 399.4], [300.0, 200.0]])
    grid = coverage_grid([BoardView(0, 0, np.arange(3, dtype=np.int32), pixels)], np.array([600, 400]))
    assert np.argwhere(grid).tolist() == [[0, 0], [2, 3], [3, 5]]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_alignment_undoes_a_movement(seed: int):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(9, 3))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_vector(rng.normal(size=3)), rng.normal(size=3)
    np.testing.assert_allclose(rigid_alignment(points, transform(T, points)), T, atol=1e-12)


# --- fisheyes ----------------------------------------------------------------------------------------------------


def fisheye_scene(seed: int, noise_px: float) -> tuple[Rig, np.ndarray, list[BoardView]]:
    """Cameras of more than 110 degrees from corner to corner, near the board."""
    rng = np.random.default_rng(seed)
    rig = calibration_rig(4, rng=rng, arc_deg=100, distance_m=1.2, focal_px=620.0)
    bent = np.zeros((4, 5))
    bent[:, :4] = [0.03, -0.01, 4e-3, -1e-3] + rng.normal(size=(4, 4)) * [0.02, 8e-3, 2e-3, 4e-4]
    rig = replace(rig, distortion=bent, lenses=("fisheye",) * 4)
    poses = wave_board(BOARD, POSES, rng=rng, arc_deg=100, volume_m=(1.2, 1.2, 1.2))
    return rig, poses, simulate_views(rig, BOARD, poses, errors=[noise_px * rng.normal(size=(2000, 2))], rng=rng)


def fisheye_calibrated(rig: Rig, views: list[BoardView]) -> Calibration:
    config = CalibrationConfig(lens="fisheye", flatness=False)
    return calibrate_rig(views, BOARD, names=rig.names, image_sizes=rig.image_sizes, poses=POSES, config=config)


def test_a_rig_of_fisheyes_is_found_exactly_without_noise():
    rig, poses, views = fisheye_scene(0, 0.0)
    calibration = fisheye_calibrated(rig, views)
    distances, angles = rig_difference(calibration.estimate, RigEstimate(rig, poses, BOARD.corners))
    assert calibration.estimate.rig.lenses == rig.lenses
    assert distances.max() < 1e-6
    assert angles.max() < 1e-5
    np.testing.assert_allclose(calibration.estimate.rig.distortion, rig.distortion, atol=1e-4)


def test_a_rig_of_fisheyes_is_as_good_as_predicted():
    """And a start is good to a few millimetres, which the adjustment makes hundredths."""
    ratios = []
    for seed in range(3):
        rig, poses, views = fisheye_scene(seed, 0.05)
        calibration = fisheye_calibrated(rig, views)
        truth = RigEstimate(rig, poses, BOARD.corners)
        distances, _ = rig_difference(calibration.estimate, truth)
        started, _ = rig_difference(calibration.start, truth)
        ratios.append((distances**2).sum() / (centre_sigma_m(calibration.covariance) ** 2).sum())
        assert abs(calibration.noise_px / 0.05 - 1) < 0.1
        assert distances.max() < 3e-4
        assert distances.max() < started.max() < 5e-3
        wrong = replace(calibration.estimate.rig, lenses=("brown",) * 4)
        residuals = view_residuals(replace(calibration.estimate, rig=wrong), views[0])
        assert np.abs(residuals).max() > 5, "the lens decides"
    assert 0.4 < np.sqrt(np.mean(ratios)) < 1.8


def test_a_fisheye_that_moves_is_found():
    rig, _, views = fisheye_scene(1, 0.05)
    calibration = fisheye_calibrated(rig, views)
    rng = np.random.default_rng(5)
    moved = rig.T_camera_world.copy()
    moved[2, :3] = rotation_from_vector(np.radians([0.1, 0.1, 0])) @ moved[2, :3]
    after = replace(rig, T_camera_world=moved)
    errors = [0.05 * rng.normal(size=(2000, 2))]
    for these, expected in ((rig, []), (after, ["cam02"])):
        while True:
            pose = wave_board(BOARD, 1, rng=rng, arc_deg=100, volume_m=(0.6, 0.6, 0.6))
            seen = simulate_views(these, BOARD, pose, errors=errors, rng=rng)
            if len(seen) == 4:
                break
        checks = check_rig(calibration.estimate.rig, seen, BOARD, covariance=calibration.covariance)
        assert [check.name for check in checks if check.verdict == "moved"] == expected


def test_views_that_fix_no_fisheye_are_named():
    rig, _, views = fisheye_scene(0, 0.05)
    rng = np.random.default_rng(0)
    noise = [
        replace(view, pixels=rng.uniform(0, 1000, view.pixels.shape)) if view.camera == 1 else view for view in views
    ]
    with pytest.raises(InputError, match="camera cam01: expected board views that fix"):
        fisheye_calibrated(rig, noise)
