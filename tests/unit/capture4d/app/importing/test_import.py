"""Sequences of other tools come in as they went out; and how far they are from the truth is what was put in."""

import json
from pathlib import Path

import numpy as np
import pytest

from capture4d.app.export.stage import possible_formats
from capture4d.captures.capture import Capture, write_capture_description, write_scan
from capture4d.captures.truth import TruthFrame, TruthModel, write_truth_frame, write_truth_model
from capture4d.captures.work_folder import open_work
from capture4d.cli.exit_codes import BAD_RESULT, GOOD
from capture4d.files.atomic import read_json
from capture4d.files.records import save_garment
from capture4d.geometry.mesh import boundary_loops, submesh
from capture4d.mesh_files.meshes import write_mesh
from capture4d.types import Garment, Mesh, Scan
from tests.command_line import fails, run
from tests.moving_garment import cloth, write_moving_work


@pytest.fixture
def exported(tmp_path: Path) -> tuple[Path, np.ndarray]:
    vertices = write_moving_work(tmp_path / "work", 3, first=7, fps=50)
    formats = [each for kind in ("pc2", "mdd", "obj", "ply") for each in ("--format", kind)]
    assert run("export", tmp_path / "work", *formats, "--quiet") == GOOD
    return tmp_path / "work" / "exports", vertices


@pytest.mark.parametrize("name", ["garment.pc2", "garment.mdd", "obj", "ply"])
def test_what_went_out_comes_back(name: str, exported: tuple[Path, np.ndarray], tmp_path: Path):
    exports, vertices = exported
    template = exports / "garment.obj"
    back = tmp_path / "back"
    assert run("import", exports / name, "--template", template, "--output", back, "--fps", 50, "--quiet") == GOOD
    found = open_work(back).registered
    assert found.frame_ids.tolist() == [7, 8, 9]
    assert np.array_equal(found.vertices, vertices)
    assert np.isnan(found.residual_m).all()
    assert run("export", back, "--format", "mdd", "--quiet") == GOOD
    assert (back / "exports" / "garment.mdd").read_bytes() == (exports / "garment.mdd").read_bytes()


@pytest.mark.parametrize("motion", ["exact", "skinned"])
def test_a_glb_comes_back_in_the_order_of_the_template(motion: str, tmp_path: Path):
    vertices = write_moving_work(tmp_path / "work", 6, first=7, fps=59.94)
    assert run("export", tmp_path / "work", "--format", "glb", "--glb.motion", motion, "--quiet") == GOOD
    exports, back = tmp_path / "work" / "exports", tmp_path / "back"
    template = tmp_path / "work" / "registration" / "garment.npz"
    assert run("import", exports / "garment.glb", "--template", template, "--output", back, "--quiet") == GOOD
    found = open_work(back).registered
    assert found.frame_ids.tolist() == [7, 8, 9, 10, 11, 12]
    assert read_json(back / "registration" / "stage.json")["config"]["sequence_fps"] == 59.94
    off = 1000 * np.linalg.norm(found.vertices - vertices, axis=2).max()
    told = read_json(exports / "export.json")["files"]["glb"]["error_mm"]
    assert off <= told + 0.002
    assert (off < 1e-3) == (motion == "exact"), "few shapes are not exact"


def test_units_and_axes_are_those_that_are_told(exported: tuple[Path, np.ndarray], tmp_path: Path):
    _, vertices = exported
    for row, each in enumerate(vertices):
        turned = 100 * each[:, [0, 2, 1]] * np.float32([1, -1, 1])  # centimetres, Z up
        write_mesh(tmp_path / "there" / f"shirt_{row + 1:03d}.ply", Mesh(np.ascontiguousarray(turned), cloth().faces))
    options = ["--fps", 50, "--units", "cm", "--up", "z", "--quiet"]
    template = tmp_path / "work" / "registration" / "garment.npz"
    assert run("import", tmp_path / "there", "--template", template, "--output", tmp_path / "back", *options) == GOOD
    found = open_work(tmp_path / "back").registered
    assert found.frame_ids.tolist() == [1, 2, 3]
    assert np.allclose(found.vertices, vertices, atol=1e-6)


def test_what_does_not_fit_is_one_line(
    exported: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    exports, _ = exported
    given = ["import", exports / "ply", "--template", exports / "garment.obj", "--output", tmp_path / "back"]
    assert "--fps: expected the frame rate" in fails(capsys, *given)
    mesh = cloth()
    write_mesh(tmp_path / "other.ply", Mesh(mesh.vertices[::-1].copy(), mesh.faces))
    write_mesh(tmp_path / "turned.ply", Mesh(mesh.vertices, mesh.faces[:, ::-1].copy()))
    write_mesh(tmp_path / "few.ply", Mesh(mesh.vertices[: 3 * len(mesh.vertices) // 4], np.zeros((1, 3), np.int32)))
    for name in ("other.ply", "turned.ply"):
        given[3] = tmp_path / name
        code = run(*given, "--fps", 50, "--quiet", "--overwrite")
        said = capsys.readouterr().err
        assert (code == GOOD) == (name == "other.ply"), said  # vertices may be anywhere, faces may not
    given[3] = tmp_path / "few.ply"
    assert "expected the 252 vertices of the template" in fails(capsys, *given, "--fps", 50)
    given[1] = tmp_path / "notes.txt"
    assert "notes.txt" in fails(capsys, *given, "--fps", 50)


@pytest.fixture
def moved(exported: tuple[Path, np.ndarray], tmp_path: Path) -> Path:
    """A capture whose truth is the garment of `exported`, 3 mm aside along x, 1 mm more with each frame; scans show the
    half of it with the higher vertices."""
    _, vertices = exported
    mesh, capture = cloth(), tmp_path / "capture"
    loops = {f"border_{at}": loop for at, loop in enumerate(boundary_loops(mesh.faces))}
    save_garment(tmp_path / "template.npz", Garment(mesh, loops))
    described = Capture(capture, "moved", 50.0, (7, 8, 9), (47, 98, 201), {})
    write_capture_description(described)
    face = np.array([np.flatnonzero((mesh.faces == vertex).any(axis=1))[0] for vertex in range(len(mesh.vertices))])
    corner = (mesh.faces[face] == np.arange(len(mesh.vertices))[:, None]).astype(np.float32)
    write_truth_model(capture / "truth" / "model.npz", TruthModel(mesh, loops, face.astype(np.int32), corner))
    half = (mesh.faces >= len(mesh.vertices) // 2).all(axis=1)
    for row, frame_id in enumerate(described.frame_ids):
        there = vertices[row] + np.float32([1e-3 * (3 + row), 0, 0])
        nothing = TruthFrame(there, np.eye(3, dtype=np.float32)[None], np.zeros(3, np.float32), np.zeros(0, np.uint8))
        write_truth_frame(capture / "truth" / f"{frame_id:06d}.npz", nothing)
        seen = submesh(Mesh(there, mesh.faces), half)[0]
        write_scan(
            capture / "scans" / f"{frame_id:06d}.ply", Scan(seen, np.zeros(seen.vertices.shape, np.uint8), frame_id, 0)
        )
    return capture


def figures(work: Path) -> dict[str, float]:
    return {each["key"]: each["value"] for each in json.loads((work / "score.json").read_text())["metrics"]}


def test_the_score_is_how_far_the_sequence_was_moved(
    exported: tuple[Path, np.ndarray], moved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    exports, _ = exported
    back, template = tmp_path / "back", tmp_path / "template.npz"
    assert run("import", exports / "ply", "--template", template, "--output", back, "--fps", 50, "--quiet") == GOOD
    assert run("score", back, moved, "--workers", 1, "--quiet") == GOOD
    assert "cannot be read" not in capsys.readouterr().err
    found = figures(back)
    assert found["correspondence_mean_mm"] == pytest.approx(4, abs=0.01)
    assert found["drift_mm_per_frame"] == pytest.approx(1, abs=0.01)
    assert 0 < found["truth_distance_mean_mm"] < 4
    assert 0 < found["truth_hidden_mean_mm"] < 4, "half of it was not scanned"
    assert 0 < found["border_mean_mm"] <= 4
    assert "verdict" not in found
    assert "frames_good_percent" not in found
    limit = ["--fail-above", "correspondence_mean_mm=3.5"]
    assert run("score", back, moved, "--workers", 1, "--quiet", *limit) == BAD_RESULT
    assert "correspondence_mean_mm is 4" in capsys.readouterr().err
    (moved / "scans" / "000008.ply").write_bytes(b"ply")
    assert run("score", back, moved, "--workers", 1, "--quiet") == GOOD
    assert "the scans of 1 frames cannot be read" in capsys.readouterr().err
    for path in (moved / "truth").iterdir():
        path.unlink()
    assert "expected the truth of a synthetic take in truth/, found none" in fails(capsys, "score", back, moved)


@pytest.mark.parametrize(
    "name", ["garment.usdc", "garment.abc", "garment.glb", "garment.pc2", "garment.mdd", "obj", "ply"]
)
def test_every_format_comes_back_with_the_score_that_went_out(name: str, moved: Path, tmp_path: Path):
    kind = {"usdc": "usd"}.get(name.rpartition(".")[2], name.rpartition(".")[2])
    if not possible_formats([kind])[0]:
        pytest.skip(f"{kind}: its package is not installed")
    work = tmp_path / "work"
    template = work / "registration" / "garment.npz"
    out = ["--format", kind, "--glb.motion", "exact", "--output", tmp_path / "out", "--quiet"]
    assert run("export", work, *out) == GOOD
    back = tmp_path / "back"
    given = ["--template", template, "--output", back, "--fps", 50, "--quiet"]
    assert run("import", tmp_path / "out" / name, *given) == GOOD
    for each in (work, back):
        assert run("score", each, moved, "--workers", 1, "--quiet") == GOOD
    before, after = figures(work), figures(back)
    assert before.keys() >= {"correspondence_mean_mm", "truth_distance_mean_mm", "truth_hidden_mean_mm"}
    assert after == pytest.approx(before, abs=1e-3)


def test_a_sequence_has_the_same_score_whoever_says_what_was_scanned(
    exported: tuple[Path, np.ndarray], moved: Path, tmp_path: Path
):
    """A registration that says of itself that it was nowhere near a scan is measured where one that says nothing is."""
    exports, _ = exported
    backs = [tmp_path / each for each in ("silent", "telling")]
    for back in backs:
        template = ["--template", tmp_path / "template.npz", "--output", back]
        assert run("import", exports / "ply", *template, "--fps", 50, "--quiet") == GOOD
    for path in (backs[1] / "registration" / "frames").iterdir():
        with np.load(path) as arrays:
            vertices = arrays["vertices"]
        residual = np.where(np.arange(len(vertices)) < 10, 0.001, np.nan).astype(np.float32)
        np.savez(path, vertices=vertices, residual_m=residual)
    for back in backs:
        assert run("score", back, moved, "--workers", 1, "--quiet") == GOOD
    assert figures(backs[0]) == figures(backs[1])
