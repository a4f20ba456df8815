"""A checkerboard without markers: numbered alike by every camera, and as good as one with markers."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.simulated_views import calibration_rig
from capture4d.calibration.adjustment import RigEstimate
from capture4d.calibration.checkerboard import find_checkerboard
from capture4d.calibration.corners import detect_corners
from capture4d.calibration.report import rig_difference
from capture4d.cameras.board import parse_board
from capture4d.cameras.projection import project_world, rotation_from_vector, transform
from capture4d.files.records import load_rig
from capture4d.types import Rig
from data_synth.board.images import photograph_board
from data_synth.board.views import visible_corners, wave_board
from tests.command_line import run

SPEC = "checkerboard:10x7:90"


def printed(columns: int, rows: int, square: int = 40) -> np.ndarray:
    """The sheet itself, drawn square by square; its first square is black."""
    squares = np.indices((rows, columns)).sum(axis=0) % 2 * 190 + 30
    sheet = np.kron(squares, np.ones((square, square)))
    return cv2.GaussianBlur(np.pad(sheet, 60, constant_values=220).astype(np.uint8), (0, 0), 0.8)


@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("counts", [(10, 7), (7, 10), (6, 9), (4, 5)])
def test_the_first_square_is_the_black_one_however_it_is_held(turns: int, counts: tuple[int, int]):
    columns, rows = counts
    board = parse_board(f"checkerboard:{columns}x{rows}:40")
    sheet = printed(columns, rows)
    height, width = sheet.shape
    places = board.corners[:, :2] * 1000 + 60 - 0.5
    for _ in range(turns):
        sheet = np.ascontiguousarray(np.rot90(sheet))
        places = np.stack([places[:, 1], width - 1 - places[:, 0]], axis=1)
        width, height = height, width
    ids, pixels = detect_corners(sheet, board)
    assert len(ids) >= len(board.corners) - 4
    assert np.linalg.norm(pixels - places[ids], axis=1).max() < 0.05


def test_a_large_image_is_placed_as_exactly():
    board = parse_board(SPEC)
    K = np.array([[[3900.0, 0, 1919.5], [0, 3903.0, 1439.5], [0, 0, 1]]])
    bent = np.array([[-0.12, 0.08, 3e-4, -2e-4, 0]])
    rig = Rig(("one",), K, bent, np.eye(4)[None], np.array([[3840, 2880]], np.int32))
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(np.array([0.3, 0.5, 0.2]))
    pose[:3, 3] = np.array([0.02, -0.03, 1.6]) - pose[:3, :3] @ board.middle
    picture = photograph_board(rig, 0, board, pose, rng=np.random.default_rng(4))
    truth, _ = project_world(rig, 0, transform(pose, board.corners))
    ids, pixels = detect_corners(picture, board)
    assert len(ids) > 45
    assert np.sqrt(((pixels - truth[ids]) ** 2).sum(axis=1).mean()) < 0.02


@pytest.mark.parametrize("counts", ["9x6", "8x5", "11x8", "8x7", "12x7"])
def test_a_part_of_a_larger_board_is_not_the_board(counts: str):
    for turn in (0.0, 0.2):
        sheet = printed(10, 7)
        warp = cv2.getRotationMatrix2D((sheet.shape[1] / 2, sheet.shape[0] / 2), np.degrees(turn), 0.85)
        sheet = cv2.warpAffine(sheet, warp, sheet.shape[::-1], borderValue=220)
        ids, _ = find_checkerboard(sheet, parse_board(f"checkerboard:{counts}:40"))
        assert len(ids) == 0


def test_half_a_board_and_a_board_with_markers_are_none():
    board = parse_board("checkerboard:8x7:40")
    assert len(find_checkerboard(printed(8, 7)[:, :230].copy(), board)[0]) == 0
    marked = parse_board("charuco:8x7:40:28:DICT_4X4_50").opencv().generateImage((400, 350), marginSize=20)
    assert len(find_checkerboard(marked, board)[0]) == 0


def test_a_rig_is_calibrated_with_it_and_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    rng = np.random.default_rng(6)
    board = parse_board(SPEC)
    rig = calibration_rig(3, rng=rng, image_size=(1024, 768), focal_px=1000.0, arc_deg=50)
    drawn = list(wave_board(board, 80, rng=rng, arc_deg=50))
    poses = [
        pose
        for pose in drawn
        if all(len(visible_corners(rig, camera, board, pose)[0]) == len(board.corners) for camera in range(3))
    ][:11]
    moved = rig.T_camera_world.copy()
    moved[1, :3] = rotation_from_vector(np.radians([0.15, 0.1, 0])) @ moved[1, :3]
    after = replace(rig, T_camera_world=moved)
    for part, these, placed in (("images", rig, poses[:-1]), ("turned", after, poses[-1:])):
        for camera, name in enumerate(rig.names):
            (tmp_path / part / name).mkdir(parents=True)
            for index, pose in enumerate(placed):
                image = photograph_board(these, camera, board, pose, rng=rng)
                cv2.imwrite(str(tmp_path / part / name / f"{index:03d}.bmp"), image)
    images, out = tmp_path / "images", tmp_path / "rig.json"
    assert run("calibrate", images, "--board", SPEC, "--output", out, "--workers", "2") == 0
    estimate = RigEstimate(load_rig(out), np.zeros((0, 4, 4)), board.corners)
    distances, _ = rig_difference(estimate, replace(estimate, rig=rig))
    assert distances.max() < 3e-4
    assert run("check-rig", out, tmp_path / "turned", "--workers", "1") == 3
    assert "moved since calibration: cam01" in capsys.readouterr().err
    corners = tmp_path / "calibration_corners.npz"
    both = corners.read_bytes()
    corners.unlink()
    assert run("calibrate", images, "--board", SPEC, "--output", out, "--workers", "1", "--overwrite") == 0
    assert corners.read_bytes() == both
