"""The command: what is there stays, what is stale is refused, what is written was read back."""

import base64
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture4d.app.export import stage
from capture4d.cli.exit_codes import BAD_COMMAND_LINE, BAD_RESULT, GOOD
from capture4d.files.atomic import read_json, write_json
from capture4d.mesh_files.meshes import read_mesh
from tests.command_line import fails, run
from tests.moving_garment import write_moving_work


@pytest.fixture
def work(tmp_path: Path) -> Path:
    write_moving_work(tmp_path / "work", 4, first=3, maps=16)
    return tmp_path / "work"


def test_formats_join_what_is_there_and_nothing_is_written_twice(work: Path, capsys: pytest.CaptureFixture[str]):
    exports = work / "exports"
    assert run("export", work, "--format", "pc2", "--quiet") == GOOD
    said = capsys.readouterr()
    assert said.out.splitlines() == [
        "export: garment.pc2: 4 frames, read back within 0.0000 mm",
        f"exports: {exports}",
        f"for Blender: blender -P {exports / 'open_in_blender.py'}",
    ]
    assert said.err == ""
    before = {path: path.stat().st_mtime_ns for path in exports.rglob("*") if path.suffix in (".pc2", ".png", ".obj")}
    assert len(before) == 6
    assert run("export", work, "--format", "pc2", "--format", "ply", "--format", "obj", "--quiet") == GOOD
    assert {path: path.stat().st_mtime_ns for path in before} == before
    vertices = np.load(work / "registration" / "vertices.npy")
    for kind in ("ply", "obj"):
        assert np.array_equal(read_mesh(exports / kind / "000005.ply".replace("ply", kind)).mesh.vertices, vertices[2])
    (exports / "garment.pc2").unlink()
    assert run("export", work, "--format", "pc2", "--quiet") == GOOD
    assert (exports / "garment.pc2").is_file()


def test_other_frames_want_overwrite_and_unknown_ones_are_told(work: Path, capsys: pytest.CaptureFixture[str]):
    assert run("export", work, "--format", "mdd", "--quiet", "--frames", "3-6") == GOOD
    assert "made with other settings" in fails(capsys, "export", work, "--format", "mdd", "--frames", "3-5:2")
    assert run("export", work, "--format", "mdd", "--quiet", "--frames", "3-5:2", "--overwrite") == GOOD
    assert sorted(path.name for path in (work / "exports" / "normals").iterdir()) == ["000003.png", "000005.png"]
    assert read_json(work / "exports" / "export.json")["frames"] == [3, 5]
    assert "expected frames that the take has (3-6), found '9'" in fails(capsys, "export", work, "--frames", "9")


def test_what_a_format_cannot_hold_leaves_nothing_of_it(work: Path, capsys: pytest.CaptureFixture[str]):
    said = fails(capsys, "export", work, "--format", "pc2", "--frames", "3,4,6", "--output", work / "odd")
    assert said.endswith("found frame 6 after frame 4")
    assert said.startswith(f"{work / 'odd' / 'garment.pc2'}: pc2: ")
    assert not list((work / "odd").glob("garment*"))
    assert not list((work / "odd").glob("*.partial"))


def test_maps_are_those_of_the_frames_in_as_many_bits(work: Path, capsys: pytest.CaptureFixture[str]):
    assert run("export", work, "--format", "pc2", "--quiet") == GOOD
    source = work / "wrinkles" / "generated" / "frames" / "000004.png"
    wanted = cv2.imread(str(source), cv2.IMREAD_UNCHANGED).astype(float) / 65535
    found = cv2.imread(str(work / "exports" / "normals" / "000004.png"), cv2.IMREAD_UNCHANGED)
    assert found.dtype == np.uint8
    assert np.abs(found / 255 - wanted).max() < 0.003
    assert run("export", work, "--format", "pc2", "--maps", "16", "--output", work / "deep", "--quiet") == GOOD
    assert (work / "deep" / "normals" / "000004.png").read_bytes() == source.read_bytes()
    assert run("export", work, "--format", "pc2", "--maps", "none", "--output", work / "bare", "--quiet") == GOOD
    assert not (work / "bare" / "normals").exists()


def test_maps_of_an_earlier_registration_are_left_out_and_that_is_said(work: Path, capsys: pytest.CaptureFixture[str]):
    record = read_json(work / "wrinkles" / "generated" / "stage.json")
    write_json(work / "wrinkles" / "generated" / "stage.json", {**record, "upstream": {"registration": "another"}})
    assert run("export", work, "--format", "pc2", "--quiet") == GOOD
    assert "normal maps are left out: they are of an earlier registration" in capsys.readouterr().err
    assert not (work / "exports" / "normals").exists()


def test_an_error_above_its_limit_is_written_told_and_exit_3(work: Path, capsys: pytest.CaptureFixture[str]):
    assert run("export", work, "--format", "glb", "--glb.most", "1", "--glb.p99-mm", "0.01", "--quiet") == BAD_RESULT
    said = capsys.readouterr()
    assert "garment.glb: p99_mm " in said.err
    assert "> 0.01" in said.err
    assert "garment.glb: 4 frames, 1 shapes, error " in said.out
    assert (work / "exports" / "garment.glb").is_file()


def test_without_its_package_usd_gives_way_to_glb_and_all_leaves_it_out(
    work: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(stage, "is_installed", lambda package: False)
    assert run("export", work, "--quiet") == GOOD
    said = capsys.readouterr()
    assert "pip install 'capture4d[usd]' makes USD the default" in said.err
    assert "garment.glb" in said.out
    assert stage.possible_formats(["usd", "abc", "mdd"]) == (
        ["mdd"],
        [
            "usd is left out: pip install 'capture4d[usd]' adds it",
            "abc is left out: pip install 'capture4d[alembic]' adds it",
        ],
    )
    assert "found both" in fails(capsys, "export", work, "--all", "--format", "glb", code=BAD_COMMAND_LINE)


def test_the_script_for_blender_is_python_and_knows_the_take(work: Path):
    assert run("export", work, "--format", "pc2", "--format", "glb", "--quiet") == GOOD
    text = (work / "exports" / "open_in_blender.py").read_text()
    compile(text, "open_in_blender.py", "exec")
    (line,) = [line for line in text.splitlines() if line.startswith("TAKE = ")]
    take = json.loads(line.removeprefix("TAKE = ").partition("  #")[0])
    assert take["files"] == ["garment.glb", "garment.pc2"]
    assert (take["fps"], take["first"], take["last"], take["maps"]) == (25.0, 3, 6, "000003.png")


def test_a_folder_without_a_registration_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "empty").mkdir()
    assert "expected a work folder with a registration, found none" in fails(capsys, "export", tmp_path / "empty")


def test_a_page_holds_everything_and_names_nothing_elsewhere(work: Path):
    assert run("export", work, "--format", "html", "--format", "glb", "--quiet") == GOOD
    text = (work / "exports" / "garment.html").read_text()
    take = json.loads(text.partition('<script id="take" type="application/json">')[2].partition("</script>")[0])
    assert base64.b64decode(take["glb"]) == (work / "exports" / "garment.glb").read_bytes()
    assert take["frames"] == [3, 4, 5, 6]
    assert len({*take["maps"]}) == 4
    assert "default-src 'none'" in text
    assert not re.search(r"""(?:src|href)\s*=\s*["']?[^"'\s>]*//""", text), "nothing is loaded from anywhere"
    assert "The MIT License" in text
