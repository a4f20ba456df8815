"""The body, its motion and the scans go along when asked, and are what they were."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from capture4d.body.skinning import pose_frame, with_shape
from capture4d.captures.capture import read_capture, read_scan
from capture4d.cli.exit_codes import BAD_COMMAND_LINE, GOOD
from capture4d.files.atomic import read_json, write_json
from capture4d.files.optional_packages import USD, is_installed
from capture4d.files.records import load_body, load_poses
from capture4d.mesh_files.animated.point_caches import read_pc2
from capture4d.mesh_files.animated.usd import read_usd
from capture4d.mesh_files.gltf.document import open_document
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh
from capture4d.motions.motion_files import read_motion
from tests.command_line import fails, run
from tests.moving_garment import NAMES, write_moving_work


@pytest.fixture
def work(tmp_path: Path) -> Path:
    write_moving_work(tmp_path / "work", 4, first=3)
    return tmp_path / "work"


def posed(work: Path) -> np.ndarray:
    body, poses = load_body(work / "body" / "body.npz"), load_poses(work / "body" / "poses.npz")
    person = with_shape(body, poses.shape)
    return np.stack([pose_frame(person, poses, row).vertices() for row in range(len(poses.frame_ids))])


def test_the_body_moves_beside_the_garment_with_its_skeleton(work: Path, capsys: pytest.CaptureFixture[str]):
    formats = ["--format", "glb", "--format", "pc2", *(["--format", "usd"] if is_installed(USD) else [])]
    assert run("export", work, *formats, "--with", "body", "--quiet") == GOOD
    exports, wanted = work / "exports", posed(work)
    found = read_pc2(exports / "body.pc2", read_mesh(exports / "body.obj").mesh)
    assert 1000 * np.abs(np.stack([*found.frames()]) - wanted).max() < 0.001
    if is_installed(USD):
        moving = read_usd(exports / "body.usdc")
        assert moving.frame_ids.tolist() == [3, 4, 5, 6]
        assert 1000 * np.abs(np.stack([*moving.frames()]) - wanted).max() < 0.001
    glb = open_document(exports / "body.glb")
    joints = [glb.entry("nodes", at)["name"] for at in glb.entry("skins", 0)["joints"]]
    assert joints == list(NAMES)
    assert glb.entry("nodes", 0)["name"] == glb.entry("meshes", 0)["name"] == "body"
    cloth = open_document(exports / "garment.glb").entry("materials", 0)["pbrMetallicRoughness"]
    assert glb.entry("materials", 0)["pbrMetallicRoughness"]["baseColorFactor"] != cloth["baseColorFactor"]
    motion = read_motion(exports / "body.bvh", load_body(work / "body" / "body.npz"))
    poses = load_poses(work / "body" / "poses.npz")
    assert np.abs(motion.rotations - poses.rotations).max() < 1e-4
    assert np.abs(motion.translations - poses.translations).max() < 1e-4
    assert {"glb", "pc2", "body glb", "body pc2"} <= {*read_json(exports / "export.json")["files"]}
    stamp = (exports / "body.glb").stat().st_mtime_ns
    assert run("export", work, *formats, "--with", "body", "--quiet") == GOOD
    assert (exports / "body.glb").stat().st_mtime_ns == stamp


def test_what_there_is_not_cannot_go_along(work: Path, capsys: pytest.CaptureFixture[str]):
    said = fails(capsys, "export", work, "--format", "pc2", "--with", "scans")
    assert said.endswith("--with scans: expected a take with scans, found an animation")
    said = fails(capsys, "export", work, "--format", "pc2", "--with", "cat", code=BAD_COMMAND_LINE)
    assert "--with: expected scans, body or both, found 'cat'" in said
    assert not (work / "exports").exists()


def test_scans_go_along_in_colour_and_a_lost_one_is_told(
    work: Path, tube_capture: Path, capsys: pytest.CaptureFixture[str]
):
    """A take of three frames, of which one scan is not there any more."""
    capture = read_capture(tube_capture)
    ids = list(capture.frame_ids)
    shutil.rmtree(work)
    write_moving_work(work, len(ids), first=ids[0], step=ids[1] - ids[0])
    record = read_json(work / "registration" / "stage.json")
    write_json(work / "registration" / "stage.json", record | {"stage": "register"})
    (work / "garment").mkdir()
    made = {"stage": "extract", "schema": 1, "sources": {"capture": str(tube_capture)}}
    write_json(work / "garment" / "stage.json", made)
    (tube_capture / "scans" / f"{ids[-1]:06d}.ply").write_bytes(b"ply\n")
    assert run("export", work, "--format", "mdd", "--with", "scans", "--quiet") == GOOD
    assert f"scans of 1 frames are damaged or gone, and left out: {ids[-1]}" in capsys.readouterr().err
    found = read_coloured_mesh(work / "exports" / "scans" / f"{ids[0]:06d}.ply")
    scan = read_scan(capture, ids[0])
    assert np.array_equal(found.mesh.vertices, scan.mesh.vertices)
    assert found.colours is not None
    assert np.array_equal(found.colours, scan.colours)
