"""Fit from the command line: what comes out, resuming, and what is wrong in one line."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.captures import work_folder
from capture4d.files.atomic import read_json, write_json
from capture4d.files.records import save_garment
from capture4d.files.tensors import read_tensors
from retarget import fit_takes
from retarget.shapes.files import load_blendshapes
from tests.command_line import fails, run


def test_fit_finds_the_waves_and_says_so(model: Path, works, make_world) -> None:
    note, learned = read_json(model / "fit.json"), load_blendshapes(model / "blendshapes.safetensors")
    assert note["split"] == {
        "training": ["take0[0:16]", "take1[0:16]"], "validation": ["take2[0:16]"], "held out": []
    }  # fmt: skip
    assert note["training_frames"] == 30  # one of each take is flagged, and 5 m away
    assert note["directions"] == note["directions_for_max_error"] == 3
    assert note["validation_shape_error_mm"]["worst"] < 0.5
    assert learned.licence == "CC0"
    assert list(learned.garment.loops) == ["hem", "neck"]
    assert learned.garment.template.uv is not None
    waves = make_world(waves=3).waves.reshape(3, -1)
    for direction in learned.basis.reshape(len(learned.basis), -1):
        assert np.linalg.norm(waves @ direction) > 0.999
    assert note["linear"]["training"]["vertex_error_mm"] < 2.0
    assert note["lstm"]["validation"]["vertex_error_mm"] > 0
    assert (model / "training" / "metrics.jsonl").read_text().count("\n") == 3
    assert note["kernel"]["validation"]["vertex_error_mm"] > 0
    assert note["ensemble"]["validation"]["vertex_error_mm"] > 0
    assert not (model / "unposed").exists()


def test_validation_takes_are_learned_from_in_the_end_but_not_the_end_of_the_only_take(
    model: Path, write_work, motion, make_world, tmp_path: Path, quick
) -> None:
    def learned_frames(folder: Path) -> int:
        return len(read_tensors(folder / "kernel.safetensors", "capture4d kernel regressor")["frames"])

    assert learned_frames(model) == 3 * 15  # one frame of each take is flagged
    work = write_work(tmp_path / "only", motion(60, 0), world=make_world(waves=3))
    assert run("fit", work, "--output", tmp_path / "alone", *quick) == 0
    split = read_json(tmp_path / "alone" / "retarget" / "fit.json")["split"]
    assert split == {"training": ["only[0:21]"], "validation": ["only[51:60]"], "held out": []}
    assert learned_frames(tmp_path / "alone" / "retarget") == 21


def test_fit_again_changes_nothing_and_other_settings_are_refused(model: Path, works, quick, capsys) -> None:
    again = ("fit", *works, "--output", model.parent, "--split.validation", "take2", "--licence", "CC0")
    before = {path.name: path.read_bytes() for path in model.glob("*.safetensors")}
    digest = read_json(model / "stage.json")["digest"]
    assert run(*again, *quick) == 0
    assert {path.name: path.read_bytes() for path in model.glob("*.safetensors")} == before
    assert read_json(model / "stage.json")["digest"] == digest
    assert "other settings" in fails(capsys, *again, *quick, "--shape.components", "2")


def test_takes_that_do_not_fit_together_are_one_line(
    works, write_work, motion, make_world, tmp_path, quick, capsys
) -> None:
    world = make_world()
    faces = world.garment.template.faces[::-1].copy()
    template = replace(world.garment.template, faces=faces, uv=None)
    other = write_work(tmp_path / "take8", motion(10, 7))
    save_garment(other / "registration" / "garment.npz", replace(world.garment, template=template))
    line = fails(capsys, "fit", *works, other, "--output", tmp_path / "x", *quick)
    assert "take8: expected the template of" in line
    slow = write_work(tmp_path / "take7", replace(motion(10, 7), fps=30.0))
    assert "expected 60 frames a second" in fails(capsys, "fit", *works, slow, "--output", tmp_path / "y", *quick)
    weights = world.garment.skin_weights[:, ::-1].copy()
    anew = write_work(tmp_path / "take6", motion(10, 7))
    save_garment(anew / "registration" / "garment.npz", replace(world.garment, skin_weights=weights))
    line = fails(capsys, "fit", *works, anew, "--output", tmp_path / "v", *quick)
    assert "take6: expected the skin weights of" in line
    assert "--output: expected" in fails(capsys, "fit", *works, code=2)
    assert "found take0, take0" in fails(capsys, "fit", works[0], works[0], "--output", tmp_path / "z")
    assert "run: capture4d run" in fails(capsys, "fit", tmp_path / "nothing")
    line = fails(capsys, "fit", works[0], "--output", tmp_path / "w", "--split.held-out", "take9", *quick)
    assert "found 'take9'" in line


def test_a_take_with_one_frame_is_one_line(write_work, motion, tmp_path, quick, capsys) -> None:
    single = write_work(tmp_path / "single", motion(1, 0))
    assert "at least 2 good frames to learn from, found 1 of 1" in fails(capsys, "fit", single, *quick)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("--training.patience", "0"), "--training.patience: expected at least 1, found 0"),
        (("--shape.components", "-1"), "--shape.components: expected at least 0, found -1"),
        (("--kernel.ridges", "0"), "--kernel.ridges: expected a positive number, found 0"),
        (("--kernel.tuning.kept", "0"), "--kernel.tuning.kept: expected above 0, up to 1, found 0"),
        (("--kernel.tuning.line", "-1"), "--kernel.tuning.line: expected at least 0, found -1"),
        (("--control.lags", "-1"), "--control.lags: expected at least 1, found -1"),
        (
            ("--kernel.control.history", "2"),
            "--kernel.control.history: expected 0, for kernels carry nothing on, found 2",
        ),
        (("--split.validation-share", "1"), "--split.validation-share: expected from 0 to below 1, found 1"),
        (("--split.held-out", "take9"), "found 'take9'"),
    ],
)
def test_wrong_settings_leave_nothing_behind(
    works, tmp_path: Path, quick, capsys, wrong: tuple[str, str], said: str
) -> None:
    assert said in fails(capsys, "fit", *works, "--output", tmp_path / "x", *quick, *wrong)
    assert not (tmp_path / "x" / "retarget" / "stage.json").exists()


def test_takes_in_another_order_are_the_same_takes(model: Path, works, quick) -> None:
    """What an earlier run left is not read as somebody else's."""
    before = {path.name: path.read_bytes() for path in model.glob("*.safetensors")}
    shutil.rmtree(model)
    backwards = ("fit", *works[::-1], "--output", model.parent, "--split.validation", "take2", "--licence", "CC0")
    assert run(*backwards, *quick) == 0
    assert {path.name: path.read_bytes() for path in model.glob("*.safetensors")} == before


def test_verdicts_belong_to_frames_not_to_lines(write_work, motion, tmp_path: Path, quick, capsys) -> None:
    work = write_work(tmp_path / "short", motion(12, 0))
    lines = (work / "registration" / "metrics.jsonl").read_text().splitlines()
    (work / "registration" / "metrics.jsonl").write_text("\n".join(lines[3:]))
    said = fails(capsys, "fit", work, "--output", tmp_path / "x", *quick)
    assert "metrics.jsonl: frame 1: expected a verdict, found none" in said


def test_a_body_tracked_anew_wants_a_new_registration(write_work, motion, tmp_path: Path, quick, capsys) -> None:
    work = write_work(tmp_path / "take", motion(12, 0))
    record = read_json(work / "body" / "stage.json")
    write_json(work / "body" / "stage.json", {**record, "digest": "another"})
    said = fails(capsys, "fit", work, "--output", tmp_path / "x", *quick)
    assert "expected the body with which it was registered" in said


def test_a_damaged_registration_is_one_line(write_work, motion, tmp_path: Path, quick, capsys) -> None:
    work = write_work(tmp_path / "take", motion(12, 0))
    for name, said in (("frames/000003.npz", "not a readable npz file"), ("vertices.npy", "found a damaged file")):
        path = work / "registration" / name
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
        assert said in fails(capsys, "fit", work, "--output", tmp_path / "x", *quick)
        path.write_bytes(whole)


def test_poses_and_frames_of_a_take_are_read_once(
    works, quick, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[str] = []

    def counted(function):
        def counting(path: Path):
            read.append(f"{path.parent.name}/{path.name}")
            return function(path)

        return counting

    monkeypatch.setattr(work_folder, "load_poses", counted(work_folder.load_poses))
    monkeypatch.setattr(fit_takes, "load_registration", counted(fit_takes.load_registration))
    assert run("fit", *works, "--output", tmp_path / "out", *quick, "--regressor", "linear") == 0
    assert sorted(read) == sorted(["body/poses.npz"] * 3 + [f"{work.name}/registration" for work in works])
