"""Rendered boards: seeded, seen from the front only, cut at the image's edge, covered by hands."""

from dataclasses import replace

import numpy as np
import pytest

from capture4d.calibration.corners import detect_corners
from capture4d.cameras.board import parse_board
from capture4d.cameras.projection import camera_lens, rotation_from_vector, undistort
from capture4d.types import Rig
from data_synth.board.images import BoardImageConfig, photograph_board

BOARD = parse_board("charuco:7x5:60:44:DICT_4X4_50")
CLEAN = BoardImageConfig(noise=0.0, blur_px=0.0, hands=0)


@pytest.fixture
def rig() -> Rig:
    K = np.array([[[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]]])
    D = np.array([[-0.1, 0.05, 3e-4, 0, 0]])
    return Rig(("one",), K, D, np.eye(4)[None], np.array([[640, 480]], np.int32))


def before_the_camera(*, x: float = 0.0, turn: float = 0.0, z: float = 0.8) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(np.array([0.0, turn, 0.0]))
    pose[:3, 3] = np.array([x, 0, z]) - pose[:3, :3] @ BOARD.middle
    return pose


def shot(rig: Rig, pose: np.ndarray, config: BoardImageConfig = CLEAN, seed: int = 0) -> np.ndarray:
    return photograph_board(rig, 0, BOARD, pose, rng=np.random.default_rng(seed), config=config)


def test_the_same_seed_gives_the_same_image(rig: Rig):
    noisy = BoardImageConfig()
    first, second, other = (shot(rig, before_the_camera(), noisy, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, second)
    assert (first != other).mean() > 0.5


def test_every_corner_of_a_board_in_full_view_is_found(rig: Rig):
    ids, _ = detect_corners(shot(rig, before_the_camera()), BOARD)
    assert len(ids) == len(BOARD.corners)


def test_a_tilted_board_is_found_and_its_back_is_blank(rig: Rig):
    assert len(detect_corners(shot(rig, before_the_camera(turn=0.7)), BOARD)[0]) == len(BOARD.corners)
    back = shot(rig, before_the_camera(turn=np.pi))
    assert len(detect_corners(back, BOARD)[0]) == 0
    assert set(np.unique(back[235:245, 310:330])) == {215}


def test_a_board_half_out_of_the_image_is_seen_in_part(rig: Rig):
    ids, pixels = detect_corners(shot(rig, before_the_camera(x=0.42)), BOARD)
    assert 0 < len(ids) < len(BOARD.corners)
    assert pixels[:, 0].max() < 640


def test_a_board_behind_the_camera_is_not_drawn(rig: Rig):
    assert set(np.unique(shot(rig, before_the_camera(z=-0.8)))) == {95}


def test_hands_hide_corners(rig: Rig):
    covered = replace(CLEAN, hands=4, hand_radius_m=0.1)
    assert len(detect_corners(shot(rig, before_the_camera(), covered), BOARD)[0]) < len(BOARD.corners)


def test_noise_has_the_strength_asked_for(rig: Rig):
    clean, noisy = shot(rig, before_the_camera()), shot(rig, before_the_camera(), replace(CLEAN, noise=4.0))
    assert abs((noisy.astype(float) - clean).std() - 4.0) < 0.1


def test_a_pixel_is_the_mean_of_the_pattern_in_it(rig: Rig):
    """Against 1600 rays a pixel into the board as OpenCV prints it."""
    pose, side, fine = before_the_camera(turn=0.6), 40, 40
    image = shot(rig, pose)[220 : 220 + side, 300 : 300 + side]
    along = (np.arange(side * fine) + 0.5) / fine - 0.5
    pixels = np.stack(np.meshgrid(300 + along, 220 + along), axis=-1).reshape(-1, 2)
    rays = np.concatenate([undistort(pixels, camera_lens(rig, 0)), np.ones((len(pixels), 1))], axis=1)
    T_board_camera = np.linalg.inv(pose)
    rays = rays @ T_board_camera[:3, :3].T
    met = T_board_camera[:3, 3] - T_board_camera[2, 3] / rays[:, 2:] * rays
    printed = BOARD.opencv().generateImage((7 * 180, 5 * 180), marginSize=0, borderBits=1)  # 3 texels a millimetre
    column, row = np.floor(3000 * met[:, :2]).astype(int).T
    reference = np.where(printed[row, column] > 127, CLEAN.paper, CLEAN.ink).reshape(side, fine, side, fine)
    error = image - reference.mean(axis=(1, 3))
    assert np.abs(error).max() < 3
    assert abs(error.mean()) < 0.1
