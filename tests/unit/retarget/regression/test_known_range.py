"""Answers are those of the regressor where it was taught, and stay within what was learned everywhere else."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from capture4d.captures.animations.known_poses import PoseRange, pose_quaternions
from capture4d.errors import InputError
from capture4d.types import PoseSequence
from retarget.config import ControlConfig
from retarget.regression.controls import ControlLayout, control_vectors
from retarget.regression.known_range import (
    FADED,
    BoundedRegressor,
    CoefficientRange,
    ControlRange,
    KnownRange,
    load_known_range,
    save_known_range,
)
from retarget.regression.regressors import Clip, Trust

SAFE_DEG = 10.0
LAYOUTS = {
    "paper": ControlConfig(),
    "kernels": ControlConfig(whole_rotations=True, up=True, joint_velocity=True, lags=(2,)),
}


@dataclass(frozen=True)
class Doubled:
    """A regressor that goes on for ever: the first three controls times two."""

    layout: ControlLayout

    def stream(self):
        return self

    def push(self, controls):
        return self.predict(controls[None])[0]

    def predict(self, controls):
        return 2 * np.asarray(controls, np.float32)[:, :3]


@pytest.fixture(params=LAYOUTS)
def layout(request, body) -> ControlLayout:
    return ControlLayout(body.joint_names, (1, 2), 60.0, LAYOUTS[request.param], (-1, 0, 1))


@pytest.fixture
def clip(layout, motion) -> Clip:
    controls = control_vectors(layout, motion(80, 4))
    return Clip(controls, Doubled(layout).predict(controls), np.ones(80, bool))


@pytest.fixture
def bounded(layout, clip) -> BoundedRegressor:
    coefficients = CoefficientRange.of([clip], clip.coefficients.std(axis=0))
    return BoundedRegressor(Doubled(layout), ControlRange.of([clip], layout), coefficients, SAFE_DEG)


def turned(poses: PoseSequence, degrees: float, joint: int = 1) -> PoseSequence:

    rotations = poses.rotations.copy()
    rotations[:, joint] = rotations[:, joint] @ Rotation.from_rotvec([0, np.radians(degrees), 0]).as_matrix()
    return replace(poses, rotations=rotations.astype(np.float32))


def test_what_was_learned_is_answered_as_it_was(bounded, clip) -> None:
    controls, trust = bounded.controls.bounded(clip.controls, bounded.layout, SAFE_DEG)
    np.testing.assert_allclose(controls, clip.controls, atol=1e-6)
    np.testing.assert_array_equal(trust, 1.0)
    np.testing.assert_allclose(bounded.predict(clip.controls), clip.coefficients, atol=1e-6)


def test_a_pose_a_little_off_is_answered_as_it_is(bounded, layout, motion) -> None:
    near = control_vectors(layout, turned(motion(80, 4), 5.0))
    pose = layout.pose_columns
    np.testing.assert_allclose(bounded.controls.bounded(near, layout, SAFE_DEG)[0][:, pose], near[:, pose], atol=1e-6)


def test_far_from_every_pose_the_mean_garment_is_left(bounded, layout, motion) -> None:
    """Half a turn of one of two joints: 127 degrees."""
    far = control_vectors(layout, turned(motion(80, 4), 180.0))
    np.testing.assert_array_equal(bounded.predict(far), 0.0)


def test_trust_falls_with_the_distance(bounded, layout, motion) -> None:
    still = motion(80, 4)
    trusts = []
    for degrees in (0, 20, 35, 50, 90):
        controls, trust = bounded.controls.bounded(control_vectors(layout, turned(still, degrees)), layout, SAFE_DEG)
        assert np.isfinite(controls).all()
        trusts.append(trust.mean())
    assert trusts[0] == 1.0
    assert (np.diff(trusts) <= 1e-9).all()
    assert trusts[-1] < 0.05


def test_motion_beyond_what_was_learned_fades_to_what_the_pose_says(bounded, layout, clip) -> None:
    parts = {name: part for name, part, moves in layout.parts if moves}
    for name, part in parts.items():
        fast = clip.controls.copy()
        along = np.zeros(part.stop - part.start)
        along[0] = 1.0
        index = [each for each, _, _ in layout.parts].index(name)
        largest = float(bounded.controls.largest[index])
        sizes = []
        for times in (0.5, 1.0, 1.5, 2.0, FADED, 100.0):
            fast[:, part] = bounded.controls.mean[part] + times * largest * along
            found = bounded.controls.bounded(fast, layout, SAFE_DEG)[0]
            sizes.append(np.linalg.norm(found[0, part] - bounded.controls.mean[part]) / largest)
            others = np.delete(np.arange(layout.size), np.arange(part.start, part.stop))
            np.testing.assert_allclose(found[:, others], clip.controls[:, others], atol=1e-6)
        np.testing.assert_allclose(sizes, [0.5, 1.0, 0.84375, 0.5, 0.0, 0.0], atol=1e-4)


@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0, 1e6))
@settings(max_examples=60, deadline=None)
def test_coefficients_never_leave_what_was_learned(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    std = rng.uniform(0.01, 2, 5)
    clip = Clip(
        np.zeros((30, 2), np.float32), (rng.standard_normal((30, 5)) * std).astype(np.float32), np.ones(30, bool)
    )
    known = CoefficientRange.of([clip], std)
    found = known.inside(scale * rng.standard_normal((20, 5)))
    assert (np.abs(found) <= np.abs(clip.coefficients).max(axis=0) * (1 + 1e-5)).all()
    lengths = np.linalg.norm(clip.coefficients / known.std, axis=1)
    assert np.linalg.norm(found / known.std, axis=1).max() <= lengths.max() * (1 + 1e-5)
    np.testing.assert_allclose(known.inside(clip.coefficients), clip.coefficients, rtol=1e-5)


def test_a_walk_that_goes_off_changes_without_jumps(bounded, layout, motion) -> None:
    """Answers move no faster than a few times as fast as the controls do, from known poses to strange ones."""
    still = motion(2, 4)
    steps = np.linspace(0, 120, 481)
    controls = np.concatenate([control_vectors(layout, turned(still, degrees))[:1] for degrees in steps])
    answers = bounded.predict(controls)
    jumps = np.linalg.norm(np.diff(answers, axis=0), axis=1)
    assert jumps.max() < 0.05
    assert np.linalg.norm(answers, axis=1).max() <= bounded.coefficients.length * bounded.coefficients.std.max()


def test_frames_one_by_one_are_the_motion_at_once(bounded, layout, motion) -> None:
    controls = control_vectors(layout, turned(motion(30, 9), 25.0))
    stream = bounded.stream()
    np.testing.assert_allclose([stream.push(row) for row in controls], bounded.predict(controls), atol=1e-6)


def test_trust_is_the_share_that_comes_nearest_and_never_rises() -> None:
    """Right up to 10 degrees, half right at 20, of no use from 30; a lucky group farther out does not count."""
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((400, 3))
    distances = np.repeat([5.0, 20.0, 30.0, 40.0], 100)
    wanted = np.repeat([1.0, 0.5, -0.4, 0.6], 100)
    answers = truth / np.where(wanted == 0.5, 0.5, 1.0)[:, None] * np.where(wanted == -0.4, -1, 1)[:, None]
    trust = Trust.of(distances, answers, truth)
    np.testing.assert_allclose(trust.at(np.array([0.0, 5.0, 20.0])), [1, 1, 0.5], atol=0.05)
    assert (np.diff(trust.at(np.linspace(0, 60, 100))) <= 1e-9).all()
    assert trust.at(np.array([60.0]))[0] == trust.at(np.array([40.0]))[0] < 0.3
    assert trust.reach_deg == pytest.approx(20.0)
    shuffled = rng.permutation(400)
    again = Trust.of(distances[shuffled], answers[shuffled], truth[shuffled])
    np.testing.assert_allclose(again.knots, trust.knots, atol=0.1)
    assert Trust.of(distances[:5], answers[:5], truth[:5]).at(np.array([50.0]))[0] == 1


def test_answers_are_believed_by_the_share_that_was_shown(bounded, layout, motion) -> None:
    controls = control_vectors(layout, turned(motion(20, 4), 8.0))
    half = Trust(np.array([[0, 0.5]], np.float32))
    doubtful = replace(bounded, controls=replace(bounded.controls, trust=half))
    safe, _ = bounded.controls.bounded(controls, layout, bounded.safe_deg)
    raw, whole = 2 * safe[:, :3], bounded.predict(controls)
    inside = np.abs(raw) < 0.9 * bounded.coefficients.largest
    near = inside.all(axis=1) & (np.linalg.norm(raw / bounded.coefficients.std, axis=1) < bounded.coefficients.length)
    assert near.any()
    np.testing.assert_allclose(doubtful.predict(controls)[near], 0.5 * whole[near], atol=1e-5)


def test_answers_fade_to_the_garment_at_rest(bounded, layout, motion) -> None:
    resting = np.float32([0.3, -0.2, 0.1])
    fading = replace(bounded, coefficients=replace(bounded.coefficients, resting=resting))
    far = control_vectors(layout, turned(turned(motion(5, 4), 120.0), 120.0, 2))
    np.testing.assert_allclose(fading.predict(far), np.tile(resting, (5, 1)), atol=1e-6)
    near = control_vectors(layout, motion(80, 4))
    np.testing.assert_allclose(fading.predict(near), bounded.predict(near), atol=1e-6)


def test_it_comes_back_from_its_file(bounded, layout, motion, tmp_path: Path) -> None:
    poses = PoseRange(pose_quaternions(motion(9, 1).rotations, (1, 2)), (1, 2), 7.5)
    known = KnownRange(poses, {"linear": bounded.controls}, bounded.coefficients)
    save_known_range(tmp_path / "poses.safetensors", known, model_digest="a")
    found = load_known_range(tmp_path / "poses.safetensors", model_digest="a")
    assert (found.safe_deg("linear"), found.poses.joints) == (10.0, (1, 2))
    np.testing.assert_array_equal(found.controls["linear"].poses, bounded.controls.poses)
    np.testing.assert_array_equal(found.coefficients.largest, bounded.coefficients.largest)
    controls = control_vectors(layout, turned(motion(9, 9), 30.0))
    again = found.bounded("lstm", Doubled(layout))
    np.testing.assert_array_equal(again.predict(controls), bounded.predict(controls))
    with pytest.raises(InputError, match="found that of another model"):
        load_known_range(tmp_path / "poses.safetensors", model_digest="b")


@pytest.mark.parametrize(
    ("said", "fault"),
    [
        ("no kernel", "expected controls of the kernel regressor, found none"),
        ("a part less", r"linear: expected controls, parts and poses of .+, found"),
        ("a coefficient more", r"expected the range of \d+ coefficients, found \d+"),
        ("a joint more", r"expected poses of the joints .+, found \(1, 2\)"),
    ],
)
def test_a_range_of_another_regressor_is_one_line(bounded, layout, motion, said: str, fault: str) -> None:
    poses = PoseRange(pose_quaternions(motion(9, 1).rotations, (1, 2)), (1, 2), 7.5)
    controls = bounded.controls
    if said == "a part less":
        controls = replace(controls, largest=controls.largest[:-1])
    shapes = len(bounded.coefficients.std)
    known = KnownRange(replace(poses, joints=layout.joints), {"linear": controls}, bounded.coefficients)
    if said == "a joint more":
        known, layout = replace(known, poses=poses), replace(layout, joints=(1, 3))
    with pytest.raises(InputError, match=fault):
        known.require("kernel" if said == "no kernel" else "linear", layout, shapes + (said == "a coefficient more"))


def test_a_range_of_its_own_regressor_is_taken(bounded, layout, motion) -> None:
    poses = PoseRange(pose_quaternions(motion(9, 1).rotations, layout.joints), layout.joints, 7.5)
    known = KnownRange(poses, {"linear": bounded.controls}, bounded.coefficients)
    known.require("linear", layout, len(bounded.coefficients.std))
