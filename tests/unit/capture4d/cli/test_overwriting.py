"""Commands whose output is a file among others: never onto an input, and onto what is there only if told."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from capture4d.files.atomic import read_json, write_npz
from capture4d.files.records import load_poses, save_poses
from capture4d.mesh_files.meshes import write_mesh
from tests.command_line import fails, run
from tests.shapes import tube
from tests.unit.capture4d.body.test_smpl import smpl_fields

ANOTHER = "expected no file yet, or this very result; found another; use --overwrite"


def other_names(path: Path) -> Iterator[Path]:
    """The file by its name, through a folder that is a link, and as a hard link, which no path shows."""
    yield path
    folder, hard = path.parent.with_name("elsewhere"), path.with_name(f"hard{path.suffix}")
    folder.symlink_to(path.parent)
    yield folder / path.name
    os.link(path, hard)
    yield hard


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    folder = tmp_path / "meshes"
    folder.mkdir()
    write_mesh(folder / "template.ply", tube(16, 8, 0.15, 0.6))
    write_mesh(folder / "scan.ply", tube(40, 30, 0.16, 0.6))
    return folder


def registering(folder: Path, output: Path) -> tuple[str | Path, ...]:
    return "register-mesh", folder / "template.ply", folder / "scan.ply", "--output", output


def test_register_mesh_never_writes_onto_what_it_reads(meshes: Path, capsys: pytest.CaptureFixture[str]):
    before = contents(meshes)
    for name in ("template.ply", "scan.ply"):
        source = meshes / name
        said = fails(capsys, *registering(meshes, source), "--overwrite")
        assert said == f"{source}: expected a file to write to, found the input {source}"
    for output in other_names(meshes / "scan.ply"):
        said = fails(capsys, *registering(meshes, output), "--overwrite")
        assert said == f"{output}: expected a file to write to, found the input {meshes / 'scan.ply'}"
    assert {name: data for name, data in contents(meshes).items() if "hard" not in name} == before


def test_register_mesh_writes_the_same_again_and_anything_else_if_told(
    meshes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    output = tmp_path / "out" / "fitted.glb"
    assert run(*registering(meshes, output)) == 0
    made = contents(output.parent)
    assert set(made) == {"fitted.glb", "fitted.json"}
    assert run(*registering(meshes, output)) == 0, "this very result"
    assert contents(output.parent) == made
    assert fails(capsys, *registering(meshes, output), "--align", "none", "--registration.graph.nodes", "9").endswith(
        ANOTHER
    )
    swapped = ("register-mesh", meshes / "scan.ply", meshes / "template.ply", "--output", output)
    assert fails(capsys, *swapped) == f"{output}: {ANOTHER}"
    assert contents(output.parent) == made
    assert run(*swapped, "--overwrite") in (0, 3), "however good it is"
    assert read_json(output.with_suffix(".json"))["template"] == str(meshes / "scan.ply")


@pytest.mark.parametrize("name", ["fitted.ply", "fitted.json"])
def test_a_file_of_the_users_is_found_before_the_work_is_done(
    name: str, meshes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("registration.register_mesh.register_mesh", None)
    place = tmp_path / name
    place.write_text('{"template": "mine"}')
    assert fails(capsys, *registering(meshes, tmp_path / "fitted.ply")) == f"{place}: {ANOTHER}"
    assert place.read_text() == '{"template": "mine"}'


def test_a_template_is_replaced_if_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    output = tmp_path / "template.npz"
    command = ("template", "--region", "shorts", "--output", output)
    assert run(*command) == 0
    made = output.read_bytes()
    assert f"template: {output}" in capsys.readouterr().out
    assert run(*command) == 0, "this very result"
    other = ("template", "--region", "trousers", "--output", output)
    assert fails(capsys, *other) == f"{output}: {ANOTHER}"
    assert output.read_bytes() == made
    assert run(*other, "--overwrite") == 0
    assert output.read_bytes() != made


def test_a_template_is_not_written_onto_its_motion(motion_file: Path, capsys: pytest.CaptureFixture[str]):
    before = motion_file.read_bytes()
    command = ("template", "--region", "shorts", "--poses", motion_file, "--output", motion_file, "--overwrite")
    assert fails(capsys, *command) == f"{motion_file}: expected a file to write to, found the input {motion_file}"
    assert motion_file.read_bytes() == before


@pytest.fixture
def motion_file(tmp_path: Path) -> Path:
    from capture4d.body.anny import load_anny
    from tests.unit.capture4d.motions.test_motion_files import random_poses

    save_poses(tmp_path / "walk.npz", random_poses(load_anny(), 3))
    return tmp_path / "walk.npz"


def test_motions_are_converted_beside_their_input(motion_file: Path, capsys: pytest.CaptureFixture[str]):
    before, output = motion_file.read_bytes(), motion_file.with_name("walk.bvh")
    said = fails(capsys, "convert-poses", motion_file, motion_file, "--fps", "7", "--overwrite")
    assert said == f"{motion_file}: expected a file to write to, found the input {motion_file}"
    assert motion_file.read_bytes() == before
    assert run("convert-poses", motion_file, output) == 0
    assert run("convert-poses", motion_file, output) == 0, "this very result"
    capsys.readouterr()
    assert run("convert-poses", motion_file, output, "--fps", "7") == 1
    resampled, refused = capsys.readouterr().err.splitlines()
    assert "resampled to 7" in resampled
    assert refused == f"capture4d: {output}: {ANOTHER}"
    assert run("convert-poses", motion_file, output, "--fps", "7", "--overwrite") == 0
    wrong = motion_file.with_name("walk.fbx")
    assert fails(capsys, "convert-poses", motion_file, wrong).startswith(
        f"{wrong}: expected a motion file .npz or .bvh"
    )
    assert load_poses(motion_file).fps != 7


def test_bodies_are_converted_beside_their_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    source, output = tmp_path / "smpl.npz", tmp_path / "body.npz"
    write_npz(source, **smpl_fields())
    before = source.read_bytes()
    assert "found the input" in fails(capsys, "convert-body", source, "--output", source, "--overwrite")
    assert source.read_bytes() == before
    assert run("convert-body", source, "--output", output) == 0
    assert run("convert-body", source, "--output", output) == 0, "this very result"
    write_npz(source, **smpl_fields(seed=1))
    assert fails(capsys, "convert-body", source, "--output", output) == f"{output}: {ANOTHER}"
    assert run("convert-body", source, "--output", output, "--overwrite") == 0
    assert not list(tmp_path.glob(".*"))
