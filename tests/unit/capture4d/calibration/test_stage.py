"""Calibration as a user does it: images in a folder, commands, files; and what is wrong in one line."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.simulated_views import calibration_rig
from capture4d.calibration import stage as calibration_stage
from capture4d.calibration.adjustment import RigEstimate
from capture4d.calibration.board_images import find_images
from capture4d.calibration.report import rig_difference
from capture4d.calibration.stage import read_covariance
from capture4d.cameras.board import parse_board
from capture4d.cameras.projection import rotation_from_vector
from capture4d.errors import InputError
from capture4d.files.records import load_rig, save_rig
from data_synth.board.images import photograph_board
from data_synth.board.views import visible_corners, wave_board
from tests.command_line import fails, run

SPEC = "charuco:9x7:90:68:DICT_4X4_50"
CAMERAS, POSES = 3, 9


def calibrate(images: Path, rig: Path, *more: str | Path) -> tuple[str | Path, ...]:
    return "calibrate", images, "--board", SPEC, "--output", rig, "--workers", "1", *more


@pytest.fixture(scope="module")
def shoot(tmp_path_factory: pytest.TempPathFactory):
    """A small rig, its photographs of a board, and one pose more, before and after a camera was turned."""
    folder = tmp_path_factory.mktemp("shoot")
    rng = np.random.default_rng(6)
    board = parse_board(SPEC)
    rig = calibration_rig(CAMERAS, rng=rng, image_size=(1024, 768), focal_px=1000.0, arc_deg=50)
    poses = list(wave_board(board, 60, rng=rng, arc_deg=50))
    seen = [min(len(visible_corners(rig, camera, board, pose)[0]) for camera in range(CAMERAS)) for pose in poses]
    poses = [pose for pose, count in zip(poses, seen, strict=True) if count > 40][: POSES + 1]
    turned = rig.T_camera_world.copy()
    turned[1, :3] = rotation_from_vector(np.radians([0.15, 0.1, 0])) @ turned[1, :3]
    after = type(rig)(rig.names, rig.intrinsics, rig.distortion, turned, rig.image_sizes)
    for part, these, placed in (("images", rig, poses[:-1]), ("still", rig, poses[-1:]), ("turned", after, poses[-1:])):
        for camera, name in enumerate(rig.names):
            (folder / part / name).mkdir(parents=True)
            for index, pose in enumerate(placed):
                image = photograph_board(these, camera, board, pose, rng=rng)
                cv2.imwrite(str(folder / part / name / f"{index:03d}.png"), image)
    assert run(*calibrate(folder / "images", folder / "rig.json", "--colmap", folder / "colmap")) == 0
    return folder, rig, np.stack(poses)


def test_a_rig_is_calibrated_from_images(shoot):
    folder, truth, poses = shoot
    found = load_rig(folder / "rig.json")
    assert found.names == truth.names
    board = parse_board(SPEC)
    distances, angles = rig_difference(
        RigEstimate(found, poses, board.corners), RigEstimate(truth, poses, board.corners)
    )
    report = json.loads((folder / "calibration.json").read_text())
    sigmas = [(row["centre_sigma_mm"] / 1e3, row["rotation_sigma_deg"]) for row in report["cameras"]]
    assert (distances < 4 * np.array(sigmas)[:, 0]).all()
    assert (angles < 4 * np.array(sigmas)[:, 1]).all()
    assert distances.max() < 2e-3
    assert report["board"] == SPEC
    assert report["residual_median_px"] < 0.1
    assert {row["name"] for row in report["cameras"]} == set(truth.names)
    page = (folder / "calibration.html").read_text()
    assert "Rig calibration" in page
    assert "http" not in page.replace("http-equiv", ""), "self-contained"
    assert all(name in page for name in truth.names)
    assert "corners triangulated within" in page


def test_an_untouched_rig_passes_the_check_and_a_turned_camera_does_not(shoot, capsys: pytest.CaptureFixture[str]):
    folder, truth, _ = shoot
    assert run("check-rig", folder / "rig.json", folder / "still", "--workers", "1") == 0
    line = fails(capsys, "check-rig", folder / "rig.json", folder / "turned", "--workers", "1", code=3)
    assert line == f"moved since calibration: {truth.names[1]}"


def test_a_rig_goes_to_colmap_and_back(shoot, tmp_path: Path):
    folder, _, _ = shoot
    assert run("convert-rig", folder / "colmap", "--output", tmp_path / "a.json") == 0
    assert run("convert-rig", tmp_path / "a.json", "--output", tmp_path / "text", "--text") == 0
    assert run("convert-rig", tmp_path / "text", "--output", tmp_path / "b.json") == 0
    rig, again = load_rig(folder / "rig.json"), load_rig(tmp_path / "b.json")
    np.testing.assert_allclose(again.T_camera_world, rig.T_camera_world, atol=1e-12)
    np.testing.assert_allclose(again.intrinsics, rig.intrinsics, atol=1e-10)


def test_corners_are_detected_once(shoot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder, _, _ = shoot
    for name in ("calibration_corners.npz",):
        shutil.copy(folder / name, tmp_path / name)

    def never(*_: object) -> None:
        raise AssertionError("detected again")

    monkeypatch.setattr("capture4d.calibration.stage.detect_corners", never)
    assert run(*calibrate(folder / "images", tmp_path / "rig.json", "--held-out", "0", "--no-flatness")) == 0
    first, second = (load_rig(path / "rig.json").T_camera_world for path in (folder, tmp_path))
    np.testing.assert_allclose(first, second, atol=1e-7)


def test_what_is_calibrated_is_not_calibrated_again(
    shoot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Until its images change, or its files are lost; a rig that somebody has changed since is theirs."""
    folder, _, _ = shoot
    images = shutil.copytree(folder / "images", tmp_path / "images")
    for path in folder.iterdir():
        if path.is_file():
            shutil.copy(path, tmp_path / path.name)
    rig, calls = tmp_path / "rig.json", []
    solve = calibration_stage.calibrate_rig
    monkeypatch.setattr(calibration_stage, "calibrate_rig", lambda *a, **k: calls.append(1) or solve(*a, **k))
    before, record = rig.read_bytes(), json.loads((tmp_path / "calibration_stage.json").read_text())
    assert record["stage"] == "calibrate"
    assert record["status"] == "complete"
    assert run(*calibrate(images, rig, "--colmap", tmp_path / "model")) == 0
    assert calls == []
    assert rig.read_bytes() == before
    assert (tmp_path / "model").is_dir()
    rig.unlink()
    assert run(*calibrate(images, rig)) == 0
    assert calls == [1]
    assert rig.read_bytes() == before
    save_rig(rig, replace(load_rig(rig), distortion=np.zeros((CAMERAS, 5))))
    changed = rig.read_bytes()
    assert fails(capsys, *calibrate(images, rig)) == (
        f"{rig}: expected no file yet, or this very result; found another; use --overwrite"
    )
    assert rig.read_bytes() == changed
    assert run(*calibrate(images, rig, "--overwrite")) == 0
    assert rig.read_bytes() == before
    calls.clear()
    (images / "cam00" / "008.png").unlink()
    assert run(*calibrate(images, rig)) == 0, "of other images a rig of ours is made anew without a question"
    assert calls == [1]
    assert rig.read_bytes() != before


def test_a_rig_of_other_settings_is_not_replaced_unasked(shoot, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder, _, _ = shoot
    for path in folder.iterdir():
        if path.is_file():
            shutil.copy(path, tmp_path / path.name)
    rig, before = tmp_path / "rig.json", (folder / "rig.json").read_bytes()
    other = ("--held-out", "0", "--no-flatness")
    said = fails(capsys, *calibrate(folder / "images", rig, *other))
    assert said == (
        f"{tmp_path / 'calibration_stage.json'}: was made with other settings (held_out 0.15 to 0.0, flatness true to "
        "false); with --overwrite the same command makes it anew, and keeps what it is made from"
    )
    assert rig.read_bytes() == before
    assert run(*calibrate(folder / "images", rig, *other, "--overwrite")) == 0
    assert json.loads((tmp_path / "calibration.json").read_text())["config"]["held_out"] == 0
    (tmp_path / "calibration_stage.json").unlink()
    assert run(*calibrate(folder / "images", rig, *other)) == 0, "this very rig"


def test_a_rig_from_elsewhere_is_not_replaced_before_any_work_is_done(
    shoot, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    folder, _, _ = shoot
    monkeypatch.setattr(calibration_stage, "detect_corners", None)
    for name in ("rig.json", "calibration.json", "calibration.html"):
        place = tmp_path / name
        place.write_text("of the user")
        said = fails(capsys, *calibrate(folder / "images", tmp_path / "rig.json"))
        assert said == f"{place}: expected no file yet, or that of an earlier run; found another; use --overwrite"
        assert place.read_text() == "of the user"
        place.unlink()


def test_a_photograph_is_never_written_over(shoot, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    images = shutil.copytree(shoot[0] / "images", tmp_path / "images")
    photograph = images / "cam00" / "000.png"
    (tmp_path / "rig.json").hardlink_to(photograph)
    before = photograph.read_bytes()
    said = fails(capsys, *calibrate(images, tmp_path / "rig.json", "--overwrite"))
    assert said == f"{tmp_path / 'rig.json'}: expected a file to write to, found the input {photograph}"
    assert photograph.read_bytes() == before


def test_a_model_that_is_there_needs_a_word(shoot, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder, model = shoot[0], tmp_path / "model"
    command = ("convert-rig", folder / "rig.json", "--output", model)
    assert run(*command) == 0
    assert run(*command) == 0, "the same once more"
    before = {path.name: path.read_bytes() for path in model.iterdir()}
    said = fails(capsys, *command, "--scale", "2")
    assert said.startswith(f"{model}")
    assert said.endswith("expected no file yet, or this very result; found another; use --overwrite")
    assert {path.name: path.read_bytes() for path in model.iterdir()} == before
    assert run(*command, "--scale", "2", "--overwrite") == 0
    own = next(path for path in sorted(model.iterdir()) if path.name.startswith("cameras"))
    said = fails(capsys, "convert-rig", model, "--output", own, "--overwrite")
    assert said == f"{own}: expected a file to write to, found the input {own}"


def test_an_image_that_cannot_be_read_does_not_cost_those_that_can(
    shoot, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    folder, _, _ = shoot
    images = shutil.copytree(folder / "images", tmp_path / "images")
    broken = images / "cam02" / "008.png"
    whole = broken.read_bytes()
    broken.write_bytes(whole[:200])
    rig = tmp_path / "rig.json"
    assert "008.png: not a readable image" in fails(capsys, *calibrate(images, rig))
    broken.write_bytes(whole)
    seen = []
    detect = calibration_stage.detect_corners
    monkeypatch.setattr(calibration_stage, "detect_corners", lambda *a: seen.append(1) or detect(*a))
    assert run(*calibrate(images, rig, "--held-out", "0", "--no-flatness")) == 0
    assert len(seen) == 1


def test_what_lies_beside_another_rig_is_not_used(shoot, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder, _, _ = shoot
    for name in ("rig.json", "calibration.json", "calibration_covariance.npz"):
        shutil.copy(folder / name, tmp_path / name)
    assert run("check-rig", tmp_path / "rig.json", folder / "still", "--workers", "1") == 0
    other = load_rig(folder / "rig.json")
    save_rig(tmp_path / "rig.json", replace(other, T_camera_world=other.T_camera_world + 1e-9))
    said = fails(capsys, "check-rig", tmp_path / "rig.json", folder / "still")
    assert said.endswith("calibration.json is of another rig.json")
    assert read_covariance(tmp_path / "rig.json", cameras=CAMERAS) is None
    assert read_covariance(folder / "rig.json", cameras=CAMERAS) is not None


def test_a_rig_is_not_written_over_a_file_that_was_meant_for_a_folder(
    shoot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "notes").write_text("mine")
    said = fails(capsys, "convert-rig", shoot[0] / "rig.json", "--output", tmp_path / "notes")
    assert said.startswith(f"{tmp_path / 'notes'}: ")
    assert (tmp_path / "notes").read_text() == "mine"


def test_a_floor_is_a_pose_that_was_filmed(shoot, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder, _, _ = shoot
    said = fails(capsys, *calibrate(folder / "images", tmp_path / "rig.json", "--floor", "99"))
    assert said == "--floor: expected one of the poses 000 to 008, found '99'"


def test_bad_images_are_one_line(shoot, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder, _, _ = shoot
    rig = tmp_path / "rig.json"
    assert "no such folder" in fails(capsys, *calibrate(tmp_path / "none", rig))
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "expected images (.png" in fails(capsys, *calibrate(empty, rig))
    said = fails(capsys, "calibrate", folder / "images", "--board", "charuco:9x7:90:68:NO", "--output", rig)
    assert "--board: expected a dictionary" in said
    images = tmp_path / "images"
    shutil.copytree(folder / "images", images)
    broken = images / "cam01" / "003.png"
    broken.write_bytes(broken.read_bytes()[:200])
    assert fails(capsys, *calibrate(images, rig)).endswith("003.png: not a readable image, cut off or damaged")
    cv2.imwrite(str(broken), np.zeros((480, 640), np.uint8))
    assert "003.png: expected 1024x768 pixels as in 000.png, found 640x480" in fails(capsys, *calibrate(images, rig))
    for path in images.rglob("*.png"):
        cv2.imwrite(str(path), np.full((48, 64), 128, np.uint8))
    assert "found it nowhere" in fails(capsys, *calibrate(images, rig))
    assert not rig.exists()


def test_bad_checks_are_one_line(shoot, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder, _, _ = shoot
    shutil.copy(folder / "rig.json", tmp_path / "rig.json")
    said = fails(capsys, "check-rig", tmp_path / "rig.json", folder / "still")
    assert "--board: expected one, for there is no" in said
    (tmp_path / "still" / "cam77").mkdir(parents=True)
    shutil.copy(folder / "still" / "cam00" / "000.png", tmp_path / "still" / "cam77" / "000.png")
    said = fails(capsys, "check-rig", folder / "rig.json", tmp_path / "still", "--workers", "1")
    assert said.endswith("found cam77")


@pytest.mark.parametrize(
    ("pattern", "files", "names"),
    [
        ("{camera}/{pose}", ["a/1.png", "a/2.JPG", "b/1.tif", "b/10.png"], "a1 a2 b1 b10"),
        ("{pose}/{camera}", ["1/a.png", "2/a.png"], "a1 a2"),
        ("shot_{pose}_{camera}", ["shot_7_left.png", "shot_8_left.png", "notes.png"], "left7 left8"),
        ("{camera}/frames/{pose}", ["a/frames/1.png", "a/other/1.png"], "a1"),
    ],
)
def test_images_are_found_by_pattern(tmp_path: Path, pattern: str, files: list[str], names: str):
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    (tmp_path / "readme.txt").touch()
    assert " ".join(image.camera + image.pose for image in find_images(tmp_path, pattern)) == names


def test_numbers_are_sorted_as_numbers(tmp_path: Path):
    for name in ("10", "9", "b"):
        (tmp_path / f"cam{name}").mkdir()
        (tmp_path / f"cam{name}" / "1.png").touch()
    assert [image.camera for image in find_images(tmp_path)] == ["cam9", "cam10", "camb"]


@pytest.mark.parametrize("pattern", ["{camera}", "{camera}/{camera}", "{camera}/{frame}", "{camera}/{pose}/{pose}"])
def test_a_pattern_needs_both_names(tmp_path: Path, pattern: str):
    with pytest.raises(InputError, match=r"--pattern: expected \{camera\} and \{pose\} once each"):
        find_images(tmp_path, pattern)


def test_what_matches_no_pattern_or_twice_is_named(tmp_path: Path):
    (tmp_path / "x.png").touch()
    with pytest.raises(InputError, match=r"x\.png: expected images that lie as --pattern '\{camera\}/\{pose\}' says"):
        find_images(tmp_path)
    (tmp_path / "a").mkdir()
    for name in ("1.png", "1.jpg"):
        (tmp_path / "a" / name).touch()
    with pytest.raises(InputError, match=r"1\.png: expected one image of a camera and a pose, found .*1\.jpg as well"):
        find_images(tmp_path)
