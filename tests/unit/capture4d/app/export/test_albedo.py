"""The picture of the colours goes along, over the UVs that are exported."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from capture4d.app.export.albedo import Albedo, write_albedo
from capture4d.cli.exit_codes import GOOD
from capture4d.files.atomic import read_json, write_bytes, write_json
from capture4d.files.optional_packages import USD, is_installed, package_module
from capture4d.files.pictures import read_picture
from capture4d.files.records import load_garment, save_garment
from capture4d.mesh_files.gltf.accessors import accessor_values
from capture4d.mesh_files.gltf.document import open_document
from capture4d.mesh_files.meshes import read_coloured_mesh
from capture4d.runs.stage import open_stage
from capture4d.types import Garment, Mesh
from tests.command_line import fails, run
from tests.moving_garment import cloth, write_moving_work


def picture(path: Path, rows: int = 64, columns: int = 64) -> np.ndarray:
    """Red grows to the right, green downwards."""
    red, green = np.meshgrid(np.linspace(0, 255, columns), np.linspace(0, 255, rows))
    pixels = np.stack([red, green, np.full_like(red, 40)], axis=2).round().astype(np.uint8)
    write_bytes(path, cv2.imencode(".png", pixels[..., ::-1])[1].tobytes())
    return pixels


@pytest.fixture
def work(tmp_path: Path) -> Path:
    write_moving_work(tmp_path / "work", 3, maps=8)
    return tmp_path / "work"


def textured(work: Path, *, registration: str | None = None) -> np.ndarray:
    """As `capture4d texture` leaves it."""
    made_from = read_json(work / "registration" / "stage.json")["digest"] if registration is None else registration
    stage = open_stage(work / "texture", name="texture", schema=1, config={}, upstream={"registration": made_from})
    pixels = picture(stage.path / "albedo.png")
    stage.finish([stage.path / "albedo.png"])
    return pixels


def test_it_is_in_every_format_that_can_name_it(work: Path):
    pixels = textured(work)
    formats = ["--format", "glb", "--format", "obj", "--format", "pc2"]
    assert run("export", work, *formats, "--quiet") == GOOD
    exports = work / "exports"
    assert np.array_equal(read_picture(exports / "albedo.png"), pixels)
    found = read_coloured_mesh(exports / "obj" / "000001.obj")
    assert found.colours is not None
    corner = cloth().uv
    assert corner is not None
    wanted = 255 * corner[..., 0].max()
    assert abs(float(found.colours[:, 0].max()) - wanted) < 8
    assert read_coloured_mesh(exports / "garment.obj").colours is not None
    material = open_document(exports / "garment.glb").entry("materials", 0)
    colour = material["pbrMetallicRoughness"]
    assert colour["baseColorFactor"] == [1, 1, 1, 1]
    assert colour["baseColorTexture"]["index"] != material["normalTexture"]["index"]
    glb = read_coloured_mesh(exports / "garment.glb")
    assert glb.colours is not None
    assert abs(float(glb.colours[:, 0].max()) - wanted) < 8
    assert '"albedo": "albedo.png"' in (exports / "open_in_blender.py").read_text()


def test_usd_names_it_beside_the_maps(work: Path):
    if not is_installed(USD):
        pytest.skip("usd-core is not installed")
    textured(work)
    assert run("export", work, "--format", "usd", "--quiet") == GOOD
    stage = package_module(USD, "Usd").Stage.Open(str(work / "exports" / "garment.usdc"))
    shade = package_module(USD, "UsdShade")
    surface = shade.Shader(stage.GetPrimAtPath("/garment/material/preview"))
    for name, file in (("diffuseColor", "./albedo.png"), ("normal", "./normals/000001.png")):
        source = shade.Shader(surface.GetInput(name).GetConnectedSources()[0][0].source.GetPrim())
        assert source.GetInput("file").Get().path == file


def test_one_of_an_earlier_registration_is_left_out_and_one_that_is_given_is_taken(
    work: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    textured(work, registration="another")
    assert run("export", work, "--format", "pc2", "--quiet") == GOOD
    assert "the texture is left out: it is of an earlier registration" in capsys.readouterr().err
    assert not (work / "exports" / "albedo.png").exists()
    assert "no such picture" in fails(capsys, "export", work, "--format", "pc2", "--albedo", tmp_path / "absent.png")
    picture(tmp_path / "given.png", 32, 64)
    given = ("--albedo", tmp_path / "given.png", "--output", work / "given")
    assert run("export", work, "--format", "pc2", *given, "--quiet") == GOOD
    assert read_picture(work / "given" / "albedo.png").shape == (32, 64, 3)
    write_json(work / "texture" / "stage.json", read_json(work / "texture" / "stage.json") | {"status": "running"})
    assert run("export", work, "--format", "pc2", "--output", work / "bare", "--quiet") == GOOD
    assert "albedo" not in read_json(work / "bare" / "stage.json")["upstream"]


def test_a_picture_of_another_template_is_refused(work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    picture(tmp_path / "albedo.png")
    mesh = cloth()
    fewer = mesh.uv[1:] if mesh.uv is not None else None
    save_garment(tmp_path / "template.npz", Garment(Mesh(mesh.vertices, mesh.faces[1:], fewer)))
    said = fails(capsys, "export", work, "--format", "pc2", "--albedo", tmp_path / "albedo.png")
    assert "found one of another template" in said
    save_garment(tmp_path / "template.npz", Garment(mesh))
    assert run("export", work, "--format", "pc2", "--albedo", tmp_path / "albedo.png", "--quiet") == GOOD


def test_over_other_uvs_each_place_keeps_its_colour(work: Path, tmp_path: Path):
    """A turned layout: what was at (u, v) is at (1 - v, u)."""
    pixels, garment = picture(tmp_path / "albedo.png", 128, 128), load_garment(work / "registration" / "garment.npz")
    uv = garment.template.uv
    assert uv is not None
    turned = np.stack([1 - uv[..., 1], uv[..., 0]], axis=-1)
    mesh = Mesh(garment.template.vertices, garment.template.faces, turned.astype(np.float32))
    albedo = Albedo(tmp_path / "albedo.png", "", Garment(garment.template))
    write_albedo(tmp_path / "turned.png", albedo, mesh)
    found = read_picture(tmp_path / "turned.png")
    for u, v in ((0.3, 0.2), (0.7, 0.5), (0.5, 0.6)):
        here = pixels[int((1 - v) * 128), int(u * 128)].astype(int)
        there = found[int((1 - u) * 128), int((1 - v) * 128)].astype(int)
        assert np.abs(here - there).max() <= 5, (u, v)


def test_values_of_a_glb_are_those_without_a_picture(work: Path):
    assert run("export", work, "--format", "glb", "--output", work / "bare", "--quiet") == GOOD
    textured(work)
    assert run("export", work, "--format", "glb", "--quiet") == GOOD
    bare, coloured = (open_document(work / each / "garment.glb") for each in ("bare", "exports"))
    at = bare.entry("meshes", 0)["primitives"][0]["attributes"]["POSITION"]
    assert np.array_equal(accessor_values(bare, at), accessor_values(coloured, at))
