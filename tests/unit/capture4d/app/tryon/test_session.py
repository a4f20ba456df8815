"""What is tried on: quickly near what is exact, at rest as `animate` writes it, and kept as an animation."""

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch

from capture4d.app.tryon.garments import Fitting, TriedGarment, open_garment
from capture4d.app.tryon.push import LivePush, laid_on_skin
from capture4d.app.tryon.session import Session, still
from capture4d.app.tryon.trial import random_motion, try_out
from capture4d.body.limbs import WornBody
from capture4d.body.skinning import pose_frame, with_pose
from capture4d.captures.work_folder import load_registration
from capture4d.errors import InputError
from capture4d.files.records import save_poses
from capture4d.geometry.intersection_removal import Contacts, Penetration
from retarget.animation.garment_model import load_garment_model
from retarget.regression.controls import control_vectors
from tests.unit.retarget.conftest import some_motion


@pytest.mark.parametrize("model", ["tried", "styled"])
def test_at_rest_nothing_is_inside_and_moving_little(model: str, request: pytest.FixtureRequest):
    tried: TriedGarment = request.getfixturevalue(model)
    found = try_out(tried, 1.5, np.random.default_rng(2), rest_every_s=0.5)
    assert found.frames >= 45
    assert found.resting == 3
    assert found.resting_inside_percent == 0
    assert found.moving_depth_mm < 2


def test_a_push_takes_out_what_is_in(tried: TriedGarment):
    """From as deep as the cloth can be: all of it on the axis side of the skin."""
    fitting = Fitting(tried, tried.first_shape, {})
    person, weights, faces = fitting.worn.person, tried.garment.skin_weights, tried.garment.template.faces
    assert weights is not None
    worn = WornBody(person, fitting.worn.at_rest, weights)
    rotations = np.tile(np.eye(3, dtype=np.float32), (3, 1, 1))
    skin = with_pose(person, rotations, np.zeros(3)).vertices()
    deep = fitting.worn.at_rest * (0.6, 1, 0.6)
    before = Penetration.of(worn.posed(skin).contacts(deep))
    pushed = LivePush(worn, faces, len(deep), 0.003)(deep, skin)
    after = Penetration.of(worn.posed(skin).contacts(pushed))
    assert before.depth_max_mm > 15
    assert after.depth_max_mm < 2
    untouched = fitting.worn.at_rest * (1.2, 1, 1.2)
    np.testing.assert_allclose(LivePush(worn, faces, len(deep), 0.003)(untouched, skin), untouched, atol=1e-9)


class _Crease:
    """Flesh on both sides of a gap of 1 mm about x = 0."""

    def heights(self, points: np.ndarray, vertices: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        return 0.0005 - np.abs(points[:, 0])

    def contacts(self, points: np.ndarray) -> Contacts:
        side = np.where(points[:, 0] < 0, -1.0, 1.0)
        feet, normals = points * (0, 1, 1), np.zeros_like(points)
        feet[:, 0], normals[:, 0] = 0.0005 * side, -side
        free = np.full(len(points), np.inf), np.zeros(len(points), bool)
        return Contacts(0.0005 - np.abs(points[:, 0]), normals, feet, normals, *free)


class _Creased(WornBody):
    def __init__(self) -> None:
        """There is no person."""

    def posed(self, vertices: np.ndarray) -> Any:
        return _Crease()


def test_cloth_in_a_crease_narrower_than_the_margin_is_laid_on_the_skin():
    """Pushed out by 3 mm from one side it would be inside the other, to and fro."""
    body, faces = _Crease(), np.array([[0, 1, 2]], np.int32)
    inside = np.array([[-0.005, 0, 0], [-0.0051, 0.01, 0], [-0.0052, 0, 0.01]])
    pushed = LivePush(_Creased(), faces, 3, 0.003)(inside, np.zeros((0, 3)))
    assert body.contacts(pushed).depths.max() == 0
    mixed = np.array([[0.0001, 0, 0], [0.004, 0.01, 0]])
    laid = laid_on_skin(mixed, body, 1e-4)
    np.testing.assert_array_equal(laid[0], mixed[0])
    np.testing.assert_allclose(laid[1], (0.0002, 0.01, 0), atol=1e-9)


def test_at_rest_what_the_exact_removal_leaves_inside_is_laid_on_the_skin(tried: TriedGarment):
    fitting, weights = Fitting(tried, tried.first_shape, {}), tried.garment.skin_weights
    assert weights is not None
    poses = still(tried, Session(tried).sliders.rotations({}), np.zeros(3), fitting.worn.remembers + 1)
    exact, skin = fitting.resting(poses)
    found = WornBody(fitting.worn.person, fitting.worn.at_rest, weights).posed(skin).contacts(exact)
    left = exact.astype(np.float32)
    left[5] = found.feet[5] - 0.004 * found.normals[5]
    worn: Any = fitting.worn
    worn.resting = lambda _: left
    assert fitting.inside(left, skin).depth_max_mm > 1
    laid, _ = fitting.resting(poses)
    assert fitting.inside(laid, skin).inside_percent == 0
    others = np.arange(len(left)) != 5
    np.testing.assert_array_equal(laid[others], left[others])


def test_a_frame_takes_one_thread_of_torch_and_gives_the_others_back(tried: TriedGarment):
    fitting, rotations = Fitting(tried, tried.first_shape, {}), Session(tried).sliders.rotations({})
    worn, seen, before = cast("Any", fitting.worn), [], torch.get_num_threads()
    unposed = worn.unposed
    worn.unposed = lambda *pose: (seen.append(torch.get_num_threads()), unposed(*pose))[1]
    torch.set_num_threads(3)
    try:
        fitting.moving(rotations, np.zeros(3))
        after = torch.get_num_threads()
    finally:
        torch.set_num_threads(before)
    assert seen == [1]
    assert after == 3


def test_a_live_frame_shows_the_body_as_it_is(tried: TriedGarment):
    fitting = Fitting(tried, tried.first_shape, {})
    rotations = Session(tried).sliders.rotations({"top x": 20.0})
    _, skin = fitting.moving(rotations, np.array([0.1, 0.2, 0.3]))
    wanted = with_pose(fitting.worn.person, rotations, np.array([0.1, 0.2, 0.3])).vertices()
    np.testing.assert_allclose(skin, wanted, atol=1e-9)


def test_a_clip_is_what_animate_writes(tried: TriedGarment, tmp_path: Path):
    poses = some_motion(12, 9)
    save_poses(tmp_path / "clip.npz", poses)
    session = Session(tried)
    assert session.play(tmp_path / "clip.npz") == 12
    result = session.export(tmp_path / "out")
    assert result.frames == 12
    written = load_registration(tmp_path / "out" / "registration").vertices
    for row in (0, 7, 11):
        np.testing.assert_allclose(session.resting(row).vertices, written[row], atol=2e-5)


def test_pose_by_pose_the_garment_is_that_of_the_whole_motion(learned: Path, motion):
    known, poses = load_garment_model(learned), motion(21, 4)
    worn = open_garment(learned).worn(known.person().shape.tolist(), {})
    poses = replace(poses, shape=known.person().shape.astype(np.float32))
    coefficients = known.best.predict(control_vectors(known.best.layout, poses))
    for _ in range(2):  # it begins anew
        worn.begin()
        for row in range(21):
            found = worn.unposed(pose_frame(worn.person, poses, row), poses.translations[row])
            wanted = known.model.mean + np.einsum("k,kvx->vx", coefficients[row], known.model.basis)
            np.testing.assert_allclose(found, wanted, atol=2e-5)


def test_the_pose_of_the_sliders_is_written(tried: TriedGarment, tmp_path: Path):
    session = Session(tried)
    session.pose({"middle x": 25.0})
    result = session.export(tmp_path / "001")
    assert result.frames == 60
    written = load_registration(tmp_path / "001" / "registration").vertices
    np.testing.assert_allclose(session.resting().vertices, written[-1], atol=2e-5)
    with pytest.raises(InputError, match="expected a new folder"):
        session.export(tmp_path / "001")


def test_other_people_and_styles(styled: TriedGarment):
    session = Session(styled)
    session.pose({"knee z": 20.0})
    middle = session.resting().vertices
    session.dress([0.9], {"length": 0.75})
    other = session.resting()
    assert np.abs(other.vertices - middle).max() > 0.005
    assert other.inside is not None
    assert other.inside.inside_percent == 0
    with pytest.raises(InputError, match=r"style length: expected 0\.4 to 0\.8"):
        session.dress([0.9], {"length": 3.0})
    assert session.style == {"length": 0.75}, "as it was"


def test_styles_of_a_garment_without_are_one_line(tried: TriedGarment):
    with pytest.raises(InputError, match="style: expected a garment with styles"):
        Session(tried).dress(tried.first_shape, {"length": 0.5})


def test_a_clip_of_another_skeleton_is_one_line(styled: TriedGarment, tmp_path: Path):
    save_poses(tmp_path / "clip.npz", some_motion(4, 1))
    with pytest.raises(InputError, match=r"clip\.npz"):
        Session(styled).play(tmp_path / "clip.npz")


def test_random_sliders_stay_in_their_ranges_and_do_not_jump(tried: TriedGarment):
    session = Session(tried)
    frames = [*random_motion(session.sliders, 400, 30.0, np.random.default_rng(5))]
    for slider in session.sliders.sliders:
        values = np.array([frame[slider.name] for frame in frames])
        assert values.min() >= slider.low
        assert values.max() <= slider.high
        # the steepest of a smooth step that takes half a second: one and a half times the mean
        assert np.abs(np.diff(values)).max() <= 1.5 * (slider.high - slider.low) / (0.5 * 30) + 1e-9
        assert np.ptp(values) > 0.3 * (slider.high - slider.low)


def test_a_pose_that_rests_is_that_of_a_motion_that_stands_still(tried: TriedGarment):
    """However long it has rested."""
    fitting = Fitting(tried, tried.first_shape, {})
    session = Session(tried)
    rotations = session.sliders.rotations({"top x": 20.0})
    nowhere = np.zeros(3)
    first, _ = fitting.resting(still(tried, rotations, nowhere, fitting.worn.remembers + 1))
    longer, _ = fitting.resting(still(tried, rotations, nowhere, fitting.worn.remembers + 40))
    np.testing.assert_allclose(first, longer, atol=2e-5)
