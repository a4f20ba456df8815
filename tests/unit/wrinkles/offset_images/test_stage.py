"""Offset images as a stage: what it keeps, that a stopped training is the training that never stopped, bad input."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.body.binding import bind
from capture4d.captures.work_folder import open_work
from capture4d.cli.main import main
from capture4d.errors import InputError
from capture4d.files.records import load_garment, save_body, save_garment, save_poses
from capture4d.types import PoseSequence
from tests.unit.wrinkles.conftest import make_work, outside_the_unit_square, some_garment, some_scan
from tests.unit.wrinkles.offset_images.test_layout import limb, turned, upright
from wrinkles.offset_images import resumable, stage
from wrinkles.offset_images.canvas import OffsetSampler
from wrinkles.offset_images.config import OffsetConfig, OffsetTrainingConfig, PatchConfig
from wrinkles.offset_images.frames import offset_frames, vertex_errors_cm
from wrinkles.offset_images.model_files import NETWORKS, OFFSETS, find_offsets, load_offset_model
from wrinkles.offset_images.training import predict

FRAMES = 12
CONFIG = OffsetConfig(
    held_out=0.2, texels=32, components=4, training=OffsetTrainingConfig(epochs=5, checkpoint_every=2), patched=True,
    patch=PatchConfig(count=2, texels=32, context=2, channels=16),
)  # fmt: skip
LOGGED = ("decoder", "patches-01", "patches-02", "fully_connected", "fully_connected_pca")


def bound_work(folder: Path, frames: int, *, bend: float = 0.0) -> Path:
    """The sleeve around a limb that bends, as it was registered; it breathes a little."""
    garment, body = outside_the_unit_square(some_garment()), limb()
    at, weights, skin_weights = bind(garment.template.vertices, garment.template.faces, upright(body))
    bound = replace(
        garment, embedding_faces=at, embedding_barycentric=weights, skin_weights=skin_weights.astype(np.float32)
    )
    work = make_work(folder, bound, [some_scan(phase=0.3 * frame) for frame in range(frames)])
    ids = np.arange(1, frames + 1, dtype=np.int32)
    rotations = np.stack([np.stack([np.eye(3), turned(bend * frame / frames)]) for frame in range(frames)])
    poses = PoseSequence(rotations.astype(np.float32), np.zeros((frames, 3), np.float32), np.zeros(1, np.float32), ids,
                         60.0, body.joint_names)  # fmt: skip
    save_body(folder / "capture" / "body.npz", body)
    save_poses(folder / "capture" / "poses.npz", poses)
    wobble = np.sin(np.arange(frames))[:, None, None] * np.float32([0, 0, 1e-3])  # one direction to learn
    np.save(work / "registration" / "vertices.npy", (garment.template.vertices + wobble).astype(np.float32))
    records = "".join(json.dumps({"frame_id": frame_id, "verdict": "good"}) + "\n" for frame_id in ids.tolist())
    (work / "registration" / "metrics.jsonl").write_text(records)
    return work


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bound_work(tmp_path_factory.mktemp("offsets"), FRAMES, bend=0.5)


@pytest.fixture(scope="module")
def learned(taken: Path) -> Path:
    return stage.run(open_work(taken), taken / OFFSETS, CONFIG).path


@pytest.fixture
def work(taken: Path, tmp_path: Path) -> Path:
    """A copy without offset images."""
    for name in ("capture", "work"):
        shutil.copytree(taken.parent / name, tmp_path / name, ignore=shutil.ignore_patterns("wrinkles"))
    for name in ("garment", "registration"):
        path = tmp_path / "work" / name / "stage.json"
        record = json.loads(path.read_text())
        path.write_text(json.dumps(record | {"sources": {"capture": str(tmp_path / "capture")}}))
    return tmp_path / "work"


def contents(folder: Path) -> dict[str, bytes]:
    """All files but stage.json, which tells the time."""
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name != "stage.json")
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def test_networks_are_kept_as_they_were_best(taken: Path, learned: Path):
    frames = json.loads((learned / "frames.json").read_text())
    # two of twelve are held out behind a gap of two; a ninth of the rest, one at least, chooses the epoch
    assert frames == {"learned": list(range(1, 8)), "chose_epoch": [8], "held_out": [11, 12]}
    rows = [json.loads(line) for line in (learned / "metrics.jsonl").read_text().splitlines()]
    assert [(row["network"], row["epoch"]) for row in rows] == [(name, at) for name in LOGGED for at in range(1, 6)]
    opened = open_work(taken)
    sequence, (body, poses) = opened.registered, opened.require_posed_body()
    chose = [7]
    for name in NETWORKS:
        model = load_offset_model(learned / f"{name}.safetensors", sequence.garment)
        poses_then = poses.of_frames(sequence.frame_ids[chose])
        seen = offset_frames(model.layout, body, poses_then, np.array(sequence.vertices[chose]), model.joints)
        found = vertex_errors_cm(predict(model.network, OffsetSampler(model.layout), seen), seen.vertices)
        if name != "patches":
            best = min(row["validation_cm"] for row in rows if row["network"] == name)
            assert found == pytest.approx(best, rel=1e-5)
            continue
        # of two patches each is as it was best on its own vertices; the filter knows the frames that were learned
        best = [min(row["validation_cm"] for row in rows if row["network"] == each) for each in LOGGED[1:3]]
        assert min(best) / 2 < found < 2 * max(best)


def test_what_was_learned_is_found_again(taken: Path, learned: Path):
    opened = open_work(taken)
    found = find_offsets(taken, opened.registered.garment, registration=opened.registered_digest)
    assert found is not None
    assert tuple(found.models) == NETWORKS
    assert (found.held_out, found.gap, found.seen) == (0.2, 10, frozenset(range(1, 9)))
    before = contents(learned)
    assert stage.run(open_work(taken), taken / OFFSETS, CONFIG).digest == found.digest
    assert contents(learned) == before


@pytest.mark.parametrize(
    "stop", [1, 4, 13, 18], ids=["before a checkpoint", "in the decoder", "in a patch", "in a baseline"]
)
def test_a_stopped_training_ends_with_the_same_bits(
    work: Path, learned: Path, monkeypatch: pytest.MonkeyPatch, stop: int
):
    epoch, done = resumable.train_epoch, []

    def stopping(*arguments: object) -> None:
        done.append(1)
        if len(done) > stop:
            raise KeyboardInterrupt
        epoch(*arguments)  # pyright: ignore

    monkeypatch.setattr(resumable, "train_epoch", stopping)
    with pytest.raises(KeyboardInterrupt):
        stage.run(open_work(work), work / OFFSETS, CONFIG)
    monkeypatch.setattr(resumable, "train_epoch", epoch)
    stage.run(open_work(work), work / OFFSETS, CONFIG)
    again, whole = contents(work / OFFSETS), contents(learned)
    assert sorted(again) == sorted(whole)
    for name, data in whole.items():
        assert again[name] == data, name


@pytest.mark.parametrize("name", NETWORKS[1:])
def test_a_lost_network_is_learned_again_alike(work: Path, learned: Path, name: str):
    shutil.copytree(learned, work / OFFSETS)
    path = work / OFFSETS / f"{name}.safetensors"
    path.unlink()
    shutil.rmtree(work / OFFSETS / "checkpoints")
    stage.run(open_work(work), work / OFFSETS, CONFIG)
    assert path.read_bytes() == (learned / path.name).read_bytes()


def command(work: Path, *more: str) -> int:
    with pytest.raises(SystemExit) as exit_:
        main(["wrinkles", "offsets", str(work), "--workers", "1", "--texels", "32", "--training.epochs", "1", *more])
    return int(exit_.value.code or 0)


def test_the_command_says_where_they_are_and_refuses_other_settings(work: Path, capsys: pytest.CaptureFixture[str]):
    assert command(work) == 0
    assert capsys.readouterr().out.strip() == f"offset images: {work / OFFSETS}"
    assert command(work, "--components", "3") == 1
    assert "other settings (components 128 to 3); with --overwrite" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--texels", "100", "--texels: expected a power of two"),
        ("--training.batch", "1", "--training.batch: expected at least 2, found 1"),
    ],
)
def test_settings_out_of_range_leave_nothing_behind(
    work: Path, capsys: pytest.CaptureFixture[str], option: str, value: str, said: str
):
    assert command(work, option, value) == 1
    assert said in capsys.readouterr().err.splitlines()[-1]
    assert not (work / OFFSETS).exists()


def test_what_there_is_nothing_to_learn_from(work: Path, tmp_path: Path):
    with pytest.raises(InputError, match="expected a work folder with a registration, found none"):
        stage.run(open_work(tmp_path / "nothing"), tmp_path / "out", CONFIG)
    failed = "".join(json.dumps({"frame_id": at, "verdict": "failed"}) + "\n" for at in range(1, 8))
    (work / "registration" / "metrics.jsonl").write_text(failed)
    with pytest.raises(InputError, match="at least 2 soundly registered frames to learn from, found 1"):
        stage.run(open_work(work), tmp_path / "out", CONFIG)
    garment = load_garment(work / "registration" / "garment.npz")
    free = replace(garment, embedding_faces=None, embedding_barycentric=None, skin_weights=None)
    save_garment(work / "registration" / "garment.npz", free)
    with pytest.raises(InputError, match="bound to a body, found none; run: capture4d template"):
        stage.run(open_work(work), tmp_path / "out", CONFIG)
    assert not (tmp_path / "out").exists()


def test_patches_are_learned_when_they_are_asked_for(work: Path):
    config = replace(CONFIG, patched=False, training=OffsetTrainingConfig(epochs=1))
    stage.run(open_work(work), work / OFFSETS, config)
    opened = open_work(work)
    found = find_offsets(work, opened.registered.garment, registration=opened.registered_digest)
    assert found is not None
    assert list(found.models) == ["decoder", "fully_connected", "fully_connected_pca"]
    assert not (work / OFFSETS / "patches.safetensors").exists()


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_of_another_garment_is_refused(taken: Path, learned: Path, name: str):
    garment = open_work(taken).registered.garment
    mesh = garment.template
    assert mesh.uv is not None
    half = len(mesh.faces) // 2
    fewer = replace(garment, template=replace(mesh, faces=mesh.faces[:half], uv=mesh.uv[:half]))
    load_offset_model(learned / f"{name}.safetensors", garment)
    if name == "decoder":
        return  # images are of any garment; it is the registration's digest that tells
    with pytest.raises(InputError, match=r"architecture|labels: expected"):
        load_offset_model(learned / f"{name}.safetensors", fewer)


def test_a_damaged_network_is_named(work: Path, learned: Path):
    shutil.copytree(learned, work / OFFSETS)
    opened = open_work(work)
    digest, garment = opened.registered_digest, opened.registered.garment
    path = work / OFFSETS / "decoder.safetensors"
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(InputError, match=r"decoder\.safetensors: not a readable safetensors file"):
        find_offsets(work, garment, registration=digest)
    with pytest.raises(InputError, match="from this registration as it is now"):
        find_offsets(work, garment, registration="another")
    shutil.rmtree(work / OFFSETS)
    assert find_offsets(work, garment, registration=digest) is None
