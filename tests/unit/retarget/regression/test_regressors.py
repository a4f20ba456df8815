"""Linear regression, kernels and the network: exactness, parameter counts, streaming, drift, resuming."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.files.atomic import write_bytes
from capture4d.files.tensors import read_tensors, write_tensors
from capture4d.types import PoseSequence
from retarget.config import ControlConfig, FitConfig, KernelConfig, LinearConfig, LstmConfig, TrainingConfig
from retarget.regression.controls import ControlLayout, control_vectors
from retarget.regression.ensemble import ensemble
from retarget.regression.kernel import fit_kernel, load_kernel, save_kernel
from retarget.regression.linear import fit_linear, load_linear, save_linear
from retarget.regression.lstm import EncoderDecoder, LstmRegressor, load_lstm, save_lstm
from retarget.regression.regressors import Clip, FittingClips, History, mean_squared_error, with_history
from retarget.regression.training import fit_lstm, train_lstm

NAMES = ("root", "middle", "top")
SMALL = LstmConfig(layers=2, size=24, over_linear=False)
QUICK = FitConfig(lstm=SMALL, training=TrainingConfig(epochs=6, batch=16, patience=10))


def layout(**settings) -> ControlLayout:
    return ControlLayout(NAMES, (1, 2), 60.0, ControlConfig(**settings), (-1, 0, 1))


@pytest.fixture
def clips(motion, make_world):
    """Clips of a world whose garment lags behind; the last validates."""

    def make(lag: float = 3.0, frames: int = 60, count: int = 4, chosen: ControlLayout | None = None) -> list[Clip]:
        world, layout_ = make_world(lag), chosen or layout()
        found = []
        for seed in range(count):
            poses = motion(frames, seed)
            wanted = world.coefficients(poses).astype(np.float32)
            found.append(Clip(control_vectors(layout_, poses), wanted, np.ones(frames, bool)))
        return found

    return make


def spread(clips: list[Clip]) -> np.ndarray:
    return np.concatenate([clip.coefficients for clip in clips]).std(axis=0)


def test_a_linear_garment_is_found_exactly() -> None:
    rng = np.random.default_rng(0)
    chosen = layout()
    matrix, intercept = rng.standard_normal((chosen.size, 3)), rng.standard_normal(3)
    controls = rng.standard_normal((80, chosen.size)).astype(np.float32)
    clip = Clip(controls, (controls @ matrix + intercept).astype(np.float32), np.ones(80, bool))
    found = fit_linear(FittingClips([clip], [clip], [clip]), chosen, spread([clip]), LinearConfig(ridges=(0.0,)))
    np.testing.assert_allclose(found.predict(controls), clip.coefficients, atol=1e-4)
    printed = fit_linear(
        FittingClips([clip], [clip], [clip]), chosen, spread([clip]), LinearConfig(fit="moore-penrose")
    )
    slow = clip.coefficients.T @ np.linalg.pinv(controls.T.astype(float))
    np.testing.assert_allclose(printed.predict(controls), controls @ slow.T, atol=1e-3)
    assert mean_squared_error(printed, [clip]) > 100 * mean_squared_error(found, [clip])  # it has no intercept


def test_the_ridge_is_the_one_that_validates_best_and_bad_frames_do_not_count(clips) -> None:
    known = clips(frames=14)
    spoilt = Clip(known[0].controls, known[0].coefficients.copy(), known[0].good.copy())
    spoilt.coefficients[5], spoilt.good[5] = 1e3, False
    chosen, config = layout(), LinearConfig()
    found = fit_linear(FittingClips([spoilt], known[2:], [spoilt]), chosen, spread(known), config)
    errors = {
        ridge: mean_squared_error(
            fit_linear(FittingClips([spoilt], [], [spoilt]), chosen, spread(known), LinearConfig(ridges=(ridge,))),
            known[2:],
        )
        for ridge in config.ridges
    }
    assert errors[found.ridge] == min(errors.values())
    assert found.ridge > 0
    assert min(errors.values()) < 1.0


def test_the_paper_s_network_has_as_many_numbers_as_counted() -> None:
    network = EncoderDecoder(60, 500, LstmConfig(layers=4))

    def size(module: torch.nn.Module) -> int:
        return sum(each.numel() for each in module.parameters())

    assert (size(network.encoder), size(network.decoder), size(network.head)) == (1_904_640, 2_355_200, 128_500)


@pytest.mark.parametrize("history", [0, 2])
@pytest.mark.parametrize("kind", ["linear", "kernel", "lstm", "over linear"])
def test_streaming_equals_batch(clips, kind: str, history: int, tmp_path: Path) -> None:
    chosen = layout(history=history)
    known = clips(chosen=chosen)
    found = linear = fit_linear(
        FittingClips(known[:3], known[3:], known[:3]), chosen, spread(known), LinearConfig(ridges=(0.1,))
    )
    if kind == "kernel":
        found = fit_kernel(FittingClips.create(known[:3], known[3:]), chosen, spread(known), KernelConfig())
    elif kind != "linear":
        network = LstmConfig(layers=2, size=16, over_linear=kind == "over linear")
        config = FitConfig(lstm=network, training=TrainingConfig(epochs=2))
        lesson = FittingClips.create(known[:3], known[3:])
        found = train_lstm(lesson, chosen, spread(known), tmp_path, config, linear=linear).regressor
    whole = found.predict(known[3].controls)
    stream = found.stream()
    again = np.stack([stream.push(row) for row in known[3].controls])
    np.testing.assert_allclose(again, whole, atol=1e-5 * np.abs(whole).max())


def test_kernels_and_network_are_one_that_sees_the_controls_of_both(motion, clips, tmp_path: Path) -> None:
    wide = layout(whole_rotations=True, lags=(6, 18))
    known, plain = clips(chosen=wide), clips()
    kernel = fit_kernel(FittingClips.create(known), wide, spread(known), KernelConfig())
    network = train_lstm(FittingClips.create(plain), layout(), spread(plain), tmp_path, QUICK).regressor
    both = ensemble(kernel, network)
    assert both is not None
    wanted = 0.75 * kernel.predict(known[3].controls) + 0.25 * network.predict(plain[3].controls)
    np.testing.assert_allclose(both.predict(known[3].controls), wanted, atol=1e-6)
    stream = both.stream()
    again = np.stack([stream.push(row) for row in known[3].controls])
    np.testing.assert_allclose(again, wanted, atol=1e-5 * np.abs(wanted).max())


@pytest.mark.parametrize(
    ("wide", "narrow", "found"),
    [
        ({"lags": (2, 5), "up": True}, {"lags": (5,)}, True),
        ({"whole_rotations": True, "joint_velocity": True}, {"joint_velocity": True, "root_motion": False}, True),
        ({"lags": (2,)}, {"lags": (3,)}, False),
        ({"whole_rotations": True, "lags": (2,)}, {"lags": (2,)}, False),  # its lags have twice the numbers
        ({"derivative_frames": 5}, {"derivative_frames": 3}, False),
        ({"root_motion": False}, {}, False),
    ],
)
def test_controls_are_found_in_a_wider_layout(motion, wide, narrow, found: bool) -> None:
    poses = motion(30, 0)
    columns = layout(**wide).columns_of(layout(**narrow))
    assert (columns is not None) == found
    if columns is not None:
        all_of_them = control_vectors(layout(**wide), poses)
        np.testing.assert_array_equal(all_of_them[:, columns], control_vectors(layout(**narrow), poses))


def test_controls_of_other_joints_or_another_rate_are_not_found() -> None:
    for other in (replace(layout(), joints=(1,)), replace(layout(), fps=30.0)):
        assert layout().columns_of(other) is None


def test_what_training_sees_of_the_frames_before_is_what_a_stream_carries_on(clips) -> None:
    (clip,) = clips(count=1)
    std = spread([clip])
    history, rows = History(2, len(std)), []
    for controls, coefficients in zip(clip.controls, clip.coefficients, strict=True):
        rows.append(history.extend(controls))
        history.push(coefficients / std)
    np.testing.assert_allclose(np.stack(rows), with_history(clip, 2, std).controls, atol=1e-5)


def test_running_freely_does_not_drift(clips, tmp_path: Path) -> None:
    """The same second of motion over and over gives the same answers at the end as at the start."""
    for history in (0, 2):
        chosen = layout(history=history)
        known = clips(chosen=chosen)
        lesson = FittingClips(known[:3], known[3:], known[:3])
        linear = fit_linear(lesson, chosen, spread(known), LinearConfig())
        network = train_lstm(lesson, chosen, spread(known), tmp_path / str(history), QUICK).regressor
        loop = np.tile(known[3].controls[:50], (20, 1))
        for regressor in (linear, network) if history else (network,):  # those that carry something on
            said = regressor.predict(loop).reshape(20, 50, -1)
            np.testing.assert_allclose(said[-1], said[2], atol=0.02 * np.abs(said).max())


def bending(frames: int, seed: int) -> Clip:
    """One joint that bends to and fro; the garment folds the same way on either side, which no line can say."""
    phase, rate = np.random.default_rng(seed).uniform(1, 3, 2)
    angle = np.sin(phase + rate * np.arange(frames) / 20)
    rotations = np.tile(np.eye(3, dtype=np.float32), (frames, 3, 1, 1))
    rotations[:, 1] = Rotation.from_euler("z", angle[:, None]).as_matrix()
    still, shape = np.zeros((frames, 3), np.float32), np.zeros(2, np.float32)
    poses = PoseSequence(rotations, still, shape, np.arange(frames, dtype=np.int32), 60.0, NAMES)
    wanted = np.stack([np.abs(angle), 0.3 * np.cos(3 * angle)], axis=1)
    return Clip(control_vectors(layout(), poses), wanted.astype(np.float32), np.ones(frames, bool))


def test_the_network_learns_what_a_line_cannot(tmp_path: Path) -> None:
    known = [bending(80, seed) for seed in range(4)]
    lesson = FittingClips(known[:3], known[3:], known[:3])
    linear = fit_linear(lesson, layout(), spread(known), LinearConfig())
    config = FitConfig(
        lstm=LstmConfig(layers=1, size=32, over_linear=False),
        training=TrainingConfig(epochs=30, batch=16, learning_rate=1e-2),
    )
    network = train_lstm(lesson, layout(), spread(known), tmp_path, config).regressor
    backwards = Clip(known[3].controls[::-1].copy(), known[3].coefficients[::-1].copy(), known[3].good)
    for clip in (known[3], backwards):
        assert mean_squared_error(network, [clip]) < 0.65 * mean_squared_error(linear, [clip])


def test_kernels_learn_what_a_line_cannot() -> None:
    known = [bending(80, seed) for seed in range(4)]
    lesson = FittingClips(known[:3], known[3:], known[:3])
    linear = fit_linear(lesson, layout(), spread(known), LinearConfig())
    kernel = fit_kernel(lesson, layout(), spread(known), KernelConfig(ridges=(0.01,)))
    assert mean_squared_error(kernel, known[3:]) < 0.1 * mean_squared_error(linear, known[3:])


SIDED = ("root", "spine", "arm.L", "arm.R")


def lifted(left: np.ndarray, right: np.ndarray) -> Clip:
    """Two arms and a spine; each arm's folds, bent as they are, are its own."""
    frames = len(left)
    rotations = np.tile(np.eye(3, dtype=np.float32), (frames, 4, 1, 1))
    for joint, angle in ((1, 0.1 * left * right), (2, left), (3, right)):
        rotations[:, joint] = Rotation.from_euler("z", angle[:, None]).as_matrix()
    still, shape = np.zeros((frames, 3), np.float32), np.zeros(2, np.float32)
    poses = PoseSequence(rotations, still, shape, np.arange(frames, dtype=np.int32), 60.0, SIDED)
    wanted = np.stack([np.cos(3 * left), np.cos(3 * right)], axis=1).astype(np.float32)
    chosen = ControlLayout(SIDED, (1, 2, 3), 60.0, ControlConfig(root_motion=False))
    return Clip(control_vectors(chosen, poses), wanted, np.ones(frames, bool))


def test_folds_of_one_arm_are_known_though_the_other_was_never_seen_there() -> None:
    """One arm moves in each clip; then both do. Without sides in the joints' names, one kernel covers all rotations."""
    sweep, still = np.linspace(-1, 1, 60), np.zeros(60)
    lesson = FittingClips.create([lifted(sweep, still), lifted(still, sweep)])
    both = [lifted(sweep, -sweep), lifted(sweep, sweep[::-1] * 0.7)]
    chosen = ControlLayout(SIDED, (1, 2, 3), 60.0, ControlConfig(root_motion=False))
    config = KernelConfig(ridges=(1e-3,))
    sided = fit_kernel(lesson, chosen, np.ones(2), config)
    blind = fit_kernel(lesson, replace(chosen, joint_names=("a", "b", "c", "d")), np.ones(2), config)
    assert (len(sided.views), len(blind.views)) == (5, 3)  # the spine has not moved
    assert mean_squared_error(sided, both) < 0.5 * mean_squared_error(blind, both)
    assert mean_squared_error(sided, lesson.training) < 1e-3


def test_kernels_choose_a_ridge_by_validation_then_learn_from_all_and_from_no_more_than_allowed(clips) -> None:
    known, chosen = clips(frames=20), layout()
    lesson = FittingClips.create(known[:2], known[2:3])
    config = KernelConfig(ridges=(0.05, 0.15, 0.5))
    found = fit_kernel(lesson, chosen, spread(known), config)
    errors = {
        ridge: mean_squared_error(
            fit_kernel(lesson.settled, chosen, spread(known), KernelConfig(ridges=(ridge,))), lesson.validation
        )
        for ridge in config.ridges
    }
    assert errors[found.ridge] == min(errors.values())
    assert len(found.frames) == 60
    few = fit_kernel(lesson, chosen, spread(known), KernelConfig(most_frames=25))
    assert len(few.frames) == 25
    assert np.isfinite(few.predict(known[3].controls)).all()
    assert found.predict(known[3].controls[:0]).shape == (0, known[3].coefficients.shape[1])
    bad = [replace(clip, good=np.zeros(20, bool)) for clip in known]
    with pytest.raises(InputError, match="at least 2 good frames to learn from, found 0"):
        fit_kernel(FittingClips.create(bad), chosen, spread(known), config)


def test_the_network_ends_with_all_clips_for_as_long_as_it_took_to_validate(clips, tmp_path: Path) -> None:
    known = clips(frames=20)
    lesson = FittingClips.create(known[:2], known[2:])
    linear = fit_linear(lesson, layout(), spread(known), LinearConfig())
    config = FitConfig(lstm=SMALL, training=TrainingConfig(epochs=8, batch=16, patience=3))

    def go(name: str, clips: FittingClips) -> list[dict]:
        fit_lstm(clips, layout(), spread(known), tmp_path / name, config, linear=linear)
        lines = (tmp_path / name / "final" / "metrics.jsonl").read_text().splitlines()
        return [json.loads(line) for line in lines]

    final = go("both", lesson)
    first = (tmp_path / "both" / "training" / "metrics.jsonl").read_text().splitlines()
    assert len(final) == json.loads(first[-1])["best_epoch"] + 1
    assert final[-1]["best_epoch"] == len(final) - 1
    go("alone", FittingClips.create(known))
    assert not (tmp_path / "alone" / "training").exists()


def test_training_stops_early_and_keeps_the_best(clips, tmp_path: Path) -> None:
    known = clips(frames=20, count=2)
    noise = Clip(known[1].controls, -known[1].coefficients, known[1].good)
    config = FitConfig(lstm=SMALL, training=TrainingConfig(epochs=200, patience=3, learning_rate=5e-3))
    lesson = FittingClips.create(known[:1], [noise])
    found, epochs = train_lstm(lesson, layout(), spread(known), tmp_path, config)
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert len(lines) < 200
    errors = [json.loads(line)["validation_mse_mm2"] for line in lines]
    assert 1e6 * mean_squared_error(found, [noise]) == pytest.approx(min(errors))
    assert epochs == int(np.argmin(errors)) + 1


def weights(regressor: LstmRegressor) -> dict[str, bytes]:
    return {name: each.numpy().tobytes() for name, each in regressor.network.state_dict().items()}


@pytest.mark.parametrize("fitted", [False, True])
def test_a_run_that_stopped_anywhere_ends_with_the_same_bits(clips, tmp_path: Path, monkeypatch, fitted: bool) -> None:
    """The network alone, and as `fit` learns it: over a linear regression, with validation and then from all clips."""
    known = clips(count=3)
    config = FitConfig(
        lstm=LstmConfig(layers=2, size=24, over_linear=fitted),
        training=TrainingConfig(epochs=5, batch=16, checkpoint_s=0.0, teacher_forcing=0.5),
    )
    lesson = FittingClips.create(known[:2], known[2:])
    linear = fit_linear(lesson, layout(), spread(known), LinearConfig())

    def go(folder: Path) -> LstmRegressor:
        if fitted:
            return fit_lstm(lesson, layout(), spread(known), folder, config, linear=linear).regressor
        return train_lstm(lesson, layout(), spread(known), folder, config).regressor

    whole = go(tmp_path / "whole")
    step = torch.optim.Adam.step
    done = 0

    def stop_after(limit: int):
        def counted(self, *arguments):
            nonlocal done
            done += 1
            if done > limit:
                raise KeyboardInterrupt
            return step(self, *arguments)

        return counted

    for limit in (3, 12, 20, *([8] if fitted else [])):  # stops of one run; the last among all clips
        done = 0
        monkeypatch.setattr(torch.optim.Adam, "step", stop_after(limit))
        with pytest.raises(KeyboardInterrupt):
            go(tmp_path / "stopped")
        torch.manual_seed(limit)  # whatever happens in between
    monkeypatch.setattr(torch.optim.Adam, "step", step)
    assert weights(go(tmp_path / "stopped")) == weights(whole)
    for part in ("training", "final") if fitted else (".",):
        logs = [tmp_path / name / part / "metrics.jsonl" for name in ("stopped", "whole")]
        assert logs[0].read_bytes() == logs[1].read_bytes()


TRAIN = """
import sys, pathlib, numpy as np
from retarget.config import *
from retarget.regression.controls import ControlLayout
from retarget.regression.regressors import Clip, FittingClips, mean_squared_error
from retarget.regression.training import train_lstm
from retarget.regression.lstm import save_lstm
rng = np.random.default_rng(0)
layout = ControlLayout(("root", "a"), (1,), 60.0, ControlConfig())
controls = rng.standard_normal((400, layout.size)).astype(np.float32)
clip = Clip(controls, np.sin(controls[:, :3]), np.ones(400, bool))
config = FitConfig(
    lstm=LstmConfig(layers=2, size=32, over_linear=False),
    training=TrainingConfig(epochs=12, batch=8, checkpoint_s=0.05),
)
found = train_lstm(FittingClips([clip], [clip], [clip]), layout, np.ones(3), pathlib.Path(sys.argv[1]), config)
save_lstm(pathlib.Path(sys.argv[1]) / "done.safetensors", found.regressor, model_digest="x")
"""


@pytest.mark.slow
def test_a_killed_run_ends_with_the_same_bits(tmp_path: Path) -> None:
    def start(folder: str) -> subprocess.Popen:
        return subprocess.Popen([sys.executable, "-c", TRAIN, str(tmp_path / folder)], cwd=Path(__file__).parents[4])

    assert start("whole").wait() == 0
    for kill in range(3):
        process = start("killed")
        checkpoint = tmp_path / "killed" / "checkpoints" / "last.safetensors"
        waited = time.monotonic() + 120
        before = checkpoint.stat().st_mtime_ns if checkpoint.is_file() else 0
        while time.monotonic() < waited and process.poll() is None:
            if checkpoint.is_file() and checkpoint.stat().st_mtime_ns > before:
                break
            time.sleep(0.01)
        time.sleep(0.05 * kill)
        if process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert start("killed").wait() == 0
    assert (tmp_path / "killed" / "done.safetensors").read_bytes() == (
        tmp_path / "whole" / "done.safetensors"
    ).read_bytes()


def test_files_come_back_as_they_were_and_wrong_ones_are_one_line(clips, tmp_path: Path) -> None:
    known, chosen = clips(count=2), layout(up=True, lags=(4,))
    known = clips(count=2, chosen=chosen)
    linear = fit_linear(FittingClips(known[:1], known[1:], known[:1]), chosen, spread(known), LinearConfig())
    config = replace(QUICK, lstm=LstmConfig(layers=1, size=8, over_linear=True))
    lesson = FittingClips.create(known[:1], known[1:])
    network = train_lstm(lesson, chosen, spread(known), tmp_path, config, linear=linear).regressor
    save_linear(tmp_path / "linear.safetensors", linear, model_digest="m")
    save_lstm(tmp_path / "lstm.safetensors", network, model_digest="m")
    kernel = fit_kernel(FittingClips.create(known), chosen, spread(known), KernelConfig())
    save_kernel(tmp_path / "kernel.safetensors", kernel, model_digest="m")
    twin = load_kernel(tmp_path / "kernel.safetensors", model_digest="m")
    assert (twin.layout, twin.ridge) == (chosen, kernel.ridge)
    np.testing.assert_array_equal(twin.predict(known[1].controls), kernel.predict(known[1].controls))
    file = read_tensors(tmp_path / "kernel.safetensors", "capture4d kernel regressor")
    entries = {key: value for key, value in file.note.items() if key != "kind"}
    tensors = {**file.tensors, "answers": file["answers"][:-1]}
    write_tensors(tmp_path / "short.safetensors", "capture4d kernel regressor", tensors, entries)
    with pytest.raises(InputError, match=r"short\.safetensors: expected learned frames of"):
        load_kernel(tmp_path / "short.safetensors", model_digest="m")
    again = load_linear(tmp_path / "linear.safetensors", model_digest="m")
    assert again.layout == chosen
    np.testing.assert_array_equal(again.predict(known[1].controls), linear.predict(known[1].controls))
    back = load_lstm(tmp_path / "lstm.safetensors", model_digest="m", linear=again)
    np.testing.assert_array_equal(back.predict(known[1].controls), network.predict(known[1].controls))
    with pytest.raises(InputError, match="of another model"):
        load_linear(tmp_path / "linear.safetensors", model_digest="other")
    with pytest.raises(InputError, match="expected capture4d lstm regressor, found capture4d linear"):
        load_lstm(tmp_path / "linear.safetensors", model_digest="m")
    with pytest.raises(InputError, match="beside it, found none"):
        load_lstm(tmp_path / "lstm.safetensors", model_digest="m")
    write_bytes(tmp_path / "cut.safetensors", (tmp_path / "lstm.safetensors").read_bytes()[:-100])
    with pytest.raises(InputError, match=r"cut\.safetensors: not a readable safetensors file"):
        load_lstm(tmp_path / "cut.safetensors", model_digest="m")
    torch.save({}, tmp_path / "lstm.pt")
    with pytest.raises(InputError, match="found a pickle or an archive"):
        load_lstm(tmp_path / "lstm.pt", model_digest="m")


def test_an_unknown_device_is_one_line(clips, tmp_path: Path) -> None:
    known = clips(count=2)
    with pytest.raises(InputError, match="device: expected one that torch can use"):
        train_lstm(FittingClips.create(known), layout(), spread(known), tmp_path, QUICK, device="nonsense")


def test_a_checkpoint_that_cannot_be_continued_is_one_line(clips, tmp_path: Path) -> None:
    known = clips(count=1, frames=20)
    lesson = FittingClips.create(known)
    path = tmp_path / "checkpoints" / "last.safetensors"
    train_lstm(lesson, layout(), spread(known), tmp_path, QUICK)
    wider = replace(QUICK, lstm=replace(SMALL, size=25))
    with pytest.raises(InputError, match=r"weights of another architecture: .*; to start anew: capture4d fit .*--over"):
        train_lstm(lesson, layout(), spread(known), tmp_path, wider)
    write_tensors(path, "capture4d training checkpoint", {}, {})  # as versions wrote them that had another format
    with pytest.raises(InputError, match=r"expected capture4d lstm training, found .*to start anew") as no:
        train_lstm(lesson, layout(), spread(known), tmp_path, QUICK)
    assert str(no.value).startswith(f"{path}: ")
