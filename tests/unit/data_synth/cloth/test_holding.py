"""What a hold pulls at, and what it leaves free."""

from __future__ import annotations

import numpy as np

from capture4d.body.skinning import ShapedBody, with_pose
from data_synth.cloth.holding import Hold


def test_a_hold_pulls_a_sleeve_across_its_arm_and_not_along(person: ShapedBody) -> None:
    body = with_pose(person, np.repeat(np.eye(3)[None], len(person.body.joint_names), axis=0), np.zeros(3))
    names, centres = person.body.joint_names, body.joint_centres()
    arm = centres[names.index("lowerarm01.L")] - centres[names.index("upperarm01.L")]
    arm /= np.linalg.norm(arm)
    across = np.cross(arm, [0.0, 0.0, 1.0])
    weights = np.zeros((3, len(names)))
    weights[:, names.index("upperarm01.L")] = 1
    shares = np.array([[1.0, 0, 0], [0.25, 0, 0], [0, 0, 0]])  # a sleeve, a cap, the trunk
    hold = Hold(np.zeros((3, 3)), weights, np.full((3, 1), 2.0), shares)
    places, slides = hold.places(body), hold.slides(body)
    along = hold.forces(places, slides, places - 0.03 * arm)
    np.testing.assert_allclose(along, 2 * 0.03 * np.outer([0, 0.75, 1], arm), atol=1e-12)
    np.testing.assert_allclose(hold.forces(places, slides, places - 0.03 * across), 0.06 * np.tile(across, (3, 1)))


def test_a_hold_without_slides_is_a_spring(person: ShapedBody) -> None:
    rng = np.random.default_rng(0)
    body = with_pose(person, np.repeat(np.eye(3)[None], len(person.body.joint_names), axis=0), np.zeros(3))
    weights = np.eye(len(person.body.joint_names))[:4]
    hold = Hold(rng.normal(size=(4, 3)), weights, np.full((4, 1), 3.0), np.zeros((4, 3)))
    points = rng.normal(size=(4, 3))
    places = hold.places(body)
    np.testing.assert_array_equal(hold.forces(places, hold.slides(body), points), 3.0 * (places - points))


def test_no_spring_drives_cloth_away_where_arm_and_trunk_meet(person: ShapedBody) -> None:
    rng = np.random.default_rng(0)
    body = with_pose(person, np.repeat(np.eye(3)[None], len(person.body.joint_names), axis=0), np.zeros(3))
    weights = np.tile(np.eye(len(person.body.joint_names))[person.body.joint_names.index("clavicle.L")], (50, 1))
    hold = Hold(np.zeros((50, 3)), weights, np.ones((50, 1)), rng.dirichlet([1, 1, 1], 50))
    places, away = hold.places(body), rng.normal(size=(50, 3))
    pulls = hold.forces(places, hold.slides(body), places - away)
    assert (pulls * away).sum(axis=1).min() >= 0
