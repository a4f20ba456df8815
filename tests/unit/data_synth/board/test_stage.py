"""A virtual rig photographs a board: the photographs say where the cameras stand, and are made once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.calibration.adjustment import RigEstimate
from capture4d.calibration.board_images import find_images
from capture4d.calibration.report import rig_difference
from capture4d.calibration.stage import run as calibrate
from capture4d.errors import InputError
from capture4d.files.records import load_rig, save_rig
from data_synth.board.stage import run, shared_volume
from data_synth.config import BoardConfig
from data_synth.scanner.rig import capture_rig
from tests.shapes import ring

CENTRE, RADIUS = (0.2, 1.3, -0.1), 0.6
CONFIG = BoardConfig(poses=16, seed=3)


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("photographs")
    save_rig(folder / "rig.json", capture_rig(centre=CENTRE, radius=RADIUS, cameras=8, image_size=448))
    run(folder / "rig.json", folder / "images", CONFIG)
    return folder / "rig.json", folder / "images"


def test_the_volume_is_where_all_cameras_look(photographed: tuple[Path, Path]):
    centre, radius = shared_volume(load_rig(photographed[0]))
    assert np.linalg.norm(centre - CENTRE) < 0.3 * RADIUS
    assert 0.7 * RADIUS < radius < 1.5 * RADIUS


def test_photographs_calibrate_to_the_rig_that_took_them(photographed: tuple[Path, Path], tmp_path: Path):
    rig, images = photographed
    found = find_images(images)
    truth = load_rig(rig)
    assert {image.camera for image in found} == set(truth.names)
    assert len(found) < len(truth.names) * CONFIG.poses, "nobody sees the back of the board"
    calibrate(images, tmp_path / "rig.json", CONFIG.board)
    calibrated = load_rig(tmp_path / "rig.json")
    order = [truth.names.index(name) for name in calibrated.names]
    ordered = replace(calibrated, T_camera_world=truth.T_camera_world[order])
    poses, corners = np.eye(4)[None], np.zeros((1, 3))
    distances, angles = rig_difference(RigEstimate(calibrated, poses, corners), RigEstimate(ordered, poses, corners))
    assert distances.max() < 5e-3
    assert angles.max() < 0.3


def test_lost_photographs_are_taken_again_and_others_kept(photographed: tuple[Path, Path]):
    rig, images = photographed
    first, second, *_ = sorted(images.rglob("*.png"))
    before, kept = first.read_bytes(), second.stat().st_mtime_ns
    digest = run(rig, images, CONFIG).digest
    first.unlink()
    assert run(rig, images, CONFIG).digest == digest
    assert first.read_bytes() == before
    assert second.stat().st_mtime_ns == kept


def test_other_boards_and_none_are_refused(photographed: tuple[Path, Path], tmp_path: Path):
    rig, images = photographed
    with pytest.raises(InputError, match="made with other settings"):
        run(rig, images, BoardConfig(poses=17, seed=3))
    with pytest.raises(InputError, match="poses: expected at least 1, found 0"):
        BoardConfig(poses=0)
    with pytest.raises(InputError, match="expected"):
        run(rig, tmp_path / "images", BoardConfig(board="chess"))


@pytest.mark.parametrize("name", ["nul", "con", "a" * 300])
def test_a_camera_does_not_say_where_its_images_go(name: str, tmp_path: Path):
    rig = ring(2)
    save_rig(tmp_path / "rig.json", replace(rig, names=("cam00", name)))
    with pytest.raises(InputError, match=r"rig\.json: name of a camera: expected"):
        run(tmp_path / "rig.json", tmp_path / "images", CONFIG)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig.json"]
