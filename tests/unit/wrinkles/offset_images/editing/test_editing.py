"""Drawn offsets: only differences count: what nobody touched does not change, whatever a program does besides."""

from __future__ import annotations

import contextlib
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture4d.captures.animations.config import RemovalConfig
from capture4d.captures.work_folder import WorkFolder, open_work
from capture4d.cli.main import main
from capture4d.errors import InputError
from capture4d.mesh_files.meshes import read_mesh
from tests.unit.wrinkles.offset_images.test_stage import bound_work
from wrinkles.offset_images.editing.config import DrawConfig
from wrinkles.offset_images.editing.operations import Operation, apply_operation, brush, parse_operations, smoothed
from wrinkles.offset_images.editing.picture_files import write_picture
from wrinkles.offset_images.editing.stage import apply, draw, edit
from wrinkles.offset_images.layout import OffsetLayout

with contextlib.suppress(ImportError):  # an extra
    import OpenEXR

FRAME, TEXELS = 5, 64


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> WorkFolder:
    return open_work(bound_work(tmp_path_factory.mktemp("edits"), 8, bend=0.5))


@pytest.fixture(params=["tif", "exr", "png"])
def drawn(work: WorkFolder, tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    if request.param == "exr":
        pytest.importorskip("OpenEXR")
    folder = tmp_path / "drawn"
    folder.mkdir()
    draw(work, FRAME, folder, DrawConfig(TEXELS, request.param))
    return folder


def picture(folder: Path, side: str = "front") -> Path:
    return next(folder.glob(f"{side}.[tpe]*"))


def pixels(path: Path) -> np.ndarray:
    """Blue, green, red, as another program reads them."""
    if path.suffix == ".exr":
        with OpenEXR.File(str(path)) as file:
            return np.array(file.channels()["RGB"].pixels)[..., ::-1]
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert found is not None
    return found


def put(path: Path, image: np.ndarray) -> None:
    """Write blue, green, red as another program does."""
    if path.suffix != ".exr":
        assert cv2.imwrite(str(path), image)
        return
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.ascontiguousarray(image[..., ::-1])}) as file:
        file.write(str(path))


def registered(work: WorkFolder) -> np.ndarray:
    return np.array(work.registered.vertices[FRAME - 1])


def shown(work: WorkFolder) -> np.ndarray:
    """Texels whose centre lies on cloth, (size, size, 2)."""
    layout = OffsetLayout.create(work.registered.garment, TEXELS)
    return np.stack([raster.image(raster.inside) for raster in layout.rasters], axis=-1)


def test_an_untouched_picture_changes_nothing(work: WorkFolder, drawn: Path) -> None:
    edited = apply(drawn, work, RemovalConfig())
    assert edited.removed is None
    np.testing.assert_array_equal(edited.mesh.vertices, registered(work))


def test_cleared_padding_and_fewer_bits_change_nothing(work: WorkFolder, drawn: Path) -> None:
    for side, name in enumerate(("front", "back")):
        path = picture(drawn, name)
        image = pixels(path)
        image[~shown(work)[..., side]] = 0
        if image.dtype == np.uint16:
            image = np.round(image / 257.0).astype(np.uint8)
        put(path, image)
    np.testing.assert_array_equal(apply(drawn, work, RemovalConfig()).mesh.vertices, registered(work))


def test_an_exr_with_halves_and_more_channels_changes_nothing(work: WorkFolder, tmp_path: Path) -> None:
    """As Blender and Nuke write them: 16 bits a channel, with alpha, or in a layer of a name."""
    pytest.importorskip("OpenEXR")
    for halves, layer in (("RGB", ""), ("", "View Layer.Combined."), ("GB", "")):
        folder = tmp_path / f"drawn{halves}"
        folder.mkdir()
        draw(work, FRAME, folder, DrawConfig(TEXELS, "exr"))
        for name in ("front", "back"):
            path = picture(folder, name)
            image = pixels(path)[..., ::-1]
            planes = {
                layer + each: image[..., at].astype(np.float16 if each in halves else np.float32)
                for at, each in enumerate("RGB")
            }
            planes[layer + "A"] = np.ones_like(planes[layer + "R"])
            with OpenEXR.File({"type": OpenEXR.scanlineimage}, planes) as file:
                file.write(str(path))
        np.testing.assert_array_equal(apply(folder, work, RemovalConfig()).mesh.vertices, registered(work))


def test_an_exr_that_the_disk_has_no_room_for_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The library writes what fits and returns as if nothing were."""
    pytest.importorskip("OpenEXR")
    monkeypatch.setattr(OpenEXR.File, "write", lambda _, path: Path(path).write_bytes(b"v/1\x01"))
    with pytest.raises(OSError, match="cannot be read back"):
        write_picture(tmp_path / "front.exr", np.ones((8, 8, 3), np.float32), "exr")
    assert not (tmp_path / "front.exr").exists()


def test_another_program_moves_the_cloth_by_what_it_adds(work: WorkFolder, drawn: Path) -> None:
    """3 cm in blue on both pictures, on cloth alone: everything moves out by 3 cm, borders as well."""
    for side, name in enumerate(("front", "back")):
        path = picture(drawn, name)
        image = pixels(path).astype(np.float64)
        per_cm = 65535 / 64 if path.suffix == ".png" else 1.0
        image[shown(work)[..., side], 0] += 3 * per_cm  # OpenCV's first channel is blue
        put(path, np.round(image).astype(np.uint16) if path.suffix == ".png" else image.astype(np.float32))
    edited = apply(drawn, work, RemovalConfig(enabled=False))
    moved = np.linalg.norm(edited.mesh.vertices - registered(work), axis=1)
    assert edited.moved_share == 1.0
    np.testing.assert_allclose(moved, 0.03, atol=2e-3)


def test_what_is_pressed_into_the_body_is_taken_out(work: WorkFolder, tmp_path: Path) -> None:
    (tmp_path / "flat").mkdir()
    draw(work, FRAME, tmp_path / "flat", DrawConfig(TEXELS))
    deep = {"operations": [{"do": "inflate", "add_cm": -7, "stroke": [[0.3, 0.5]], "radius": 0.15}]}
    (tmp_path / "deep.json").write_text(json.dumps(deep))
    (tmp_path / "pressed").mkdir()
    edit(tmp_path / "flat", tmp_path / "deep.json", work, tmp_path / "pressed")
    inside, out = (apply(tmp_path / "pressed", work, RemovalConfig(enabled=on)).removed for on in (False, True))
    assert inside is not None
    assert out is not None
    assert inside.after.inside_percent > 1
    assert out.after.inside_percent == 0


def test_operations_do_what_they_are_told() -> None:
    mask, rng = np.ones((32, 32, 2), bool), np.random.default_rng(0)
    images, other = rng.standard_normal((2, 32, 32, 6)).astype(np.float32)

    def changed(row: dict) -> np.ndarray:
        (operation,) = parse_operations({"operations": [row]})
        return apply_operation(images, operation, mask, other)

    shifted = changed({"do": "shift", "du_cm": 2, "dv_cm": -1, "side": "back"})
    np.testing.assert_allclose(shifted - images, np.broadcast_to([0, 0, 0, 2, -1, 0], images.shape), atol=1e-6)
    inflated = changed({"do": "inflate", "gain": 1.5, "add_cm": 0.5})
    np.testing.assert_allclose(inflated[..., [2, 5]], 1.5 * images[..., [2, 5]] + 0.5, atol=1e-6)
    painted = changed({"do": "paint", "height_cm": 2, "stroke": [[0.25, 0.75]], "radius": 0.1, "side": "front"})
    height = (painted - images)[..., 2]
    assert np.unravel_index(height.argmax(), height.shape) in ((7, 7), (7, 8), (8, 7), (8, 8))  # v = 0.75 is on top
    assert 1.9 < height.max() < 2
    np.testing.assert_array_equal(painted[..., 3:], images[..., 3:])
    fine = changed({"do": "transfer", "from": "x", "finer_than_texels": 4})
    expected = smoothed(images[..., :3], mask[..., 0], 4) + other[..., :3] - smoothed(other[..., :3], mask[..., 0], 4)
    np.testing.assert_allclose(fine[..., :3], expected, atol=1e-5)
    mask[:16] = False
    np.testing.assert_array_equal(changed({"do": "paint"})[:16], images[:16])
    line = Operation("paint", {}, stroke=((0.1, 0.5), (0.9, 0.5)), radius=0.05)
    row = brush(line, 40)[19:21].mean(axis=0)
    assert row[8:32].min() > 0.9
    assert row[:1].max() < 0.5


def test_a_blur_sees_cloth_alone() -> None:
    mask = np.zeros((20, 20), bool)
    mask[5:15, 5:15] = True
    image = np.where(mask[..., None], 3.0, 100.0) * np.ones(3)
    np.testing.assert_allclose(smoothed(image, mask, 3.0)[mask], 3.0, atol=1e-9)


def test_the_commands_in_a_row(work: WorkFolder, tmp_path: Path, capsys) -> None:
    def run(*words: str) -> str:
        with pytest.raises(SystemExit) as ended:
            main(["offsets", *words])
        said = capsys.readouterr()
        assert ended.value.code == 0, said.err
        return said.out

    folder, place = str(work.path), tmp_path
    run("draw", folder, "--frame", "5", "--texels", "64", "--output", str(place / "a"))
    run("draw", folder, "--frame", "2", "--texels", "64", "--output", str(place / "b"))
    told = [{"do": "paint", "height_cm": 1, "stroke": [[0.3, 0.5]]}, {"do": "transfer", "from": "b", "scale": 1.5}]
    (place / "told.json").write_text(json.dumps({"operations": told}))
    run("edit", str(place / "a"), str(place / "told.json"), folder, "--output", str(place / "c"))
    assert json.loads((place / "c" / "layout.json").read_text())["operations"] == told
    assert "changed" in run("apply", str(place / "c"), folder, "--output", str(place / "c.ply"))
    assert "nothing was changed" in run("apply", str(place / "a"), folder, "--output", str(place / "a.ply"))
    moved = np.linalg.norm(read_mesh(place / "c.ply").mesh.vertices - read_mesh(place / "a.ply").mesh.vertices, axis=1)
    assert 0.005 < moved.max() < 0.03


def test_a_picture_whose_floats_were_clipped_is_refused(work: WorkFolder, drawn: Path) -> None:
    """As a program writes it that takes floats for shares of white; a PNG has no such values."""
    path = picture(drawn)
    if path.suffix == ".png":
        pytest.skip("a PNG holds whole numbers")
    put(path, np.clip(pixels(path), 0, 1))
    with pytest.raises(InputError, match=r"front\.(tif|exr): .*has clipped them; draw with --format png"):
        apply(drawn, work, RemovalConfig())


def test_what_cannot_be_applied_is_told_in_one_line(work: WorkFolder, drawn: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    for name, change, expected in (
        ("layout.json", {"registration": "0"}, "expected pictures of the registration"),
        ("layout.json", {"texels": 32}, "expected offsets and two pictures of 32 texels"),
        ("layout.json", {"frame": 99}, "found none with number 99"),
        ("layout.json", {"format": "psd"}, "expected tif, exr, png, found 'psd'"),
    ):
        shutil.copytree(drawn, copy)
        notes = json.loads((copy / name).read_text())
        (copy / name).write_text(json.dumps(notes | change))
        with pytest.raises(InputError, match=expected):
            apply(copy, work, RemovalConfig())
        shutil.rmtree(copy)
    small = cv2.resize(pixels(picture(drawn)), (32, 32))
    for image, expected in (
        (small, "expected 64 x 64 texels"),
        (None, "no such file"),
        (b"", "three channels|an EXR, found none"),
    ):
        shutil.copytree(drawn, copy)
        path = picture(copy)
        if isinstance(image, np.ndarray):
            put(path, image)
        elif image is None:
            path.unlink()
        else:
            path.write_bytes(image)
        with pytest.raises(InputError, match=f"front.*{expected}"):
            apply(copy, work, RemovalConfig())
        shutil.rmtree(copy)
    for row, expected in (
        ({"do": "melt"}, r"operations\[0\]\.do: expected shift, inflate, paint, transfer, found 'melt'"),
        ({"do": "paint", "du_cm": 1}, "found 'du_cm'"),
        ({"do": "paint", "stroke": [1]}, "a list of places"),
        ({"do": "paint", "radius": 0}, "above 0"),
        ({"do": "transfer"}, "the folder of another drawn frame"),
        ({"do": "shift", "side": "left"}, "expected front, back, both"),
    ):
        with pytest.raises(InputError, match=expected):
            parse_operations({"operations": [row]})
