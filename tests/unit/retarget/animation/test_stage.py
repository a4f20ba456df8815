"""Animate from the command line: what comes out, resuming, and what is wrong in one line."""

import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.body.skinning import pose_frame, skin, with_shape
from capture4d.captures.animations.config import RemovalConfig
from capture4d.captures.work_folder import load_records, load_registration, open_work
from capture4d.cli.main import main
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_json
from capture4d.files.records import load_body, save_body, save_poses
from capture4d.files.tensors import read_tensors, write_tensors
from capture4d.types import BlendshapeModel
from retarget.animation import garment_model
from retarget.animation.garment_model import load_garment_model
from retarget.animation.stage import run_on_coefficients
from retarget.config import AnimateConfig
from retarget.shapes.files import load_blendshapes


def run(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as exit_:
        main([str(argument) for argument in arguments])
    return int(exit_.value.code or 0)


def fails(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Run a command that must fail on its input; the one line it says."""
    capsys.readouterr()
    assert run(*arguments) == 1
    said = capsys.readouterr().err.strip()
    assert said.splitlines()[-1].startswith("capture4d: ")
    assert "Traceback" not in said
    return said.splitlines()[-1]


def animate(model: Path, poses: Path, output: Path, *more: str | Path) -> tuple[str | Path, ...]:
    return "animate", model, "--poses", poses, "--output", output, "--workers", "1", *more


def test_the_captured_motion_on_the_captured_person_is_the_capture(model: Path, works, tmp_path: Path) -> None:
    output = tmp_path / "again"
    poses = works[0] / "body" / "poses.npz"
    free = ("--removal.no-enabled", "--longest", "0")  # this cloth stretches as no cloth does
    assert run(*animate(model, poses, output, "--regressor", "linear", *free)) == 0
    found, wanted = (load_registration(each / "registration") for each in (output, works[0]))
    good = np.delete(np.arange(16), 4)
    apart = np.linalg.norm(found.vertices[good] - wanted.vertices[good], axis=-1)
    assert apart.mean() < 0.004
    assert np.isnan(found.residual_m).all()
    body, motion = open_work(output).require_posed_body()
    assert len(motion.frame_ids) == 16
    assert body.joint_names == motion.joint_names


def test_another_person_gets_the_garment_outside_the_body(model: Path, works, tmp_path: Path, capsys) -> None:
    output = tmp_path / "thick"
    poses = works[2] / "body" / "poses.npz"
    assert run(*animate(model, poses, output, "--beta", "3", "1", "--mean", "captured")) == 0
    records = load_records(output / "registration")
    assert (
        np.mean([record["inside_before_percent"] for record in records]) > 10
    )  # a thick limb in a tube that did not grow
    assert np.mean([record["inside_body_percent"] for record in records]) <= 0.3
    corrected = tmp_path / "corrected"
    assert run(*animate(model, poses, corrected, "--beta", "3", "1", "--longest", "0")) == 0
    body, motion = open_work(corrected).require_posed_body()
    person = with_shape(body, motion.shape)
    np.testing.assert_allclose(motion.shape, [3, 1])
    garment = load_registration(corrected / "registration").garment
    posed = skin(garment.template.vertices, garment.skin_weights, pose_frame(person, motion, 0).transforms)
    assert np.linalg.norm(load_registration(corrected / "registration").vertices[0] - posed, axis=1).mean() < 0.02
    # and the report works on it, with limits
    capsys.readouterr()
    assert run("report", output, "--workers", "1", "--fail-above", "inside_body_percent=0.3") == 0
    page = (output / "report" / "index.html").read_text()
    assert "is inside the body" in page
    assert page.count("data:image/webp") >= 8
    assert run("report", output, "--workers", "1", "--fail-above", "inside_before_percent=0.3") == 3


def test_a_motion_is_not_written_over_by_what_it_moves(model: Path, works, capsys) -> None:
    poses = works[1] / "body" / "poses.npz"
    before = poses.read_bytes()
    said = fails(capsys, *animate(model, poses, works[1]), "--overwrite")
    assert said == f"capture4d: {poses}: expected a file to write to, found the input {poses}"
    assert poses.read_bytes() == before


def test_an_interrupted_animation_is_finished_by_the_same_command(model: Path, works, tmp_path: Path) -> None:
    poses, output = works[1] / "body" / "poses.npz", tmp_path / "out"
    assert run(*animate(model, poses, output)) == 0
    digest = read_json(output / "registration" / "stage.json")["digest"]
    for path in sorted((output / "registration" / "frames").glob("*.npz"))[5:9]:
        path.unlink()
    (output / "registration" / "coefficients.npy").unlink()
    assert run(*animate(model, poses, output)) == 0
    assert read_json(output / "registration" / "stage.json")["digest"] == digest


def test_animate_takes_what_validated_best_unless_told_otherwise(model: Path, works, tmp_path: Path, capsys) -> None:
    note = read_json(model / "fit.json")
    errors = {name: note[name]["validation"]["vertex_error_mm"] for name in ("ensemble", "kernel", "lstm", "linear")}
    best = min(errors, key=lambda name: errors[name])
    poses = works[0] / "body" / "poses.npz"
    said = {}
    for name in ("auto", "ensemble", "kernel", "lstm", "linear"):
        assert run(*animate(model, poses, tmp_path / name, "--regressor", name)) == 0
        said[name] = np.load(tmp_path / name / "registration" / "coefficients.npy")
    np.testing.assert_array_equal(said["auto"], said[best])
    np.testing.assert_allclose(said["ensemble"], 0.75 * said["kernel"] + 0.25 * said["lstm"], atol=1e-6)
    assert np.abs(said["lstm"] - said["kernel"]).max() > 1e-3
    assert np.abs(said["lstm"] - said["linear"]).max() > 1e-3
    (model / "lstm.safetensors").unlink()
    assert run(*animate(model, poses, tmp_path / "no lstm")) == 0
    left = min(("kernel", "linear"), key=lambda name: errors[name])
    np.testing.assert_array_equal(np.load(tmp_path / "no lstm" / "registration" / "coefficients.npy"), said[left])
    assert "expected a regressor 'ensemble'" in fails(
        capsys, *animate(model, poses, tmp_path / "x", "--regressor", "ensemble")
    )


def test_kernels_that_see_less_than_the_network_stand_alone(works, tmp_path: Path, quick, capsys) -> None:
    output = tmp_path / "up"
    assert run("fit", *works, "--output", output, *quick, "--control.up") == 0
    assert "ensemble" not in read_json(output / "retarget" / "fit.json")
    poses = works[0] / "body" / "poses.npz"
    assert "its kernels do not see all that its LSTM sees" in fails(
        capsys, *animate(output, poses, tmp_path / "x", "--regressor", "ensemble")
    )


def test_a_body_is_the_person_whose_poses_lie_beside_it(model: Path, works, tmp_path: Path) -> None:
    body, poses = open_work(works[0]).require_posed_body()
    other = np.float32([1.5] + [0.0] * (len(poses.shape) - 1))
    save_body(tmp_path / "anna" / "body.npz", body)
    save_poses(tmp_path / "anna" / "poses.npz", replace(poses, shape=other))
    save_body(tmp_path / "alone" / "body.npz", body)
    motion = works[0] / "body" / "poses.npz"
    for who, more, wanted in (("anna", (), other), ("alone", (), 0 * other), ("anna", ("--beta", "-1"), [-1])):
        output = tmp_path / f"{who}{len(more)}"
        given = ("--body", tmp_path / who / "body.npz", *more, "--regressor", "linear")
        assert run(*animate(model, motion, output, *given)) == 0
        np.testing.assert_array_equal(open_work(output).require_posed_body()[1].shape[: len(wanted)], wanted)


def test_coefficients_that_are_no_numbers_are_refused(model: Path, works, tmp_path: Path) -> None:
    poses = works[0] / "body" / "poses.npz"
    count = len(load_blendshapes(model / "blendshapes.safetensors").std)
    for coefficients, said in (
        (np.full((16, count), np.nan, np.float32), "expected finite numbers, found NaN"),
        (np.zeros((15, count), np.float32), r"expected an array of \(16, 3\), found \(15, 3\)"),
    ):
        with pytest.raises(InputError, match=said):
            run_on_coefficients(model, poses, coefficients, tmp_path / "x", AnimateConfig())
    assert not (tmp_path / "x").exists()


def test_poses_that_validated_and_were_learned_from_then_are_no_strangers(model: Path, works, tmp_path: Path) -> None:
    """They all lie at no distance; how far they lay when they validated is known beside."""
    poses = works[2] / "body" / "poses.npz"
    assert run(*animate(model, poses, tmp_path / "again", "--unlike-deg", "0")) == 0
    distances = [record["pose_distance_deg"] for record in load_records(tmp_path / "again" / "registration")]
    assert max(np.delete(distances, 4)) < 0.1  # one frame was flagged
    assert read_json(model / "fit.json")["validated_deg"] > 1


def test_unlike_poses_are_flagged_and_get_the_garment_at_rest(model: Path, motion, tmp_path: Path) -> None:
    poses = motion(6, 9)
    twisted = poses.rotations.copy()
    twisted[3:, 1] = twisted[3:, 1] @ np.diag([-1, 1, -1]).astype(np.float32)  # half a turn
    save_poses(tmp_path / "odd.npz", replace(poses, rotations=twisted))
    assert run(*animate(model, tmp_path / "odd.npz", tmp_path / "odd", "--unlike-deg", "40")) == 0
    records = load_records(tmp_path / "odd" / "registration")
    assert [record["verdict"] for record in records[3:]] == ["check"] * 3
    assert "deg from every pose that was learned" in " ".join(records[3]["reasons"])
    assert records[0]["pose_distance_deg"] < 40
    resting = load_garment_model(model).limits.coefficients.resting
    found = np.load(tmp_path / "odd" / "registration" / "coefficients.npy")[3:]
    np.testing.assert_allclose(found, np.tile(resting, (3, 1)), atol=1e-6)


def test_cloth_does_not_stretch_unless_it_is_let_and_torn_cloth_has_failed(model: Path, works, tmp_path: Path) -> None:
    """Coefficients a hundred times as large as any that were learned."""
    poses, wild = works[1] / "body" / "poses.npz", load_blendshapes(model / "blendshapes.safetensors").std * 100
    coefficients = np.tile(wild, (16, 1)).astype(np.float32)
    stretch = {}
    for longest in (0.0, 1.2):
        config = AnimateConfig(longest=longest, removal=RemovalConfig(enabled=False))
        result = run_on_coefficients(model, poses, coefficients, tmp_path / f"{longest}", config)
        records = load_records(tmp_path / f"{longest}" / "registration")
        stretch[longest] = max(record["stretch_p99"] for record in records)
        assert (len(result.failed) == 16) == (longest == 0.0)
    assert "times as long as the cloth's > 2.5" in load_records(tmp_path / "0.0" / "registration")[3]["reasons"][0]
    assert stretch[0.0] > 10
    assert stretch[1.2] < 2


def test_a_motion_at_another_rate_is_resampled_and_told(model: Path, motion, tmp_path: Path, capsys) -> None:
    save_poses(tmp_path / "slow.npz", replace(motion(10, 1), fps=30.0))
    assert run(*animate(model, tmp_path / "slow.npz", tmp_path / "slow")) == 0
    line = "slow.npz: 30 frames a second, resampled to the model's 60: 10 frames became 19\n"
    assert line in capsys.readouterr().err
    motion_ = open_work(tmp_path / "slow").require_posed_body()[1]
    assert motion_.fps == 60.0
    assert len(motion_.frame_ids) == 19


def test_a_motion_may_come_out_at_any_rate(model: Path, motion, tmp_path: Path, capsys) -> None:
    """At the model's frames nothing changes; between them, the body is that of the file's own frames."""
    fast = motion(33, 1, 240.0)
    save_poses(tmp_path / "fast.npz", fast)
    out = {}
    for fps in (60, 120, 240, 30):
        assert run(*animate(model, tmp_path / "fast.npz", tmp_path / str(fps), "--fps", fps, "--removal.no-enabled",
                            "--longest", "0")) == 0  # fmt: skip
        out[fps] = capsys.readouterr().err, open_work(tmp_path / str(fps))
    own = out[60][1]
    for fps, (said, work) in out.items():
        poses, vertices = work.require_posed_body()[1], np.array(work.registered.vertices)
        assert poses.fps == fps
        assert len(vertices) == 32 * fps // 240 + 1
        source, step = 240 // fps, max(fps // 60, 1)
        np.testing.assert_allclose(poses.rotations, fast.rotations[::source], atol=1e-5)
        np.testing.assert_allclose(vertices[::step], own.registered.vertices[:: max(60 // fps, 1)], atol=1e-6)
        expected = {
            30: "240 frames a second, resampled to 30: 33 frames became 5; the garment answers at the model's 60",
            60: "240 frames a second, resampled to 60: 33 frames became 9",
            120: "240 frames a second, resampled to 120: 33 frames became 17; the garment answers at the model's 60",
            240: "240 frames a second, as wanted; the garment answers at the model's 60",
        }
        assert f"fast.npz: {expected[fps]}\n" in said
    assert "--fps: expected a positive number" in fails(
        capsys, *animate(model, tmp_path / "fast.npz", tmp_path / "none", "--fps", "0")
    )


def test_poses_of_another_skeleton_are_one_line(model: Path, motion, tmp_path: Path, capsys) -> None:
    poses = motion(4, 0)
    save_poses(tmp_path / "other.npz", replace(poses, joint_names=("hip", "knee", "foot")))
    line = fails(capsys, *animate(model, tmp_path / "other.npz", tmp_path / "x"))
    assert "other.npz" in line
    assert "joints" in line
    body = load_body(model / "body.npz")
    save_body(tmp_path / "body.npz", replace(body, joint_names=("hip", "knee", "foot")))
    save_poses(tmp_path / "poses.npz", poses)
    line = fails(capsys, *animate(model, tmp_path / "poses.npz", tmp_path / "x", "--body", tmp_path / "body.npz"))
    assert "body.npz: body: expected the 3 joints of the model" in line
    assert "at most 2" in fails(capsys, *animate(model, tmp_path / "poses.npz", tmp_path / "x", "--beta", *"1111"))
    assert "--beta: expected a finite number" in fails(
        capsys, *animate(model, tmp_path / "poses.npz", tmp_path / "x", "--beta", "nan")
    )


def test_a_tracked_take_is_never_written_over(model: Path, works, tmp_path: Path, capsys) -> None:
    poses = works[0] / "body" / "poses.npz"
    assert "found a take with a tracked body" in fails(capsys, *animate(model, poses, works[1]))
    shutil.copytree(works[1] / "registration", tmp_path / "registered" / "registration")
    assert "found output of 'register'" in fails(capsys, *animate(model, poses, tmp_path / "registered"))


def test_a_motion_in_disorder_is_one_line(model: Path, motion, tmp_path: Path, capsys) -> None:
    poses = motion(4, 0)
    save_poses(tmp_path / "poses.npz", replace(poses, frame_ids=poses.frame_ids[::-1].copy()))
    said = fails(capsys, *animate(model, tmp_path / "poses.npz", tmp_path / "x"))
    assert "expected frames with ascending numbers, found 4 frames in disorder" in said


def test_a_body_of_other_faces_leaves_nothing_behind(model: Path, works, tmp_path: Path, capsys) -> None:
    body = load_body(model / "body.npz")
    turned = replace(body, template=replace(body.template, faces=body.template.faces[::-1].copy(), uv=None))
    save_body(tmp_path / "body.npz", turned)
    poses, output = works[0] / "body" / "poses.npz", tmp_path / "x"
    assert "faces" in fails(capsys, *animate(model, poses, output, "--body", tmp_path / "body.npz"))
    assert run(*animate(model, poses, output)) == 0


def test_a_device_that_is_not_there_is_one_line(model: Path, works, tmp_path: Path, capsys) -> None:
    poses = works[0] / "body" / "poses.npz"
    said = fails(capsys, *animate(model, poses, tmp_path / "x", "--regressor", "lstm", "--device", "nonsense"))
    assert "device: expected one that torch can use" in said


def test_an_unfinished_model_is_not_animated_and_lost_files_are_made_again(
    model: Path, works, tmp_path: Path, quick, capsys
) -> None:
    poses = works[0] / "body" / "poses.npz"
    kernel = (model / "kernel.safetensors").read_bytes()
    (model / "kernel.safetensors").unlink()
    again = ("fit", *works, "--output", model.parent, "--split.validation", "take2", "--licence", "CC0", *quick)
    assert run(*again) == 0
    assert (model / "kernel.safetensors").read_bytes() == kernel
    record = read_json(model / "stage.json")
    write_json(model / "stage.json", {**record, "status": "running"})
    assert "'fit' is not finished" in fails(capsys, *animate(model, poses, tmp_path / "x"))


def test_damaged_models_are_one_line(model: Path, works, tmp_path: Path, capsys) -> None:
    poses = works[0] / "body" / "poses.npz"
    path = model / "blendshapes.safetensors"
    whole = path.read_bytes()
    path.write_bytes(whole[:-50])
    assert "blendshapes.safetensors: not a readable safetensors file" in fails(
        capsys, *animate(model, poses, tmp_path / "x")
    )
    path.write_bytes(pickle.dumps({"mean": [1, 2, 3]}))
    assert "found a pickle" in fails(capsys, *animate(path, poses, tmp_path / "x"))
    path.write_bytes(whole)
    assert "expected a model" in fails(capsys, *animate(tmp_path / "nowhere", poses, tmp_path / "x"))

    file = read_tensors(path, "capture4d blendshapes")
    note = {key: value for key, value in file.note.items() if key != "kind"}
    broken = {**file.tensors, "basis": np.full_like(file["basis"], np.nan)}
    write_tensors(path, "capture4d blendshapes", broken, note)
    assert "found NaN or inf" in fails(capsys, *animate(model, poses, tmp_path / "x"))
    fewer = {**file.tensors, "template_vertices": file["template_vertices"][:-1]}
    write_tensors(path, "capture4d blendshapes", fewer, note)
    assert "expected indices from 0 to 278" in fails(capsys, *animate(model, poses, tmp_path / "x"))
    write_tensors(path, "capture4d blendshapes", {**file.tensors, "std": 2 * file["std"]}, note)
    assert "of another model" in fails(capsys, *animate(model, poses, tmp_path / "x"))
    path.write_bytes(whole)

    linear = read_tensors(model / "linear.safetensors", "capture4d linear regressor")
    entries = {key: value for key, value in linear.note.items() if key != "kind"}
    spoilt = {**linear.tensors, "intercept": np.full_like(linear["intercept"], np.nan)}
    write_tensors(model / "linear.safetensors", "capture4d linear regressor", spoilt, entries)
    assert "found NaN or inf in 'intercept'" in fails(capsys, *animate(model, poses, tmp_path / "x"))


def test_the_model_is_read_once(model: Path, works, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Path] = []

    def counted(path: Path) -> BlendshapeModel:
        read.append(path)
        return load_blendshapes(path)

    monkeypatch.setattr(garment_model, "load_blendshapes", counted)
    assert run(*animate(model, works[0] / "body" / "poses.npz", tmp_path / "out")) == 0
    assert len(list((tmp_path / "out" / "registration" / "frames").glob("*.npz"))) == 16
    assert read == [model / "blendshapes.safetensors"]
