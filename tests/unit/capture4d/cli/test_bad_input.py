"""What a lab may hand to each command by mistake: one line, exit code 1, and nothing of what was there is lost.

command     fault                                              tested in
calibrate   no folder, no images, damaged or resized image,    calibration/test_stage (through the command)
            board not in any image, no such dictionary
            malformed board, cameras that share no view        here
check-rig   no board, cameras of another rig                   calibration/test_stage (through the command)
            rig.json missing or broken, no images              here
check       no folder, no scans, bad description               preflight/test_stage (through the command)
            rig.json or poses broken, another skeleton         here
track       no capture, bad start, another skeleton, damaged   here
            body, nothing but damaged scans
            some damaged scans                                 tracking/test_stage
extract     no capture, other colours, damaged scans           cli/test_main (through the command)
template    neither mesh nor region, faults of the mesh        templates/test_garment
            missing, truncated or NaN mesh, no UVs to keep,    here
            another skeleton, damaged body, no such frame
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.simulated_views import calibration_rig, simulate_views
from capture4d.body.anny import load_anny
from capture4d.body.skinning import with_shape
from capture4d.calibration.stage import DETECTOR
from capture4d.cameras.board import parse_board
from capture4d.files.atomic import write_bytes, write_npz
from capture4d.files.records import save_body, save_poses, save_rig
from capture4d.mesh_files.meshes import write_mesh
from capture4d.motions.retargeting import SMPL_TREE
from capture4d.templates.body_regions import body_region
from capture4d.types import Mesh, PoseSequence
from data_synth.board.views import wave_board
from tests.command_line import fails

BOARD = "charuco:10x8:80:60:DICT_5X5_100"


def motion(joint_names: tuple[str, ...], frame_ids: tuple[int, ...]) -> PoseSequence:
    still = np.tile(np.eye(3, dtype=np.float32), (len(frame_ids), len(joint_names), 1, 1))
    places, ids = np.zeros((len(frame_ids), 3), np.float32), np.array(frame_ids, np.int32)
    return PoseSequence(still, places, np.zeros(0, np.float32), ids, 60.0, joint_names)


# --- calibrate, check-rig


@pytest.mark.parametrize(
    ("board", "said"),
    [
        ("checkerboard", "--board: expected a board such as charuco:"),
        ("charuco:10x8:80:60", "--board: expected a board such as charuco:"),
        ("charuco:10x8:60:80:DICT_5X5_100", "expected a marker smaller than its square, found 80 and 60 mm"),
        ("charuco:30x30:80:60:DICT_4X4_50", "30x30 squares need 450 markers, DICT_4X4_50 has 50"),
    ],
)
def test_a_malformed_board(board: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    images = tmp_path / "images" / "cam00"
    images.mkdir(parents=True)
    assert said in fails(capsys, "calibrate", images.parent, "--board", board, "--output", tmp_path / "rig.json")


def seen_by_two_pairs(folder: Path) -> Path:
    """Board images whose corners an earlier run has found: cameras 0 and 1 see some poses, 2 and 3 the others."""
    rng, board, poses = np.random.default_rng(0), parse_board(BOARD), 16
    rig = calibration_rig(4, rng=rng, arc_deg=100)
    placed = wave_board(board, poses, rng=rng, arc_deg=100)
    views = simulate_views(rig, board, placed, errors=[0.04 * rng.normal(size=(2000, 2))], rng=rng)
    views = [view for view in views if (view.camera < 2) == (view.pose < poses // 2)]
    keys = []
    for view in views:
        name = f"{rig.names[view.camera]}/{view.pose:03d}.png"
        write_bytes(folder / name, b"seen before")
        status = (folder / name).stat()
        keys.append(f"{name} {status.st_size} {status.st_mtime_ns}")
    write_npz(
        folder.parent / "calibration_corners.npz",
        board=np.array(f"{board}, {DETECTOR}"),
        keys=np.array(keys),
        sizes=np.array([rig.image_sizes[view.camera] for view in views], np.int32),
        counts=np.array([len(view.ids) for view in views], np.int32),
        ids=np.concatenate([view.ids for view in views]),
        pixels=np.concatenate([view.pixels for view in views]),
    )
    return folder


def test_cameras_that_share_no_view_are_named_and_the_rig_that_was_there_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    rig = tmp_path / "rig.json"
    rig.write_text("the rig of yesterday")
    command = ("calibrate", seen_by_two_pairs(tmp_path / "images"), "--board", BOARD, "--output", rig, "--workers", "1")
    said = fails(capsys, *command)
    assert said.endswith("found separate ones: cam00, cam01 | cam02, cam03")
    assert rig.read_text() == "the rig of yesterday"
    assert {path.name for path in tmp_path.iterdir()} == {"images", "rig.json", "calibration_corners.npz"}


def broken_rigs(folder: Path) -> dict[str, str]:
    """Contents of a rig.json that is none, by what is said of it."""
    save_rig(folder / "good.json", calibration_rig(2, rng=np.random.default_rng(0), arc_deg=40))
    good = json.loads((folder / "good.json").read_text())
    without, bent, lost = (json.loads(json.dumps(good)) for _ in range(3))
    del without["cameras"][1]["intrinsics"]
    bent["cameras"][0]["T_camera_world"] = [[1, 0], [0, 1]]
    lost["cameras"][0]["intrinsics"][0][2] = float("nan")
    return {
        "not valid JSON": json.dumps(good)[:-40],
        "expected the entry 'intrinsics' for every camera, found none": json.dumps(without),
        "camera 'cam00': expected 4 x 4 numbers as T_camera_world, found 2 x 2": json.dumps(bent),
        "expected finite numbers, found NaN": json.dumps(lost),
        "expected the entry 'cameras'": json.dumps({"rig": []}),
        "expected a JSON object": "[]",
        "expected at least one camera": '{"format": 1, "cameras": []}',
    }


def test_a_broken_rig_is_named(tmp_path: Path, tube_capture: Path, capsys: pytest.CaptureFixture[str]):
    path, images = tube_capture / "rig.json", tmp_path / "board"
    images.mkdir()
    check = ("check-rig", path, images, "--board", BOARD)
    assert fails(capsys, *check) == f"{path}: no such file"
    for expected, text in broken_rigs(tmp_path).items():
        path.write_text(text)
        for command in (check, ("check", tube_capture), ("convert-rig", path, "--output", tmp_path / "colmap")):
            said = fails(capsys, *command)
            assert said.startswith(f"{path}: ")
            assert expected in said
    path.write_bytes((tmp_path / "good.json").read_bytes())
    assert "expected images (.png" in fails(capsys, *check)
    assert not (tmp_path / "colmap").exists()


# --- check, track


def test_motion_of_another_skeleton(tube_capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    save_body(tube_capture / "body.npz", load_anny())
    poses = motion(tuple(SMPL_TREE), (5, 6, 7))
    save_poses(tmp_path / "start.npz", poses)
    said = fails(
        capsys, "track", tube_capture, "--output", tmp_path / "work", "--tracking.start", tmp_path / "start.npz"
    )
    assert "start.npz: expected the body's 36 joints" in said

    save_poses(tube_capture / "poses.npz", poses)
    said = fails(capsys, "check", tube_capture, "--workers", "1")
    assert said == f"{tube_capture / 'poses.npz'}: expected the joints of body.npz, found others"

    for name in ("poses.npz", "body.npz"):
        whole = (tube_capture / name).read_bytes()
        (tube_capture / name).write_bytes(whole[: len(whole) // 2])
        said = fails(capsys, "check", tube_capture, "--workers", "1")
        assert said.startswith(f"{tube_capture / name}: not a readable npz file, cut off or damaged")
        save_poses(tube_capture / "poses.npz", motion(load_anny().joint_names, (5, 6, 7)))


def track(capture: Path, work: Path, *more: str | Path) -> tuple[str | Path, ...]:
    return "track", capture, "--output", work, "--workers", "1", *more


def test_what_cannot_be_tracked(tube_capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    work = tmp_path / "work"
    assert "nowhere: no such capture folder" in fails(capsys, *track(Path("nowhere"), work))
    assert "expected search, rest or a motion file, found 'sit'" in fails(
        capsys, *track(tube_capture, work, "--tracking.start", "sit")
    )
    (tube_capture / "body.npz").write_bytes(b"PK")
    assert "body.npz: not a readable npz file" in fails(capsys, *track(tube_capture, work, "--tracking.start", "rest"))
    (tube_capture / "body.npz").unlink()
    for path in (tube_capture / "scans").iterdir():
        path.write_bytes(b"ply")
    assert "000005.ply: " in fails(capsys, *track(tube_capture, tmp_path / "work2", "--tracking.start", "rest"))
    assert not (tmp_path / "work2" / "body" / "poses.npz").exists()


# --- template


@pytest.fixture(scope="module")
def shorts() -> Mesh:
    return body_region(with_shape(load_anny(), np.zeros(0, np.float32)), "shorts")


def test_what_cannot_be_a_template(
    shorts: Mesh, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    output = tmp_path / "template.npz"
    output.write_bytes(b"the template of yesterday")

    def said(*arguments: str | Path) -> str:
        line = fails(capsys, "template", *arguments, "--output", output)
        assert output.read_bytes() == b"the template of yesterday"
        return line

    assert said("none.ply") == "none.ply: no such mesh file"
    write_mesh("shorts.ply", replace(shorts, uv=None))
    whole = Path("shorts.ply").read_bytes()
    Path("cut.ply").write_bytes(whole[: len(whole) // 2])
    assert said("cut.ply").startswith("cut.ply: cut off")
    start = whole.index(b"end_header\n") + len(b"end_header\n")
    Path("nan.ply").write_bytes(whole[:start] + np.float32(np.nan).tobytes() + whole[start + 4 :])
    assert "nan.ply: Mesh.vertices: expected finite numbers, found NaN" in said("nan.ply")
    Path("notes.txt").write_text("v 0 0 0")
    assert said("notes.txt").startswith("notes.txt: expected a mesh file")
    assert "expected UVs that can be kept, found no UVs" in said("shorts.ply", "--uv", "keep")
    assert said("shorts.ply", "--units", "mm").endswith("found a mesh of 0.41 mm; its units differ")
    assert said("shorts.ply", "--body", "none.npz") == "none.npz: no such file"
    Path("body.npz").write_bytes(b"PK")
    assert said("shorts.ply", "--body", "body.npz").startswith("body.npz: not a readable npz file")
    save_poses(tmp_path / "poses.npz", motion(tuple(SMPL_TREE), (5, 6, 7)))
    assert "poses.npz: expected the body's 36 joints" in said("shorts.ply", "--poses", "poses.npz")
    save_poses(tmp_path / "poses.npz", motion(load_anny().joint_names, (5, 6, 7)))
    assert "expected a pose for frame 9, found frames 5 to 7" in said(
        "shorts.ply", "--poses", "poses.npz", "--frame", "9"
    )
