"""Half planes of the body under cloth: the nearest skin of the part that a vertex belongs to, and of no other."""

from __future__ import annotations

import numpy as np

from capture4d.body.skinning import ShapedBody, with_pose
from capture4d.geometry.ray_casting import TriangleScene
from data_synth.drapes.collision import BodyParts, Wearing


def at_rest(person: ShapedBody):
    return with_pose(person, np.repeat(np.eye(3)[None], len(person.joints), axis=0), np.zeros(3))


def test_a_walk_ends_at_the_nearest_skin(person: ShapedBody):
    parts = BodyParts.create(person, np.ones((1, len(person.vertices)), bool))
    surface = parts.posed(at_rest(person))
    rng = np.random.default_rng(0)
    chosen = rng.integers(0, len(surface.vertices), 200)
    points = surface.vertices[chosen] + 0.02 * surface.normals[chosen] + rng.normal(scale=5e-3, size=(200, 3))
    contacts = np.arange(200, dtype=np.int32), np.zeros(200, np.int32)
    near = Wearing.begin(parts, contacts, points, surface)
    planes = Wearing(parts, contacts, near).look_up(points, surface)
    exact = TriangleScene((surface.vertices, parts.faces)).nearest(points).points
    here, best = (np.linalg.norm(points - feet, axis=1) for feet in (planes.points, exact))
    assert (here > best - 1e-6).all()
    # Rings of the mannequin are farther apart than its vertices around a limb: a neighbour's face may be nearer.
    assert np.percentile(here - best, 90) < 2e-3
    np.testing.assert_allclose(np.linalg.norm(planes.normals, axis=1), 1, atol=1e-9)


def test_cloth_of_a_sleeve_is_not_pulled_to_the_trunk(person: ShapedBody):
    left = person.vertices[:, 0] > 0.2
    parts = BodyParts.create(person, np.stack([~left, left]))
    surface = parts.posed(at_rest(person))
    beside = np.flatnonzero(parts.inside[0])[:20]
    points = surface.vertices[beside] + 0.002 * surface.normals[beside]  # on the trunk's side
    for part in (0, 1):
        contacts = np.arange(20, dtype=np.int32), np.full(20, part, np.int32)
        wearing = Wearing(parts, contacts, Wearing.begin(parts, contacts, points, surface))
        feet = wearing.look_up(points, surface).points
        on_left = feet[:, 0] > 0.2 - 1e-9
        behind = np.linalg.norm(feet - points, axis=1) > 0.5  # a plane that does not count is moved out of the way
        assert (on_left | behind).all() if part else not on_left.any()
