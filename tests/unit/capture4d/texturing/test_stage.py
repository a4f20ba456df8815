"""A tube that bends under a lamp, scanned finely: what is printed on it comes back, without the light."""

from pathlib import Path

import numpy as np
import pytest

from capture4d import pipeline
from capture4d.captures.garment_scans import save_garment_scan
from capture4d.cli.exit_codes import GOOD
from capture4d.files.atomic import read_json, write_json
from capture4d.files.pictures import read_picture
from capture4d.geometry.mesh import vertex_normals
from capture4d.geometry.uv_raster import UvRaster, rasterise_uv
from capture4d.texturing.config import TextureConfig
from capture4d.types import GarmentScan, Mesh
from tests.command_line import fails, run
from tests.moving_garment import cloth, write_moving_work

FRAMES, TEXELS, FINER = 6, 128, 4


def printed(places: np.ndarray) -> np.ndarray:
    """sRGB by the place on the tube at rest: stripes and rings."""
    angle, height = np.arctan2(places[:, 0], places[:, 2]), places[:, 1]
    red = 140 + 60 * np.sin(4 * angle)
    green = 140 + 60 * np.sin(2 * np.pi * height / 0.12)
    blue = 110 + 40 * np.cos(3 * angle)
    return np.stack([red, green, blue], axis=1)


def lamp(normals: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * np.clip(normals @ np.array([0.48, 0.6, 0.64]), 0, None)[:, None]


def finer(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places on a mesh as faces and shares of their corners, and triangles of these; joined where faces meet."""
    rows = [(a, b) for a in range(FINER + 1) for b in range(FINER + 1 - a)]
    number = {row: at for at, row in enumerate(rows)}
    shares = np.array([(FINER - a - b, a, b) for a, b in rows]) / FINER
    small = [(number[a, b], number[a + 1, b], number[a, b + 1]) for a, b in rows if a + b < FINER]
    small += [(number[a + 1, b], number[a + 1, b + 1], number[a, b + 1]) for a, b in rows if a + b < FINER - 1]
    faces = np.repeat(np.arange(len(mesh.faces)), len(rows))
    everywhere = np.tile(shares, (len(mesh.faces), 1))
    triangles = (np.array(small)[None] + len(rows) * np.arange(len(mesh.faces))[:, None, None]).reshape(-1, 3)
    at = np.einsum("nk,nkc->nc", everywhere, mesh.vertices[mesh.faces[faces]].astype(np.float64))
    _, first, back = np.unique(np.round(at, 6), axis=0, return_index=True, return_inverse=True)
    return faces[first], everywhere[first], back.reshape(-1)[triangles].astype(np.int32)


@pytest.fixture
def work(tmp_path: Path) -> Path:
    """Registered exactly; in the last frame a stranger's hand is before the cloth."""
    folder = tmp_path / "work"
    vertices = write_moving_work(folder, FRAMES)
    record = read_json(folder / "registration" / "stage.json")
    write_json(folder / "registration" / "stage.json", record | {"stage": "register"})
    (folder / "garment" / "frames").mkdir(parents=True)
    made = {"stage": "extract", "schema": 1, "status": "complete", "digest": "abc", "upstream": {}, "config": {}}
    write_json(folder / "garment" / "stage.json", made)
    mesh, rng = cloth(), np.random.default_rng(0)
    faces, shares, triangles = finer(mesh)

    def at(corners: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", shares, corners[mesh.faces[faces]].astype(np.float64))

    own = printed(at(mesh.vertices))
    for row in range(FRAMES):
        places = at(vertices[row])
        colours = own * lamp(vertex_normals(places, triangles)) + rng.normal(0, 1.5, own.shape)
        if row == FRAMES - 1:
            colours[places[:, 1] > np.percentile(places[:, 1], 80)] = (90, 60, 40)
        scan = GarmentScan(
            Mesh(places.astype(np.float32), triangles), np.zeros((0, 3), np.float32), np.zeros(0, np.int32), (),
            row + 1, colours=np.clip(np.rint(colours), 0, 255).astype(np.uint8),
        )  # fmt: skip
        save_garment_scan(folder / "garment" / "frames" / f"{row + 1:06d}.npz", scan)
    return folder


def raster() -> UvRaster:
    return rasterise_uv(cloth(), TEXELS, padding=0)


def away(picture: np.ndarray) -> np.ndarray:
    """Levels by which a picture differs from the print, after one factor for all of it."""
    texels = raster()
    wanted, made = printed(texels.at_vertices(cloth().vertices.astype(np.float64))), texels.read(picture).astype(float)
    factor = np.median(wanted / made)
    return np.abs(factor * made - wanted).mean(axis=1)[texels.inside]


def test_the_print_comes_back_without_the_light(work: Path, capsys: pytest.CaptureFixture[str]):
    assert run("texture", work, "--texels", TEXELS, "--quiet") == GOOD
    assert "texture: 6 frames, 100.0 % of it seen" in capsys.readouterr().out
    texture = work / "texture"
    lit = away(read_picture(texture / "albedo.png"))
    assert np.median(lit) < 5
    assert np.percentile(lit, 90) < 15
    assert read_picture(texture / "seen.png")[raster().image(raster().inside)].min() == 255
    assert not (texture / "frames").exists()
    stamp = (texture / "albedo.png").stat().st_mtime_ns
    assert run("texture", work, "--texels", TEXELS, "--quiet") == GOOD
    assert (texture / "albedo.png").stat().st_mtime_ns == stamp
    assert run("texture", work, "--texels", TEXELS, "--no-light", "--overwrite", "--quiet") == GOOD
    unlit = away(read_picture(texture / "albedo.png"))
    assert np.percentile(unlit, 90) > 2 * np.percentile(lit, 90)


def test_a_run_that_was_killed_goes_on_with_the_frames_that_are_missing(work: Path):
    config = TextureConfig(texels=TEXELS, frames=4)
    whole = pipeline.texture(work, config)
    picture = (work / "texture" / "albedo.png").read_bytes()
    (work / "texture" / "albedo.png").unlink()
    again = pipeline.texture(work, config)
    assert again.digest == whole.digest
    assert (work / "texture" / "albedo.png").read_bytes() == picture
    assert read_json(work / "texture" / "texture.json")["frames"] == [1, 3, 4, 6]


def test_what_has_no_colours_or_no_scans_is_one_line(work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write_moving_work(tmp_path / "dance", 2)
    said = fails(capsys, "texture", tmp_path / "dance")
    assert said.endswith("expected a take that was registered to scans, found an animation")
    bare = GarmentScan(cloth(), np.zeros((0, 3), np.float32), np.zeros(0, np.int32), (), 1)
    for path in (work / "garment" / "frames").iterdir():
        save_garment_scan(path, bare)
    assert "expected a garment with colours, found one without" in fails(capsys, "texture", work)
