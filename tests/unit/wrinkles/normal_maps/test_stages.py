"""The wrinkle commands on folders: what they write, how they resume, and what they say about bad input."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from scipy.spatial.transform import Rotation

from capture4d.captures.work_folder import load_registration
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_bytes, write_json, write_npy, write_npz
from capture4d.files.records import load_garment, save_garment
from capture4d.files.tensors import read_tensors, write_tensors
from capture4d.geometry.mesh import submesh
from capture4d.geometry.uv_raster import sample_bilinear
from capture4d.runs.stage import open_stage
from capture4d.types import Garment, Mesh
from tests.command_line import fails, run
from tests.unit.wrinkles.conftest import (
    from_tangent,
    make_work,
    outside_the_unit_square,
    some_garment,
    some_scan,
    wrinkle_normals,
)
from wrinkles.normal_maps import pair_files, train_stage
from wrinkles.normal_maps.config import MapConfig
from wrinkles.normal_maps.display import fill_holes
from wrinkles.normal_maps.inference import KIND, load_model
from wrinkles.normal_maps.spaces import decode_png, encode_png
from wrinkles.normal_maps.template import MapTemplate
from wrinkles.normal_maps.wrinkle_maps import MapMaker, wrinkle_map

SMALL = ["--pairs.map.size", "64", "--texels", "32", "--network.filters", "4", "--network.layers", "5",
         "--schedule.steps", "6", "--schedule.checkpoint-every", "2", "--schedule.sample-every", "3",
         "--schedule.log-every", "2", "--schedule.batch", "2", "--held-out", "0.2", "--workers", "1"]  # fmt: skip


def train(work: Path, model: Path, *more: str) -> tuple[str | Path, ...]:
    return "wrinkles", "train", work, "--output", model, *SMALL, *more


@pytest.fixture(scope="module")
def trained_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A work folder and a model trained on it, to be copied."""
    folder = tmp_path_factory.mktemp("trained")
    work = make_work(folder, some_garment(), [some_scan(phase=0.3 * frame) for frame in range(6)])
    assert run(*train(work, folder / "model")) == 0
    return folder


@pytest.fixture
def trained(trained_once: Path, tmp_path: Path) -> Path:
    """A trained model, and the work folder it learned from at `work` beside it."""
    shutil.copytree(trained_once, tmp_path, dirs_exist_ok=True)
    return tmp_path / "model"


@pytest.fixture
def unfinished(trained: Path) -> Path:
    """The model, stopped after its last checkpoint."""
    record = read_json(trained / "stage.json")
    write_json(trained / "stage.json", {**record, "status": "running"})
    return trained


@pytest.fixture
def work(trained_once: Path, tmp_path: Path) -> Path:
    """The work folder without its maps."""
    shutil.copytree(trained_once / "capture", tmp_path / "capture", dirs_exist_ok=True)
    shutil.copytree(trained_once / "work", tmp_path / "work", dirs_exist_ok=True)
    shutil.rmtree(tmp_path / "work" / "wrinkles")
    return tmp_path / "work"


# --- maps


def test_maps_are_written_as_they_were_computed(work: Path, garment: Garment):
    assert run("wrinkles", "maps", work, "--pairs.map.size", "128", "--workers", "1") == 0
    pairs = work / "wrinkles" / "pairs"
    assert [path.name for path in sorted((pairs / "high").iterdir())] == [f"{frame:06d}.png" for frame in range(1, 7)]
    template = MapTemplate.create(garment, MapConfig(size=128))
    np.testing.assert_array_equal(load_garment(pairs / "template.npz").template.uv, template.mesh.uv)
    high, valid = decode_png((pairs / "high" / "000001.png").read_bytes(), source="high")
    low, shown = decode_png((pairs / "low" / "000001.png").read_bytes(), source="low")
    # the template has not moved, so garment coordinates are the world's
    points = template.raster.at_vertices(garment.template.vertices.astype(float))
    truth = wrinkle_normals(points)
    known = template.raster.read(valid) & template.raster.inside
    error = np.degrees(np.arccos(np.clip((template.raster.read(high) * truth).sum(1), -1, 1)))[known]
    assert error.mean() < 3.5  # the phase moves on by a twentieth of a wave between the frames averaged
    assert known.sum() > 0.9 * template.raster.inside.sum()
    np.testing.assert_allclose(template.raster.read(low), template.low_normals(garment.template.vertices), atol=1e-4)
    assert template.raster.read(shown).all()
    measured = json.loads((pairs / "metrics" / "000001.json").read_text())
    assert 8 < measured["difference_deg"] < 11


@pytest.mark.parametrize("which", ["low", "high"])
def test_maps_lost_are_made_again_alike(work: Path, which: str):
    arguments = ("wrinkles", "maps", work, "--pairs.map.size", "64", "--workers", "1")
    assert run(*arguments) == 0
    path = work / "wrinkles" / "pairs" / which / "000003.png"
    before = path.read_bytes()
    path.unlink()
    assert run(*arguments) == 0
    assert path.read_bytes() == before


TURN = Rotation.from_euler("xyz", [5, 20, 10], degrees=True).as_matrix()


def turned_copy(work: Path, folder: Path, frame_ids: list[int]) -> Path:
    """The garment as a bad model has it, turned, in some of the frames; no scans: as an animation is. Its template is a
    learned mean, which lies a bit otherwise than the take's."""
    garment = load_garment(work / "registration" / "garment.npz")
    vertices = (garment.template.vertices @ TURN.T + [0, 0.01, 0]).astype(np.float32)
    at_rest = garment.template.vertices @ Rotation.from_euler("z", 3, degrees=True).as_matrix()
    garment = replace(garment, template=garment.template.with_vertices(at_rest.astype(np.float32)))
    placed = open_stage(folder / "registration", name="animate", schema=1, config=None, upstream={})
    save_garment(placed.path / "garment.npz", garment)
    for frame_id in frame_ids:
        write_npz(placed.frame_path(frame_id), vertices=vertices, residual_m=np.full(len(vertices), np.nan, np.float32))
    write_npy(placed.path / "vertices.npy", np.tile(vertices, (len(frame_ids), 1, 1)))
    placed.finish([placed.path / "vertices.npy"])
    return folder


def test_an_animation_borrows_the_high_maps_of_the_take_it_follows(
    work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The low map is its own; the high one says the same in the world as that of the take."""
    size = ("--pairs.map.size", "64", "--workers", "1")
    animated = turned_copy(work, tmp_path / "animated", [2, 3, 9])
    arguments = ("wrinkles", "maps", animated, "--high-from", work, *size)
    missing = f"{work / 'wrinkles' / 'pairs'}: expected the output of 'wrinkles maps', found none"
    assert fails(capsys, *arguments) == f"{missing}; run: capture4d wrinkles maps {work}"
    assert run("wrinkles", "maps", work, *size) == 0
    assert run(*arguments) == 0
    theirs, ours = work / "wrinkles" / "pairs", animated / "wrinkles" / "pairs"
    assert [path.name for path in sorted((ours / "high").iterdir())] == ["000002.png", "000003.png"]
    for folder, turn in (("low", np.eye(3)), ("high", TURN.T)):  # the take's template has not moved
        found, wanted = (
            decode_png((pairs / folder / "000003.png").read_bytes(), source="") for pairs in (ours, theirs)
        )
        np.testing.assert_array_equal(found[1], wanted[1])
        np.testing.assert_allclose(found[0][found[1]] @ turn, wanted[0][found[1]], atol=2e-4)
    (ours / "high" / "000003.png").unlink()
    assert run(*arguments) == 0  # only what is missing
    other = turned_copy(work, tmp_path / "other", [20, 21])
    assert "expected frames of" in fails(capsys, "wrinkles", "maps", other, "--high-from", work, *size)
    larger = turned_copy(work, tmp_path / "larger", [2])
    said = fails(capsys, "wrinkles", "maps", larger, "--high-from", work, "--pairs.map.size", "128")
    assert "expected a map of 128 texels, found 64" in said


# --- training and use


def test_a_model_is_trained_measured_and_applied(work: Path, trained: Path, garment: Garment):
    rows = [json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [2, 4, 6]
    assert set(rows[0]) == {"step", "data", "temporal", "gan", "discriminator"}
    assert sorted(path.name for path in (trained / "samples").iterdir()) == ["000003.png", "000006.png"]
    assert len(list((trained / "checkpoints").iterdir())) == 2
    measured = json.loads((trained / "held_out.json").read_text())["work"]
    assert measured["low"]["normal_error_deg"] > 3  # 20 mm texels blur waves of 50 mm

    assert run("wrinkles", "apply", trained, work, "--workers", "1") == 0
    made = work / "wrinkles" / "generated"
    image, _ = decode_png((made / "frames" / "000002.png").read_bytes(), source="made")
    template = MapTemplate.create(garment, MapConfig(size=64))
    tangent = template.raster.read(image)
    np.testing.assert_allclose(np.linalg.norm(tangent, axis=1), 1, atol=1e-3)
    assert tangent[:, 2].mean() > 0.7
    world = from_tangent(tangent, template.frames(garment.template.vertices))
    assert (world * template.low_normals(garment.template.vertices)).sum(1).mean() > 0.7
    assert np.load(made / "tangents.npy").shape == (len(garment.template.faces), 3, 4)


def test_a_map_as_an_array_is_the_map_as_a_file(work: Path, trained: Path, garment: Garment):
    assert run("wrinkles", "apply", trained, work, "--workers", "1") == 0
    frames = work / "wrinkles" / "generated" / "frames"
    written = [decode_png((frames / f"{frame:06d}.png").read_bytes(), source="made")[0] for frame in (1, 2)]
    vertices = load_registration(work / "registration").vertices[:2]
    made = wrinkle_map(trained, vertices)
    assert made.dtype == np.float32
    assert made.shape == (2, 64, 64, 3)
    np.testing.assert_allclose(made, written, atol=1.01 / 65535)  # half a step of 16 bit, and what rounding adds
    one = wrinkle_map(load_model(trained), vertices[1], template=garment)
    np.testing.assert_array_equal(one, made[1])
    with pytest.raises(InputError, match=r"vertices: expected \(frames, 768, 3\) or \(768, 3\), found \(5, 3\)"):
        wrinkle_map(trained, vertices[0, :5])


def test_a_model_that_kept_no_template_wants_one(work: Path, trained: Path, garment: Garment):
    """As earlier versions wrote them."""
    vertices = load_registration(work / "registration").vertices[0]
    wanted = wrinkle_map(trained, vertices)
    path = trained / "generator.safetensors"
    file = read_tensors(path, KIND)
    kept = {name: each for name, each in file.tensors.items() if name not in ("faces", "uv")}
    write_tensors(path, KIND, kept, {name: each for name, each in file.note.items() if name != "kind"})
    with pytest.raises(InputError, match="template: expected one"):
        wrinkle_map(trained, vertices)
    np.testing.assert_array_equal(wrinkle_map(trained, vertices, template=garment), wanted)
    turned = Mesh(garment.template.vertices, garment.template.faces[::-1].copy(), garment.template.uv)
    with pytest.raises(InputError, match="template: expected the one that the network was trained on"):
        wrinkle_map(trained, vertices, template=replace(garment, template=turned))
    assert run("wrinkles", "apply", trained, work, "--workers", "1") == 0


def test_folders_of_stages_that_had_other_names_are_gone_on_with(work: Path, trained: Path):
    assert run("wrinkles", "maps", work, "--pairs.map.size", "64", "--workers", "1") == 0
    assert run("wrinkles", "apply", trained, work, "--workers", "1") == 0
    before = {}
    for folder, name, former in (
        (work / "wrinkles" / "pairs", "wrinkles maps", "pairs"),
        (trained, "wrinkles train", "train-wrinkles"),
        (work / "wrinkles" / "generated", "wrinkles apply", "wrinkles"),
    ):
        record = json.loads((folder / "stage.json").read_text())
        assert record["stage"] == name
        (folder / "stage.json").write_text(json.dumps(record | {"stage": former}))
        before[folder] = record["digest"]
    frame = work / "wrinkles" / "generated" / "frames" / "000001.png"
    made = frame.stat().st_mtime_ns
    assert run(*train(work, trained)) == 0
    assert run("wrinkles", "maps", work, "--pairs.map.size", "64", "--workers", "1") == 0
    assert run("wrinkles", "apply", trained, work, "--workers", "1") == 0
    assert frame.stat().st_mtime_ns == made
    for folder, digest in before.items():
        assert json.loads((folder / "stage.json").read_text())["digest"] == digest


def test_a_training_opens_the_maps_of_a_take_once(work: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert run("wrinkles", "maps", work, "--pairs.map.size", "64", "--workers", "1") == 0
    opened: list[str] = []

    def counting(path: Path) -> Garment:
        opened.append(Path(path).name)
        return load_garment(path)

    monkeypatch.setattr(pair_files, "load_garment", counting)
    assert run(*train(work, tmp_path / "again")) == 0
    assert opened == ["template.npz"]


def test_green_is_flipped_on_demand_and_delivery_is_8_bit(work: Path, trained: Path):
    import cv2

    frame = work / "wrinkles" / "generated" / "frames" / "000001.png"
    assert run("wrinkles", "apply", trained, work, "--workers", "1") == 0
    up, _ = decode_png(frame.read_bytes(), source="up")
    assert run("wrinkles", "apply", trained, work, "--workers", "1", "--flip-green", "--overwrite") == 0
    down, _ = decode_png(frame.read_bytes(), source="down")
    np.testing.assert_allclose(down, up * np.array([1, -1, 1]), atol=1e-4)
    assert run("wrinkles", "apply", trained, work, "--workers", "1", "--bits", "8", "--overwrite") == 0
    pixels = cv2.imread(str(frame), cv2.IMREAD_UNCHANGED)
    assert pixels.dtype == np.uint8
    assert np.abs(pixels[..., ::-1] / 127.5 - 1 - up).max() < 0.01


@pytest.mark.parametrize("texels", [64, 100, 256])
def test_maps_come_in_the_size_that_is_wanted(work: Path, trained: Path, texels: int):
    """What the network says is the same at every size; what the garment says is exact."""
    assert run("wrinkles", "apply", trained, work, "--workers", "1", "--texels", texels) == 0
    frame = work / "wrinkles" / "generated" / "frames" / "000001.png"
    image = decode_png(frame.read_bytes(), source="map")[0]
    assert image.shape == (texels, texels, 3)
    vertices = np.array(load_registration(work / "registration").vertices[0])
    np.testing.assert_allclose(image, wrinkle_map(trained, vertices, texels=texels), atol=1e-4)
    kept = load_model(trained)
    large = MapMaker.create(kept, MapTemplate.laid_out(kept.template, kept.maps), texels=texels)
    small = MapMaker.create(kept, MapTemplate.laid_out(kept.template, kept.maps))
    uv = np.random.default_rng(0).uniform(0.1, 0.3, (200, 2))  # well within the first island
    found, wanted = (
        sample_bilinear(maker.template.raster.image(maker.normals(vertices)), uv) for maker in (large, small)
    )
    assert np.degrees(np.linalg.norm(found - wanted, axis=1)).max() < 3


def test_a_network_without_anything_to_say_leaves_maps_flat_at_every_size(trained: Path, work: Path):
    kept = load_model(trained)
    for weights in kept.generator.up[-1].parameters():
        weights.data.zero_()
    vertices = np.array(load_registration(work / "registration").vertices[0])
    for texels in (64, 300):
        off = np.abs(wrinkle_map(kept, vertices, texels=texels) - [0, 0, 1]).max(axis=-1)
        raster = MapTemplate.laid_out(kept.template, kept.maps.sized(texels)).raster
        shown = off[raster.image(raster.inside)]
        assert np.quantile(shown, 0.8) < 1e-6
        assert shown.max() < 0.05  # beside seams, where both sides are made alike
        assert off.max() < 0.1  # beyond the corners of an island, where seams end


def test_sizes_that_cannot_be_are_one_line(work: Path, trained: Path, tmp_path: Path, capsys):
    for texels in (15, 4097):
        line = fails(capsys, "wrinkles", "apply", trained, work, "--workers", "1", "--texels", texels)
        assert f"texels: expected from 16, so that the layout's islands stay apart, to 4096, found {texels}" in line
    assert not (work / "wrinkles" / "generated").exists()
    assert run("wrinkles", "maps", work, "--texels", "128", "--pairs.map.size", "64", "--workers", "1") == 2
    line = capsys.readouterr().err
    assert "--texels: expected the 64 of --pairs.map.size, or one of the two alone, found 128" in line
    line = fails(capsys, *train(work, tmp_path / "x", "--crop", "48"))
    assert "crop: expected at most the 32 texels of the maps, found 48" in line
    assert run("wrinkles", "maps", work, "--texels", "64", "--overwrite", "--workers", "1") == 0
    assert read_json(work / "wrinkles" / "pairs" / "stage.json")["config"]["map"]["padding"] == 1
    line = fails(capsys, "wrinkles", "train", work, "--output", tmp_path / "x", "--texels", "128", "--workers", "1")
    assert (
        f"expected maps of 128 texels times a power of two, found 64; run: capture4d wrinkles maps {work} --texels "
        in line
    )
    assert line.endswith("--texels 256 --overwrite")


def test_a_network_learns_from_squares_and_is_asked_by_squares(work: Path, tmp_path: Path):
    """Maps large enough are made for it."""
    model = tmp_path / "squares"
    more = ("--texels", "512", "--crop", "32", "--network.filters", "4", "--network.layers", "5", "--held-out", "0.2",
            "--schedule.steps", "4", "--schedule.sample-every", "4", "--workers", "1")  # fmt: skip
    assert run("wrinkles", "train", work, "--output", model, *more) == 0
    assert read_json(work / "wrinkles" / "pairs" / "stage.json")["config"]["map"]["size"] == 512
    kept = load_model(model)
    assert (kept.texels, kept.crop, kept.maps.padding) == (512, 32, 8)
    vertices = np.array(load_registration(work / "registration").vertices[0])
    template = MapTemplate.laid_out(kept.template, kept.maps)
    low = torch.from_numpy(template.raster.image(template.low_normals(vertices))).permute(2, 0, 1)
    added = kept.added(low)
    assert added.shape == low.shape
    assert not added[:, ~(low != 0).any(dim=0)].any()
    assert wrinkle_map(model, vertices).shape == (512, 512, 3)


def test_many_maps_lie_in_a_file_and_read_the_same(work: Path, monkeypatch: pytest.MonkeyPatch):
    assert run("wrinkles", "maps", work, "--pairs.map.size", "64", "--workers", "1") == 0
    folder = pair_files.open_pairs(work)
    there = sorted(path.name for path in folder.path.iterdir())
    wanted = folder.read(32)
    monkeypatch.setattr(pair_files, "MAPPED_FROM", 1000)
    found = folder.read(32)
    assert found.low.untyped_storage().nbytes() == wanted.low.untyped_storage().nbytes()
    for name in ("low", "high", "valid"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name), rtol=0, atol=0)
    assert sorted(path.name for path in folder.path.iterdir()) == there


def test_maps_of_an_animation_do_not_hang_on_its_template(work: Path, trained: Path, tmp_path: Path):
    """What the network sees refers to the template it was trained on."""
    animated = turned_copy(work, tmp_path / "animated", [1])
    again = turned_copy(work, tmp_path / "again", [1])
    garment = load_garment(work / "registration" / "garment.npz")
    save_garment(again / "registration" / "garment.npz", garment)
    for folder in (animated, again):
        assert run("wrinkles", "apply", trained, folder, "--workers", "1") == 0
    found, wanted = (
        decode_png((folder / "wrinkles" / "generated" / "frames" / "000001.png").read_bytes(), source="")[0]
        for folder in (animated, again)
    )
    np.testing.assert_allclose(found, wanted, atol=1e-3)


def test_a_model_keeps_the_layout_of_its_maps(tmp_path: Path):
    """Islands that were packed with another padding lie elsewhere."""
    garment = outside_the_unit_square(some_garment())
    layouts = [MapTemplate.create(garment, MapConfig(size=64, padding=padding)).mesh.uv for padding in (4, 6)]
    assert not np.array_equal(*layouts)
    work, model = (
        make_work(tmp_path, garment, [some_scan(phase=0.3 * frame) for frame in range(6)]),
        tmp_path / "padded",
    )
    assert run(*train(work, model, "--pairs.map.padding", "6", "--schedule.steps", "2")) == 0
    assert run("wrinkles", "apply", model, work, "--workers", "1") == 0
    made = load_garment(work / "wrinkles" / "generated" / "template.npz").template
    np.testing.assert_array_equal(made.uv, load_garment(work / "wrinkles" / "pairs" / "template.npz").template.uv)
    np.testing.assert_array_equal(made.uv, layouts[1])


def interrupt_the_fourth_step(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Ctrl-C once, in the fourth step that is begun; gets a number for each."""
    step, begun = train_stage.train_step, []

    def stopping(*arguments: object) -> dict[str, float]:
        begun.append(len(begun))
        if len(begun) == 4:
            raise KeyboardInterrupt
        return step(*arguments)  # pyright: ignore

    monkeypatch.setattr(train_stage, "train_step", stopping)
    return begun


@pytest.mark.parametrize("log_every", [2, 3])
def test_an_interrupted_training_ends_with_the_same_weights(
    work: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, log_every: int
):
    if log_every != 2:  # a line of the log spans a checkpoint
        assert run(*train(work, tmp_path / "whole", "--schedule.log-every", "3")) == 0
        trained = tmp_path / "whole"
    more = ("--schedule.log-every", str(log_every))
    interrupt_the_fourth_step(monkeypatch)
    assert run(*train(work, tmp_path / "again", *more)) == 130
    assert run(*train(work, tmp_path / "again", *more)) == 0
    for name in ("generator.safetensors", "checkpoints/000006.safetensors", "metrics.jsonl", "samples/000006.png"):
        assert (tmp_path / "again" / name).read_bytes() == (trained / name).read_bytes(), name


def test_a_long_training_is_saved_by_the_clock_too(
    work: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    rarely = ("--schedule.checkpoint-every", "100", "--schedule.checkpoint-s", "0")
    done = interrupt_the_fourth_step(monkeypatch)
    assert run(*train(work, tmp_path / "again", *rarely)) == 130
    assert run(*train(work, tmp_path / "again", *rarely)) == 0
    assert len(done) == 4 + 3, "three of the six steps were kept"
    name = "generator.safetensors"
    assert (tmp_path / "again" / name).read_bytes() == (trained / name).read_bytes()


@pytest.mark.slow
def test_a_killed_training_ends_with_the_same_weights(work: Path, tmp_path: Path):
    more = ("--schedule.steps", "60")
    assert run(*train(work, tmp_path / "whole", *more)) == 0
    command = [sys.executable, "-m", "capture4d", *map(str, train(work, tmp_path / "killed", *more))]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    while not list((tmp_path / "killed").glob("checkpoints/*.safetensors")):
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    subprocess.run(command, check=True, capture_output=True)
    name = "generator.safetensors"
    assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


# --- bad input: one line, exit 1


def test_a_checkpoint_of_another_architecture(
    work: Path, unfinished: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    trained = unfinished
    other = tmp_path / "other"
    assert run(*train(work, other, "--network.filters", "2")) == 0
    last = "checkpoints/000006.safetensors"
    (trained / last).write_bytes((other / last).read_bytes())
    line = fails(capsys, *train(work, trained))
    assert f"{trained / last}: weights of another architecture: 'down.0.0.weight', expected (4, " in line
    assert line.endswith("; to start anew: capture4d wrinkles train ... --overwrite")
    damaged = (trained / "generator.safetensors").read_bytes()[:-100]
    (trained / "generator.safetensors").write_bytes(damaged)
    assert "generator.safetensors: not a readable safetensors" in fails(capsys, "wrinkles", "apply", trained, work)
    assert "expected a wrinkle generator" in fails(capsys, "wrinkles", "apply", other / last, work)
    assert "no such file" in fails(capsys, "wrinkles", "apply", tmp_path / "nowhere", work)


def test_the_newest_checkpoint_is_the_one_with_the_most_steps(work: Path, unfinished: Path):
    """Past a million steps names are longer, and text sorts them wrongly."""
    folder = unfinished / "checkpoints"
    (folder / "000006.safetensors").rename(folder / "1000000.safetensors")
    (folder / "000004.safetensors").rename(folder / "999500.safetensors")
    (folder / "999500.safetensors").write_bytes(b"damaged")
    assert run(*train(work, unfinished)) == 0


def test_a_finished_model_needs_no_checkpoint(work: Path, trained: Path):
    """Nor does it matter in which earlier layout there is one."""
    before = {name: (trained / name).read_bytes() for name in ("generator.safetensors", "held_out.json")}
    digest = read_json(trained / "stage.json")["digest"]
    for path in (trained / "checkpoints").iterdir():
        path.write_bytes(b"of an earlier version")
    assert run(*train(work, trained)) == 0
    assert {name: (trained / name).read_bytes() for name in before} == before
    assert read_json(trained / "stage.json")["digest"] == digest


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("--texels", "24"), "expected maps of 24 texels times a power of two, found 64"),
        (("--schedule.log-every", "0"), "--schedule.log-every: expected at least 1, found 0"),
        (("--network.layers", "9"), "network.layers: expected at most 5"),
        (("--held-out", "1"), "--held-out: expected from 0 to below 1, found 1"),
        (("--held-out-gap", "-5"), "--held-out-gap: expected at least 0, found -5"),
        (("--schedule.learning-rate", "-1"), "--schedule.learning-rate: expected a positive number, found -1"),
        (("--schedule.beta1", "1.5"), "--schedule.beta1: expected from 0 to below 1, found 1.5"),
        (("--workers", "0"), "--workers: expected at least 1, found 0"),
        (("--pairs.map.size", "0"), "--pairs.map.size: expected at least 1, found 0"),
        (
            ("--pairs.projection.distance-m", "nan"),
            "--pairs.projection.distance-m: expected a finite number, found nan",
        ),
    ],
)
def test_settings_out_of_range_leave_nothing_behind(
    work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: tuple[str, str], said: str
):
    assert said in fails(capsys, *train(work, tmp_path / "model", *wrong))
    assert not (tmp_path / "model" / "stage.json").exists()


def test_damaged_notes_are_named(work: Path, unfinished: Path, capsys: pytest.CaptureFixture[str]):
    (unfinished / "metrics.jsonl").write_text('{"step": 2}\n{"step"')
    assert "metrics.jsonl: line 2: not valid JSON" in fails(capsys, *train(work, unfinished))
    (work / "registration" / "metrics.jsonl").write_text("[1]\n")
    line = fails(capsys, "wrinkles", "maps", work, "--pairs.map.size", "32", "--overwrite", "--workers", "1")
    assert "metrics.jsonl: line 1: expected a JSON object, found list" in line


def test_a_checkpoint_that_cannot_be_continued(work: Path, unfinished: Path, capsys: pytest.CaptureFixture[str]):
    path = unfinished / "checkpoints" / "000006.safetensors"
    whole = path.read_bytes()
    earlier = safetensors.torch.save({"step": torch.tensor(6)})  # as versions wrote them that had another format
    for written, said in ((whole[:-10], "cut off or damaged"), (earlier, "expected capture4d wrinkle training, found")):
        path.write_bytes(written)
        line = fails(capsys, *train(work, unfinished))
        assert f"{path}: " in line
        assert said in line
        assert line.endswith("to start anew: capture4d wrinkles train ... --overwrite")


def test_a_mask_of_another_size(work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run("wrinkles", "maps", work, "--pairs.map.size", "64", "--workers", "1") == 0
    path = work / "wrinkles" / "pairs" / "high" / "000002.png"
    image = np.zeros((32, 32, 3), np.float32)
    write_bytes(path, encode_png(image, np.ones((32, 32), bool)))
    line = fails(capsys, *train(work, tmp_path / "model"))
    assert "000002.png: expected a map and a mask of 64 x 64 texels, found 32 x 32" in line


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda uv: None, "expected UVs, found none"),
        (lambda uv: 3 * uv, "expected UVs in the unit square"),
        (lambda uv: 0 * uv, "expected UVs that spread the surface out"),
        (lambda uv: np.where(uv[..., :1] > 0.35, uv - np.float32([0.4, 0]), uv) * np.float32(0.5), "used twice"),
    ],
    ids=["no UVs", "outside the unit square", "no area", "overlapping islands"],
)
def test_uvs_that_make_no_map(
    tmp_path: Path, garment: Garment, scan_of: Callable[..., Mesh], capsys: pytest.CaptureFixture[str],
    change: Callable[[np.ndarray], np.ndarray | None], said: str,
):  # fmt: skip
    mesh = garment.template
    assert mesh.uv is not None
    changed = Mesh(mesh.vertices, mesh.faces, change(mesh.uv))
    bad = make_work(tmp_path, replace(garment, template=changed), [scan_of()])
    assert said in fails(capsys, "wrinkles", "maps", bad, "--workers", "1")
    assert said in fails(capsys, *train(bad, tmp_path / "model"))


def test_a_model_for_another_template(work: Path, trained: Path, garment: Garment, capsys: pytest.CaptureFixture[str]):
    mesh = garment.template
    assert mesh.uv is not None
    moved = Mesh(mesh.vertices, mesh.faces, mesh.uv * np.float32(0.9))
    save_garment(work / "registration" / "garment.npz", replace(garment, template=moved))
    assert "expected the template that" in fails(capsys, "wrinkles", "apply", trained, work)


def test_what_is_missing_is_named(tmp_path: Path, work: Path, capsys: pytest.CaptureFixture[str]):
    assert "expected a work folder with a registration" in fails(capsys, "wrinkles", "maps", tmp_path / "nothing")
    (work / "garment" / "stage.json").unlink()
    assert "extract" in fails(capsys, "wrinkles", "maps", work)


def test_the_group_has_an_overview(capsys: pytest.CaptureFixture[str]):
    assert run("wrinkles", "--help") == 0
    said = capsys.readouterr().out
    assert "wrinkles train" in said
    assert "register-mesh" not in said
    assert run("wrinkles") == 2
    assert run("wrinkles", "trian") == 2
    assert "did you mean 'wrinkles train'" in capsys.readouterr().err


def test_filling_is_for_display_only(tmp_path: Path, garment: Garment):
    """A hole in a scan stays a hole in the pairs; only what is shown has none."""
    scan, centre = some_scan(), np.array([0.1, 0.25, 0])
    away = np.linalg.norm(scan.vertices[scan.faces].mean(axis=1) - centre, axis=1)
    work = make_work(tmp_path, garment, [submesh(scan, away > 0.04)[0]])
    assert run("wrinkles", "maps", work, "--pairs.map.size", "64", "--workers", "1") == 0
    high, valid = decode_png((work / "wrinkles" / "pairs" / "high" / "000001.png").read_bytes(), source="high")
    raster = MapTemplate.create(garment, MapConfig(size=64)).raster
    hole = np.linalg.norm(raster.at_vertices(garment.template.vertices.astype(float)) - centre, axis=1) < 0.03
    assert (hole & raster.inside).sum() > 5
    assert not raster.read(valid)[hole].any()
    assert raster.read(valid)[raster.inside].mean() > 0.8
    assert np.abs(high[~valid]).max() < 1e-4
    assert np.linalg.norm(fill_holes(high, valid)[~valid], axis=-1).min() > 0
