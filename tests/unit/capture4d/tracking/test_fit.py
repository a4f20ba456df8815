"""Fitting the body: derivatives against finite differences, exact data, cloth, limits, and a take with bad frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.dressed_body import dress_body, sample_scan
from capture4d.body.anny import load_anny
from capture4d.body.posed_surface import BodyState, linearise, match, pose_surface, tracked_body
from capture4d.body.skinning import pose_frame, with_pose, with_shape
from capture4d.captures.points.scan_points import ScanPoints
from capture4d.tracking.config import FitConfig, Schedule, SequenceConfig, TrackingConfig
from capture4d.tracking.fit import fit_body
from capture4d.tracking.joint_prior import inverse_left_jacobian, joint_prior, limit_terms, pull_terms
from capture4d.tracking.sequence import Tracker, apart_mm, between, joint_shape, judge, outlying
from capture4d.types import Body, Mesh


@pytest.fixture(scope="module")
def stick() -> Body:
    """A bent tube of four joints and two shape components, generated: small enough for exhaustive checks."""
    around, along = 12, 40
    angle = np.tile(2 * np.pi * np.arange(around) / around, along)
    height = np.repeat(np.linspace(0, 1, along), around)
    radius = 0.08 + 0.03 * np.cos(3 * angle) + 0.02 * np.sin(9 * height)
    vertices = np.stack([radius * np.sin(angle), height, radius * np.cos(angle)], axis=1)
    row, column = np.divmod(np.arange(around * (along - 1)), around)
    a, b = row * around + column, row * around + (column + 1) % around
    faces = np.concatenate([np.stack([a, b, b + around], 1), np.stack([a, b + around, a + around], 1)])
    joints = np.array([[0, 0.1, 0], [0, 0.35, 0], [0, 0.6, 0], [0, 0.8, 0]])
    nearness = np.exp(-(((height[:, None] - joints[:, 1] - 0.1) / 0.12) ** 2)) + 1e-6
    wider = vertices * (1, 0, 1) * 0.1
    taller = vertices * (0, 1, 0) * 0.05
    return Body(
        template=Mesh(vertices.astype(np.float32), faces.astype(np.int32)),
        shape_directions=np.stack([wider, taller]).astype(np.float32),
        joints=joints.astype(np.float32),
        joint_directions=np.stack([0 * joints, joints * 0.05]).astype(np.float32),
        joint_names=("root", "spine1", "spine2", "head"),
        parents=np.array([-1, 0, 1, 2], np.int32),
        skin_weights=(nearness / nearness.sum(axis=1, keepdims=True)).astype(np.float32),
    )


def random_state(body: Body, rng: np.random.Generator, size: float = 0.3) -> BodyState:
    rest = tracked_body(body).rest_state()
    count = 3 + 3 * len(body.joint_names) + len(body.shape_directions)
    return rest.moved(size * rng.standard_normal(count))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_jacobian_is_the_derivative(stick: Body, seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = tracked_body(stick)
    state = random_state(stick, rng)
    surface = pose_surface(model, state)
    points = surface.vertices + 0.01 * rng.standard_normal(surface.vertices.shape)
    matches = match(surface, points, surface.normals)
    rows = linearise(surface, matches, np.ones(len(points), bool))

    def along(moved: BodyState) -> np.ndarray:
        corners = pose_surface(model, moved).vertices[stick.template.faces[matches.faces]]
        return np.einsum("nka,nk,na->n", corners, matches.barycentric, matches.normals)

    for parameter in range(rows.shape[1]):
        step = np.zeros(rows.shape[1])
        step[parameter] = 1e-5
        numeric = (along(state.moved(step)) - along(state.moved(-step))) / 2e-5
        np.testing.assert_allclose(rows[:, parameter], numeric, atol=2e-7)


def test_posing_agrees_with_the_body_module(stick: Body) -> None:
    state = random_state(stick, np.random.default_rng(3))
    posed = with_pose(with_shape(stick, state.shape), state.rotations, state.translation)
    np.testing.assert_allclose(pose_surface(tracked_body(stick), state).vertices, posed.vertices(), atol=1e-12)


def test_matches_are_the_nearest_points_of_the_surface(stick: Body) -> None:
    rng = np.random.default_rng(4)
    surface = pose_surface(tracked_body(stick), random_state(stick, rng, 0.1))
    corners = surface.vertices[stick.template.faces]
    faces = rng.integers(len(corners), size=200)
    weights = rng.dirichlet((2, 2, 2), size=200)
    true = np.einsum("nk,nka->na", weights, corners[faces])
    flat = np.cross(corners[faces, 1] - corners[faces, 0], corners[faces, 2] - corners[faces, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    found = match(surface, true + 0.002 * flat, flat)
    np.testing.assert_allclose(np.linalg.norm(found.points - true, axis=1).mean(), 0.0, atol=1e-4)
    np.testing.assert_allclose(found.barycentric.sum(axis=1), 1.0, atol=1e-12)
    assert found.barycentric.min() >= 0


@pytest.mark.parametrize("size", [1e-6, 0.5, 2.0, 3.0])
def test_the_inverse_left_jacobian_is_the_derivative_of_the_logarithm(size: float) -> None:
    rng = np.random.default_rng(5)
    vector = rng.standard_normal((1, 3))
    vector *= size / np.linalg.norm(vector)
    jacobian = inverse_left_jacobian(vector)[0]
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        ahead, back = (
            (Rotation.from_rotvec(sign * step) * Rotation.from_rotvec(vector[0])).as_rotvec() for sign in (1, -1)
        )
        np.testing.assert_allclose(jacobian[:, axis], (ahead - back) / 2e-6, atol=1e-6)


def test_a_pull_leads_to_its_target(stick: Body) -> None:
    rng = np.random.default_rng(6)
    target = Rotation.from_rotvec(rng.standard_normal((4, 3))).as_matrix()
    rotations = np.repeat(np.eye(3)[None], 4, axis=0)
    for _ in range(8):
        hessian, descent = pull_terms(rotations, target, np.full(4, 0.5))
        rotations = Rotation.from_rotvec(np.linalg.solve(hessian, descent[..., None])[..., 0]).as_matrix() @ rotations
    np.testing.assert_allclose(rotations, target, atol=1e-9)


def test_limits_leave_what_is_allowed_and_stop_knees_from_bending_forwards() -> None:
    body = load_anny()
    prior = joint_prior(body)
    knee = body.joint_names.index("lowerleg01.L")
    allowed = np.repeat(np.eye(3)[None], len(body.joint_names), axis=0)
    allowed[knee] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    hessian, descent = limit_terms(allowed, prior, 0.1)
    assert not hessian.any()
    assert not descent.any()
    beyond = allowed.copy()
    beyond[knee] = Rotation.from_euler("x", -40, degrees=True).as_matrix()
    _, descent = limit_terms(beyond, prior, 0.1)
    assert descent[knee, 0] > 0
    assert not np.delete(descent, knee, axis=0).any()


@pytest.mark.parametrize("seed", [0, 1])
def test_exact_points_give_the_exact_body(seed: int) -> None:
    """All of the surface, no noise: pose and shape come back as far as the priors let them."""
    body = load_anny()
    rng = np.random.default_rng(seed)
    model, prior = tracked_body(body), joint_prior(body)
    true = BodyState(
        Rotation.from_rotvec(0.2 * prior.spread.clip(max=0.5)[:, None] * rng.standard_normal((36, 3))).as_matrix(),
        np.array([0.2, 0.0, -0.1]),
        0.5 * rng.standard_normal(10),
    )
    surface = pose_surface(model, true)
    corners, weights = body.template.faces[model.sample_faces], model.sample_barycentric[:, :, None]
    points, normals = ((each[corners] * weights).sum(axis=1) for each in (surface.vertices, surface.normals))
    scan = ScanPoints(points, normals, np.zeros(len(points), bool))
    start = BodyState(true.rotations, true.translation, np.zeros(10)).moved(
        np.concatenate([0.02 * rng.standard_normal(3), 0.02 * rng.standard_normal(108), np.zeros(10)])
    )
    config = FitConfig(point_sigma_m=0.001)
    fit = fit_body(model, prior, scan, start, schedule=Schedule(60, 0.08, 0.01, 1e-7), config=config)
    found = pose_surface(model, fit.state)
    assert np.linalg.norm(found.vertices - surface.vertices, axis=1).mean() < 1e-3
    np.testing.assert_allclose(fit.state.shape, true.shape, atol=0.05)


def test_cloth_keeps_the_body_inside_and_does_not_inflate_it() -> None:
    """The same points, 2 cm outside of the trunk, as cloth and as skin."""
    body = load_anny()
    model, prior = tracked_body(body), joint_prior(body)
    surface = pose_surface(model, model.rest_state())
    trunk = np.isin(body.skin_weights.argmax(axis=1), [body.joint_names.index(f"spine0{k}") for k in range(1, 6)])
    points = surface.vertices + np.where(trunk[:, None], 0.02 * surface.normals, 0)
    moved = {}
    for name, cloth in (("cloth", trunk), ("skin", np.zeros_like(trunk))):
        scan = ScanPoints(points, surface.normals, cloth)
        fit = fit_body(model, prior, scan, model.rest_state(), schedule=Schedule(10, 0.05, 0.03), config=FitConfig())
        apart = pose_surface(model, fit.state).vertices - surface.vertices
        moved[name] = np.einsum("va,va->v", apart, surface.normals)[trunk].mean()
    assert abs(moved["cloth"]) < 0.002
    assert moved["skin"] > 0.008

    inside = ScanPoints(points - 0.04 * np.where(trunk[:, None], surface.normals, 0), surface.normals, trunk)
    fit = fit_body(model, prior, inside, model.rest_state(), schedule=Schedule(15, 0.05, 0.03), config=FitConfig())
    apart = pose_surface(model, fit.state).vertices - surface.vertices
    assert np.einsum("va,va->v", apart, surface.normals)[trunk].mean() < -0.005, "cloth pushes from outside"


def test_halfway_is_halfway(stick: Body) -> None:
    rng = np.random.default_rng(7)
    first, second = random_state(stick, rng), random_state(stick, rng)
    there = between(between(first, second, 0.5), second, 1.0)
    np.testing.assert_allclose(there.rotations, second.rotations, atol=1e-12)
    np.testing.assert_allclose(between(first, second, 0.0).rotations, first.rotations, atol=1e-12)


@pytest.mark.slow
def test_a_take_goes_on_after_bad_frames() -> None:
    """An empty scan is lost and flagged with a reason; the frames after it are tracked as if nothing had been."""
    from data_synth.motions import CLIPS, scripted_clip

    body = load_anny()
    rng = np.random.default_rng(8)
    person = with_shape(body, np.array([0.8, -0.5, 0.4], np.float32))
    poses = scripted_clip(person, CLIPS["reach"], 60.0, 8, rng)
    tracker = Tracker.create(body, TrackingConfig())
    start = BodyState(poses.rotations[0].astype(float), poses.translations[0].astype(float), np.zeros(10))
    followed = []
    for t in range(8):
        scan = sample_scan(dress_body(pose_frame(person, poses, t), 0.1 * t), rng, points=3000)
        if t == 4:
            scan = ScanPoints(scan.points[:60], scan.normals[:60], scan.cloth[:60])
        before = followed[-2] if t > 1 and followed[-2].lost_frames == 0 else None
        followed.append(tracker.follow(scan, followed[-1], before) if t else tracker.begin(scan, start))
    assert [each.quality.lost for each in followed] == [t == 4 for t in range(8)]
    assert "points on skin and suit" in followed[4].quality.reasons[0]
    last = pose_surface(tracker.model, followed[-1].state).vertices
    apart = np.linalg.norm(last - pose_frame(person, poses, 7).vertices(), axis=1)
    assert apart.mean() < 0.005


@pytest.mark.slow
def test_a_pose_is_found_from_nowhere() -> None:
    from data_synth.motions import random_pose

    body = load_anny()
    rng = np.random.default_rng(0)
    person = with_shape(body, rng.normal(0, 0.7, 4).astype(np.float32))
    rotations = random_pose(person, rng)
    rotations[0] = Rotation.from_euler("y", rng.uniform(0, 360), degrees=True).as_matrix()
    true = with_pose(person, rotations, np.array([0.3, 0.0, -0.2]))
    scan = sample_scan(dress_body(true, 1.0), rng, points=3500)
    state = Tracker.create(body, TrackingConfig()).begin(scan, None).state
    found = pose_surface(tracked_body(body), state)
    assert np.linalg.norm(found.vertices - true.vertices(), axis=1).mean() < 0.01


@pytest.mark.slow
def test_a_hop_that_faces_away_is_not_taken_for_its_mirror() -> None:
    """Knees bent, trunk tilted: with a free shape the search made a stranger person that faces the other way."""
    body = load_anny()
    person = with_shape(body, np.array([-1.0, 1.1, -0.5, 0.6, 0.3, -0.4], np.float32))
    turns = {
        "root": (25, 150, 0),
        "upperleg01.L": (-70, 0, 0),
        "lowerleg01.L": (75, 0, 0),
        "upperleg01.R": (-35, 0, 0),
        "lowerleg01.R": (60, 0, 0),
        "upperarm01.L": (0, -60, 0),
        "lowerarm01.L": (0, -70, 0),
    }
    rotations = np.repeat(np.eye(3)[None], len(body.joint_names), axis=0)
    for name, degrees in turns.items():
        rotations[body.joint_names.index(name)] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    true = with_pose(person, rotations, np.array([0.1, -0.15, 0.2]))
    scan = sample_scan(dress_body(true, 1.0), np.random.default_rng(3), points=3500)
    found = Tracker.create(body, TrackingConfig()).begin(scan, None)
    assert found.quality.reasons == ()
    surface = pose_surface(tracked_body(body), found.state)
    assert np.linalg.norm(surface.vertices - true.vertices(), axis=1).mean() < 0.01


def test_a_body_that_lies_off_most_points_is_flagged() -> None:
    """Front and back exchanged: nearly all points are explained, but none closely."""
    config = SequenceConfig()
    rng = np.random.default_rng(0)
    near = judge(0.001 * rng.standard_normal(2000), np.zeros(2000, bool), config)
    off = judge(0.005 * rng.standard_normal(2000), np.zeros(2000, bool), config)
    assert off.explained > config.check_explained
    assert near.reasons == ()
    assert len(off.reasons) == 1
    assert "3.4 mm from the body in the median" in off.reasons[0]


def test_a_frame_that_lies_off_as_no_other_of_the_take_is_an_outlier() -> None:
    medians = np.array([0.0008, 0.0007, np.nan, 0.0009, 0.0021, 0.0008])
    usual, outliers = outlying(medians, SequenceConfig())
    assert usual == 0.0008
    assert outliers.tolist() == [False, False, False, False, True, False]
    assert not outlying(medians / 10, SequenceConfig())[1].any(), "tenths of a millimetre are no fault"
    assert not outlying(np.full(3, np.nan), SequenceConfig())[1].any()


def test_a_bad_first_frame_says_nothing_about_the_shape() -> None:
    """Points that no body explains: what is seen in them must not hold the shape of the take."""
    body = load_anny()
    tracker = Tracker.create(body, TrackingConfig())
    rest = tracker.model.rest_state()
    surface = pose_surface(tracker.model, rest)
    rng = np.random.default_rng(3)
    chosen = rng.choice(len(surface.vertices), 600, replace=False)
    for away, good in ((0.0, True), (0.05, False)):
        shift = away * rng.standard_normal((600, 3))
        scan = ScanPoints(surface.vertices[chosen] + shift, surface.normals[chosen], np.zeros(600, bool))
        first = tracker.begin(scan, rest)
        assert (first.quality.reasons == ()) is good
        assert first.shape_information.any() == good


def test_unknown_shape_information_is_symmetric_and_positive(stick: Body) -> None:
    model, prior = tracked_body(stick), joint_prior(stick)
    true = random_state(stick, np.random.default_rng(9), 0.1)
    surface = pose_surface(model, true)
    scan = ScanPoints(surface.vertices, surface.normals, np.zeros(len(surface.vertices), bool))
    start = replace(true, shape=np.zeros(2))
    fit = fit_body(model, prior, scan, start, schedule=Schedule(10, 0.05, 0.02), config=FitConfig())
    information = fit.shape_information()
    np.testing.assert_allclose(information, information.T, rtol=1e-6)
    assert np.linalg.eigvalsh(information).min() > 1.0, "the prior alone is 1"


def test_the_shape_of_a_take_is_that_of_all_its_frames_together() -> None:
    """As if the segments' equations had been added up: the prior counts once, and what is known better counts more."""
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(3, 6, 4))
    information, sides = np.einsum("nka,nkb->nab", roots, roots), rng.normal(size=(3, 4))
    prior = 0.7
    shapes = [np.linalg.solve(each + prior * np.eye(4), side) for each, side in zip(information, sides, strict=True)]
    whole = np.linalg.solve(information.sum(axis=0) + prior * np.eye(4), sides.sum(axis=0))
    np.testing.assert_allclose(joint_shape(shapes, list(information), prior), whole, rtol=1e-9)
    np.testing.assert_allclose(joint_shape(shapes[::-1], list(information[::-1]), prior), whole, rtol=1e-9)
    np.testing.assert_allclose(joint_shape(shapes[:1], [information[0]], prior), shapes[0], rtol=1e-9)
    sure = joint_shape([np.ones(4), np.zeros(4)], [1e6 * np.eye(4), np.eye(4)], prior)
    np.testing.assert_allclose(sure, 1, atol=1e-4)


def test_poses_that_are_moved_are_that_far_apart(stick: Body) -> None:
    state = random_state(stick, np.random.default_rng(1))
    assert apart_mm(stick, state, state) == 0
    moved = replace(state, translation=state.translation + np.array([0, 0.003, 0.004]))
    assert apart_mm(stick, state, moved) == pytest.approx(5)
