"""Predictions, failures and resuming, on a tube around one bending bone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import pose_frame, skin
from capture4d.errors import InputError
from capture4d.types import Body, Garment, Mesh, PoseSequence
from registration.predictions import Mover, bent_away, blend, choose, misfit, predict
from registration.register import prepare_frame
from registration.sequence import register_run
from registration.template import analyse_template

FRAMES = 6


@pytest.fixture
def body() -> Body:
    mesh = Mesh(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], np.float32), np.array([[0, 1, 2]], np.int32))
    return Body(
        template=mesh,
        shape_directions=np.zeros((1, 3, 3), np.float32),
        joints=np.array([[0, 0, 0], [0, 0.25, 0]], np.float32),
        joint_directions=np.zeros((1, 2, 3), np.float32),
        joint_names=("root", "top"),
        parents=np.array([-1, 0], np.int32),
        skin_weights=np.tile(np.array([[1, 0]], np.float32), (3, 1)),
    )


@pytest.fixture
def poses() -> PoseSequence:
    rotations = np.tile(np.eye(3, dtype=np.float32), (FRAMES, 2, 1, 1))
    rotations[:, 1] = Rotation.from_euler("z", np.linspace(0, 20, FRAMES)[:, None], degrees=True).as_matrix()
    return PoseSequence(
        rotations, np.zeros((FRAMES, 3), np.float32), np.zeros(1, np.float32), np.arange(FRAMES, dtype=np.int32) * 10,
        60.0, ("root", "top"),
    )  # fmt: skip


@pytest.fixture
def bound(garment: Garment) -> Garment:
    return replace(garment, skin_weights=weights_at(garment.template.vertices))


def weights_at(points: np.ndarray) -> np.ndarray:
    top = np.clip((points[:, 1] - 0.15) / 0.2, 0, 1)
    return np.column_stack([1 - top, top]).astype(np.float32)


@pytest.fixture
def load(scan_of, body, poses):
    """Scans of a tube that moves with the bone exactly."""

    def read(frame_id: int):
        def warp(points: np.ndarray) -> np.ndarray:
            shaped = Mover.create(analysis, body, poses).shaped
            return skin(points, weights_at(points), pose_frame(shaped, poses, frame_id // 10).transforms)

        return replace(scan_of(warp, noise=3e-4), frame_id=frame_id)

    analysis = None

    def set_up(found):
        nonlocal analysis
        analysis = found
        return read

    return set_up


def go(analysis, mover, load, config, done=lambda position, before: None):
    frame_ids = tuple(range(0, 10 * FRAMES, 10))
    return list(register_run(analysis, mover, range(FRAMES), frame_ids, load=load, done=done, config=config))


def test_carrying_within_one_pose_changes_nothing(bound, body, poses, config) -> None:
    mover = Mover.create(analyse_template(bound, config), body, poses)
    skinned = mover.skinned(3)
    moved = (skinned + 0.01 * np.random.default_rng(0).standard_normal(skinned.shape)).astype(np.float32)
    np.testing.assert_allclose(mover.carried(moved, 3, 3), moved, atol=1e-6)
    np.testing.assert_allclose(mover.carried(mover.skinned(3).astype(np.float32), 3, 5), mover.skinned(5), atol=1e-6)


def test_joints_must_agree(bound, body, poses, config) -> None:
    with pytest.raises(InputError, match="expected the body's 2 joints"):
        Mover.create(analyse_template(bound, config), body, replace(poses, joint_names=("root", "other")))


def test_a_pose_is_as_far_as_its_bent_joints_and_the_cloth_they_carry(body, poses) -> None:
    turned = np.zeros((FRAMES, 2, 3))
    turned[1, 0] = turned[2, 1] = (0.0, 0.0, 0.5)
    turned[3, 1] = (0.0, 1.0, 0.0)
    rotations = Rotation.from_rotvec(turned.reshape(-1, 3)).as_matrix().reshape(FRAMES, 2, 3, 3)
    weights = np.array([[0, 1], [1, 0], [1, 0], [1, 0]], np.float32)
    away = bent_away(weights, body, replace(poses, rotations=rotations.astype(np.float32)))
    assert away == pytest.approx([0.0, 0.0, 0.25, 0.5, 0.0, 0.0], abs=1e-3)


def test_frames_follow_the_scan_and_start_from_the_best(bound, body, poses, config, load) -> None:
    analysis = analyse_template(bound, config)
    mover = Mover.create(analysis, body, poses)
    results = go(analysis, mover, load(analysis), config)
    assert "failed" not in [result.quality.verdict for result in results]
    assert results[0].started_from == "skinned, cold"
    assert all(result.started_from.endswith("warm") for result in results[1:])
    for index, result in enumerate(results):
        assert result.quality.numbers["fit_mean_mm"] < 0.5
        assert np.linalg.norm(result.vertices - mover.skinned(index), axis=1).mean() < 0.012


def test_a_failing_frame_is_flagged_and_the_take_goes_on(bound, body, poses, config, load) -> None:
    analysis = analyse_template(bound, config)
    read = load(analysis)

    def broken(frame_id: int):
        if frame_id == 20:
            raise InputError("scans/000020.ply: cut off")
        return read(frame_id)

    results = go(analysis, Mover.create(analysis, body, poses), broken, config)
    assert [result.quality.verdict for result in results] == ["good", "good", "failed", "good", "good", "good"]
    assert results[2].quality.reasons == ("scans/000020.ply: cut off",)
    assert np.isnan(results[2].quality.residual_m).all()
    assert np.isfinite(results[2].vertices).all()


def test_resuming_gives_the_same_bits(bound, body, poses, config, load) -> None:
    analysis = analyse_template(bound, config)
    mover, read = Mover.create(analysis, body, poses), load(analysis)
    whole = go(analysis, mover, read, config)
    earlier = {(result.position, result.before): (result.vertices, True) for result in whole[:3]}
    assert list(earlier) == [(0, None), (1, 0), (2, 1)]
    rest = go(analysis, mover, read, config, done=lambda *at: earlier.get(at))
    assert [result.frame_id for result in rest] == [30, 40, 50]
    for first, second in zip(whole[3:], rest, strict=True):
        np.testing.assert_array_equal(first.vertices, second.vertices)


def test_a_run_goes_on_from_the_end_of_another(bound, body, poses, config, load) -> None:
    analysis = analyse_template(bound, config)
    mover, read, frame_ids = Mover.create(analysis, body, poses), load(analysis), tuple(range(0, 10 * FRAMES, 10))
    whole = go(analysis, mover, read, config)
    rest = register_run(
        analysis, mover, range(4, FRAMES), frame_ids, load=read, done=lambda *at: None, config=config,
        before=(whole[3].vertices, 3),
    )  # fmt: skip
    for first, second in zip(whole[4:], rest, strict=True):
        np.testing.assert_array_equal(first.vertices, second.vertices)


def test_without_a_body_frames_follow_one_another(garment, body, poses, config, load, bound) -> None:
    read = load(analyse_template(bound, config))
    results = go(analyse_template(garment, config), None, read, config)
    assert [result.quality.verdict for result in results] == ["good"] * FRAMES
    assert results[0].started_from == "template, cold"
    assert results[1].started_from.startswith("previous")


def test_paints_of_unknown_loops_end_the_run_at_once(bound, body, poses, config, load) -> None:
    analysis = analyse_template(bound, config)
    read, asked = load(analysis), []

    def misnamed(frame_id: int):
        asked.append(frame_id)
        return replace(read(frame_id), loop_names=("waist", "collar"))

    with pytest.raises(InputError, match="expected border loops named collar, waist"):
        go(analysis, Mover.create(analysis, body, poses), misnamed, config)
    assert asked == [0]


def test_where_the_hem_lags_the_blend_is_nearer_than_both_its_parts(bound, body, poses, config, scan_of) -> None:
    """Everything turns, but the hem stays where it was: what is carried misses the hem, what is left misses the top."""
    analysis = analyse_template(bound, config)
    frame = 5
    spread = replace(poses, rotations=poses.rotations.copy())
    spread.rotations[:, 0] = Rotation.from_euler("z", np.linspace(0, 10, FRAMES)[:, None], degrees=True).as_matrix()
    mover = Mover.create(analysis, body, spread)

    def place(points: np.ndarray) -> np.ndarray:
        """The upper half where the bones take it, the hem where it was the frame before."""
        weights = weights_at(points)
        now, then = (skin(points, weights, pose_frame(mover.shaped, spread, at).transforms) for at in (frame, 3))
        share = np.clip((points[:, 1:2] - 0.2) / 0.1, 0, 1)
        return share * now + (1 - share) * then

    before = mover.skinned(3).astype(np.float32)
    scan = prepare_frame(analysis, scan_of(place), config)
    parts = predict(analysis, mover, frame, (before, 3), config)
    name, start, _ = choose(analysis, scan, parts, distant=False, config=config)
    assert name == "blended"
    assert set(parts) == {"carried", "previous", "skinned"}, "what is handed in stays"
    truth = place(analysis.rest)
    error = {key: np.linalg.norm(vertices - truth, axis=1).mean() for key, vertices in {**parts, name: start}.items()}
    assert error["blended"] < 0.7 * min(error["carried"], error["previous"])


def test_cloth_that_slid_without_a_trace_returns_towards_the_skinned_pose(bound, body, poses, config, scan_of) -> None:
    """A tube turned about its axis lies on the same surface: no distance to the scan tells it from the skinned pose."""
    analysis = analyse_template(bound, config)
    frame = 0
    mover = Mover.create(analysis, body, poses)
    skinned = mover.skinned(frame)
    middle = skinned.mean(axis=0)
    turn = Rotation.from_euler("y", 2, degrees=True)
    slid = (turn.apply(skinned - middle) + middle).astype(np.float32)
    transforms = pose_frame(mover.shaped, poses, frame).transforms
    scan = prepare_frame(analysis, scan_of(lambda points: skin(points, weights_at(points), transforms)), config)
    parts = predict(analysis, mover, frame, (slid, frame), config)
    misfits = {name: misfit(scan, part[analysis.coarse_vertices]) for name, part in parts.items()}

    def left(relax: float) -> float:
        blended = blend(analysis, parts, misfits, relax)
        return float(np.linalg.norm(blended - skinned, axis=1).mean() / np.linalg.norm(slid - skinned, axis=1).mean())

    np.testing.assert_allclose(left(0.0), 1.0, atol=1e-3)
    assert 0.5 < left(0.4) < 0.95, "a part of the way, for some of the sliding is real"
