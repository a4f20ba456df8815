"""Offsets learned from folders of drapes: what is kept, that a stopped training is the same, motion, bad input."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from capture4d.body.binding import bind
from capture4d.captures.animations.config import RemovalConfig
from capture4d.captures.drapes.drape_parts import mirrored_drapes, read_drape_parts
from capture4d.captures.drapes.drape_sets import read_drapes
from capture4d.captures.work_folder import open_work
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_json, write_npz
from capture4d.files.records import save_body, save_garment, save_poses
from capture4d.runs.stage import open_stage
from capture4d.types import Body, Mesh, PoseSequence
from tests.command_line import fails, run
from tests.unit.wrinkles.conftest import some_garment
from tests.unit.wrinkles.offset_images.test_layout import bent, limb, upright
from wrinkles.offset_images import predict_stage, resumable, train_stage
from wrinkles.offset_images.config import (
    PRESETS,
    DrapeOffsetsConfig,
    OffsetTrainingConfig,
    PatchConfig,
    PredictOffsetsConfig,
    StripConfig,
)
from wrinkles.offset_images.drape_lessons import drape_lesson
from wrinkles.offset_images.drape_model import load_drape_offsets, save_model_parts
from wrinkles.offset_images.frames import vertex_errors_cm
from wrinkles.offset_images.layout import OffsetLayout, decode

COUNT = 20
TRAINING = OffsetTrainingConfig(epochs=4, checkpoint_every=2, half_precision=False)
PATCHES = DrapeOffsetsConfig(
    network="patches", texels=32, mirrored=False, patch=PatchConfig(count=2, texels=32, context=2, channels=16),
    training=TRAINING,
)  # fmt: skip


def write_drapes(folder: Path, *, flat: bool = False) -> Path:
    """A sleeve around a limb that bends by an angle, and bulges by it; or, flat, half of it: a strip."""
    body, garment = limb(), some_garment()
    body = replace(body, joint_names=("root", "elbow.L"))
    if flat:
        mesh = garment.template
        assert mesh.uv is not None
        kept = mesh.vertices[mesh.faces].mean(axis=1)[:, 0] > 0.08
        used, faces = np.unique(mesh.faces[kept], return_inverse=True)
        garment = replace(
            garment, loops={}, template=Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), mesh.uv[kept])
        )
    at, weights, skin = bind(garment.template.vertices, garment.template.faces, upright(body))
    garment = replace(garment, embedding_faces=at, embedding_barycentric=weights, skin_weights=skin.astype(np.float32))
    layout = OffsetLayout.create(garment, 32)
    angles = np.linspace(-0.8, 0.8, COUNT)
    vertices, rotations = [], []
    for angle in angles:
        posed = bent(body, angle)
        anchors = layout.anchors(posed)
        height = garment.template.vertices[layout.vertex, 1:2]
        vertices.append(layout.vertices(decode(anchors, [0, 0, 1] * (0.05 + 0.03 * angle * np.sin(12 * height)))))
        rotations.append(posed.rotations)
    moved = np.array(vertices) - (0.1, 0.2, 0.3)  # `bent` moves the root, a drape does not
    stage = open_stage(folder, name="synth-drapes", schema=1, config={}, upstream={})
    numbers = np.arange(COUNT, dtype=np.int32) + 1
    write_npz(
        folder / "shards" / "000001.npz", drapes=numbers, rotations=np.array(rotations, np.float32),
        vertices=moved.astype(np.float32), kept=np.ones(COUNT, bool),
    )  # fmt: skip
    save_garment(folder / "garment.npz", garment)
    save_body(folder / "body.npz", body)
    count = len(garment.template.vertices)
    about = {"garment": "tube", "style": {"size": 1.0}, "shape": [0.0], "moved_joints": ["elbow.L"]}
    write_json(folder / "drapes.json", {**about, "mirror": list(range(count))})
    parts = {"test": [3, 9, 15], "validation": [6, 12]}
    held = {*parts["test"], *parts["validation"]}
    write_json(folder / "split.json", {**parts, "train": [k for k in numbers.tolist() if k not in held]})
    stage.finish([folder / "drapes.json"])
    return folder


@pytest.fixture(scope="module")
def drapes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drapes(tmp_path_factory.mktemp("drapes") / "set")


@pytest.fixture(scope="module")
def learned(drapes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train_stage.run(drapes, tmp_path_factory.mktemp("learned") / "patches", PATCHES).path


def contents(folder: Path) -> dict[str, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name != "stage.json")
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


@pytest.mark.parametrize("network", ["direct", "pca", "kernels", "over kernels", "with kernels"])
def test_a_bending_sleeve_is_learned(drapes: Path, tmp_path: Path, network: str):
    """Far better than its mean; what is written is what is read: the errors are those of the vertices."""
    config = DrapeOffsetsConfig(
        network="pca", texels=32, components=4, mirrored=False, residual=network == "over kernels",
        partner=network == "with kernels",
        training=OffsetTrainingConfig(epochs=100, patience=100, batch=8, half_precision=False),
    )  # fmt: skip
    if network in ("direct", "kernels"):
        config = replace(config, network=network)  # pyright: ignore
    result = train_stage.run(drapes, tmp_path / "model", config)
    test = read_json(result.path / "errors.json")["test"]
    assert test["vertex_cm"] < 0.4 * test["mean_vertex_cm"]
    found = read_drapes(drapes)
    rows = read_drape_parts(drapes, found).test
    poses = PoseSequence(
        found.rotations[rows], np.zeros((len(rows), 3), np.float32), np.zeros(1, np.float32), found.numbers[rows], 60.0,
        found.body.joint_names,
    )  # fmt: skip
    made = load_drape_offsets(result.path).vertices(poses)
    error = vertex_errors_cm(torch.from_numpy(100 * made), torch.from_numpy(100 * found.vertices[rows].astype(float)))
    assert error == pytest.approx(test["vertex_cm"], rel=1e-3)


def test_mirrored_drapes_are_drapes_of_mirrored_poses(drapes: Path):
    """Offsets from the root, of a joint that has no other side here, change their sign across the mirror."""
    found = read_drapes(drapes)
    body = replace(found.body, joint_names=("root", "elbow"))
    other = mirrored_drapes(replace(found, body=body), np.arange(len(found.garment.template.vertices)))
    np.testing.assert_allclose(np.linalg.det(other.rotations), 1, atol=1e-5)
    np.testing.assert_allclose(other.vertices, found.vertices * np.float32([-1, 1, 1]))
    axes, angle = np.float32([-1, 1, 1]), 0.3
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]], np.float32)
    back = turn * np.outer(axes, axes)
    np.testing.assert_allclose(back, turn.T)  # about z: the other way round
    again = mirrored_drapes(other, np.arange(len(found.garment.template.vertices)))
    np.testing.assert_allclose(again.rotations, found.rotations)


def test_a_lesson_holds_every_drape_and_its_image(drapes: Path):
    found = read_drapes(drapes)
    found = replace(found, body=replace(found.body, joint_names=("root", "elbow")))
    parts = read_drape_parts(drapes, read_drapes(drapes))
    lesson = drape_lesson(found, parts, texels=32, space="root_offset", mirrored=True)
    half = len(parts.train)
    assert len(lesson.train) == 2 * half
    torch.testing.assert_close(lesson.train.vertices[half:], lesson.train.vertices[:half] * torch.tensor([-1.0, 1, 1]))


def test_patches_are_stitched_and_their_borders_measured(learned: Path):
    errors = read_json(learned / "errors.json")
    assert {"true_deg", "stitched_deg", "filtered_deg", "stitched_vertex_cm"} == set(errors["kinks"])
    model = load_drape_offsets(learned)
    assert len(model.networks) == 2
    rows = [json.loads(line) for line in (learned / "metrics.jsonl").read_text().splitlines()]
    names = [f"patches-{number:02d}" for number in (1, 2)]
    assert [(row["network"], row["epoch"]) for row in rows] == [(name, at) for name in names for at in range(1, 5)]


@pytest.mark.parametrize("stop", [3, 6], ids=["after a checkpoint", "in the second patch"])
def test_a_stopped_training_ends_with_the_same_bits(
    drapes: Path, learned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: int
):
    epoch, done = resumable.train_epoch, []

    def stopping(*arguments: object) -> None:
        done.append(1)
        if len(done) > stop:
            raise KeyboardInterrupt
        epoch(*arguments)  # pyright: ignore

    monkeypatch.setattr(resumable, "train_epoch", stopping)
    with pytest.raises(KeyboardInterrupt):
        train_stage.run(drapes, tmp_path / "model", PATCHES)
    monkeypatch.setattr(resumable, "train_epoch", epoch)
    train_stage.run(drapes, tmp_path / "model", PATCHES)
    again, whole = contents(tmp_path / "model"), contents(learned)
    assert sorted(again) == sorted(whole)
    assert [name for name, data in whole.items() if again[name] != data] == []


def test_given_labels_say_what_the_patches_are(drapes: Path, tmp_path: Path):
    """The vertices of the sleeve's upper half, on both of its panels: four patches of two labels."""
    garment = read_drapes(drapes).garment.template
    upper = garment.vertices[garment.faces].mean(axis=1)[:, 1] > 0.25
    np.save(tmp_path / "labels.npy", np.where(upper, 7, 3))
    config = replace(PATCHES, training=replace(TRAINING, epochs=1))
    result = train_stage.run(drapes, tmp_path / "model", config, labels=tmp_path / "labels.npy")
    model = load_drape_offsets(result.path)
    assert len(model.networks) == 4
    np.testing.assert_array_equal(model.parts.labels, np.where(upper, 7, 3))
    read = np.concatenate([sampler.vertices.numpy() for sampler in model.samplers])
    assert set(read) == set(range(len(garment.vertices)))


def test_a_strip_is_learned_with_all_three_losses(tmp_path: Path):
    """The necktie's recipe, on a piece of cloth in one image: edges gain by their loss."""
    drapes = write_drapes(tmp_path / "drapes", flat=True)
    edges = {}
    for weight in (0.0, 1.0):
        training = replace(PRESETS["necktie"].training, epochs=25, batch=8, edge_weight=weight, normal_weight=0.1)
        config = replace(
            PRESETS["necktie"], texels=32, mirrored=False, training=training,
            strip=StripConfig(rows=32, columns=32, channels=16),
        )  # fmt: skip
        result = train_stage.run(drapes, tmp_path / f"tie-{weight}", config)
        errors = read_json(result.path / "errors.json")
        edges[weight] = errors["train"]["edge_cm"]
        assert errors["train"]["vertex_cm"] < errors["train"]["mean_vertex_cm"]
    assert edges[1.0] < edges[0.0]


def test_the_commands_train_and_predict(drapes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    quick = ("--preset", "kernels", "--texels", "32", "--no-mirrored", "--workers", "1")
    assert run("offsets", "train", drapes, "--output", tmp_path / "model", *quick) == 0
    assert "test: " in capsys.readouterr().out
    body: Body = read_drapes(drapes).body
    rotations = np.stack([bent(body, angle).rotations for angle in (0.1, 0.3)]).astype(np.float32)
    poses = PoseSequence(
        rotations, np.float32([[0, 0, 0], [1, 2, 3]]), np.zeros(1, np.float32), np.array([4, 5], np.int32), 30.0,
        body.joint_names,
    )  # fmt: skip
    save_poses(tmp_path / "motion.npz", poses)
    out = tmp_path / "dance"
    options = ("--poses", tmp_path / "motion.npz", "--output", out, "--workers", "1")
    assert run("offsets", "predict", tmp_path / "model", *options) == 0
    said = capsys.readouterr().out
    assert "predict: " in said
    assert "of 2 frames" in said
    made = np.load(out / "registration" / "vertices.npy")
    assert made.shape == (2, len(read_drapes(drapes).garment.template.vertices), 3)
    assert np.abs(made[1] - made[0] - (1, 2, 3)).max() < 0.2  # the garment goes where the body goes
    work = open_work(out)
    assert work.is_animated
    assert work.registered.frame_ids.tolist() == [4, 5]
    assert max(each["pose_distance_deg"] for each in work.records) < 5
    assert run("report", out, "--workers", "1") == 0
    assert (out / "report" / "index.html").is_file()


def test_a_predicted_garment_leaves_the_body(drapes: Path, tmp_path: Path):
    """Kernels that know only deep dents: predicted inside, shown outside; a far pose is said to be far."""
    model = train_stage.run(
        drapes, tmp_path / "model", DrapeOffsetsConfig(network="kernels", texels=32, mirrored=False)
    ).path
    parts = load_drape_offsets(model).parts
    assert parts.kernels is not None
    deeper = np.tile(np.array([0, 0, 7], np.float32), len(parts.kernels.mean) // 3)
    sunk = replace(parts.kernels, mean=parts.kernels.mean - deeper)
    record = (model / "stage.json").read_bytes()
    save_model_parts(model, replace(parts, kernels=sunk))
    (model / "stage.json").write_bytes(record)
    body = parts.body
    rotations = np.stack([bent(body, angle).rotations for angle in (0.1, 2.4)]).astype(np.float32)
    poses = PoseSequence(
        rotations, np.zeros((2, 3), np.float32), np.zeros(1, np.float32), np.array([1, 2], np.int32), 30.0,
        body.joint_names,
    )  # fmt: skip
    save_poses(tmp_path / "motion.npz", poses)
    found = {}
    for on in (True, False):
        config = PredictOffsetsConfig(removal=RemovalConfig(enabled=on))
        predict_stage.run(model, tmp_path / "motion.npz", tmp_path / str(on), config)
        found[on] = open_work(tmp_path / str(on)).records
    assert found[True][0]["inside_before_percent"] > 30
    assert found[True][0]["inside_body_percent"] < 1
    assert found[False][0]["inside_body_percent"] == pytest.approx(found[True][0]["inside_before_percent"])
    assert any("from every pose that was learned" in reason for reason in found[True][1]["reasons"])
    assert not any("from every pose" in reason for reason in found[True][0]["reasons"])
    shutil.copytree(tmp_path / "True", tmp_path / "again")
    with pytest.raises(InputError, match="found the input"):
        predict_stage.run(model, tmp_path / "again" / "body" / "poses.npz", tmp_path / "again", PredictOffsetsConfig())


def test_what_cannot_be_learned_from_is_one_line(drapes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    np.save(tmp_path / "labels.npy", np.zeros(5, np.int32))
    with pytest.raises(InputError, match=r"labels\.npy: expected a whole number for each of"):
        train_stage.run(drapes, tmp_path / "model", PATCHES, labels=tmp_path / "labels.npy")
    with pytest.raises(InputError, match="lies in one image"):
        train_stage.run(drapes, tmp_path / "model", replace(PATCHES, network="strip", strip=StripConfig(16, 32, 8)))
    assert not (tmp_path / "model").exists()
    said = fails(capsys, "offsets", "train", tmp_path / "none", "--output", tmp_path / "model")
    assert "synth-drapes" in said
    broken = tmp_path / "broken"
    shutil.copytree(drapes, broken)
    split = read_json(broken / "split.json")
    write_json(broken / "split.json", {**split, "test": [*split["test"], 1]})
    with pytest.raises(InputError, match=r"split\.json: expected every drape in one part"):
        train_stage.run(broken, tmp_path / "model", PATCHES)
    write_json(broken / "split.json", {**split, "test": []})
    with pytest.raises(InputError, match="at least 1 drapes to test with, found 0"):
        train_stage.run(broken, tmp_path / "model", PATCHES)
