"""Two legs on a trunk, close together: cloth leaves the one that carries it."""

import numpy as np
import pytest
import trimesh

from capture4d.body.limbs import LimbSurfaces, WornBody, limbs_of_joints
from capture4d.body.skinning import ShapedBody, with_shape
from capture4d.types import Body, Mesh

NAMES = ("root", "thigh.L", "shin.L", "thigh.R", "shin.R", "spine")
JOINTS = np.array([[0, 0, 0], [0.1, -0.1, 0], [0.1, -0.5, 0], [-0.1, -0.1, 0], [-0.1, -0.5, 0], [0.005, 0.2, 0]])


def limb(centre: tuple[float, float, float], size: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(4).apply_scale(size).apply_translation(centre)


@pytest.fixture(scope="module")
def body() -> Body:
    """Three ellipsoids; each is its own limb."""
    parts = [limb((0, 0.2, 0), (0.2, 0.25, 0.12)), limb((0.1, -0.5, 0), (0.08, 0.4, 0.08)),
             limb((-0.1, -0.5, 0), (0.08, 0.4, 0.08))]  # fmt: skip
    mesh = trimesh.util.concatenate(parts)
    weights = np.zeros((len(mesh.vertices), 6), np.float32)
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    for joint, first, last in ((0, starts[0], starts[1]), (1, starts[1], starts[2]), (3, starts[2], starts[3])):
        weights[first:last, joint] = 1
    return Body(
        Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)),
        np.zeros((1, len(mesh.vertices), 3), np.float32), JOINTS.astype(np.float32), np.zeros((1, 6, 3), np.float32),
        NAMES, np.array([-1, 0, 1, 0, 3, 0], np.int32), weights,
    )  # fmt: skip


@pytest.fixture(scope="module")
def person(body) -> ShapedBody:
    return with_shape(body, np.zeros(1))


def worn(person: ShapedBody, points: np.ndarray, joint: int) -> WornBody:
    weights = np.zeros((len(points), 6), np.float32)
    weights[:, joint] = 1
    return WornBody(person, points, weights)


def test_limbs_hang_from_what_lies_in_the_middle(body) -> None:
    np.testing.assert_array_equal(limbs_of_joints(body), [0, 1, 1, 2, 2, 0])


def around(centre: tuple[float, float, float], radii: tuple[float, float, float], count: int, seed: int) -> np.ndarray:
    directions = np.random.default_rng(seed).standard_normal((count, 3))
    return np.array(centre) + np.array(radii) * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_walking_finds_the_nearest_point_of_the_limb(body, person) -> None:
    """Against every face of the limb that carries the points, from any other vertex of it."""
    points = around((0.1, -0.5, 0), (0.1, 0.42, 0.1), 60, 0)
    surfaces = worn(person, points, 1).posed(person.vertices)
    left = trimesh.Trimesh(person.vertices, body.template.faces[body.skin_weights[body.template.faces[:, 0], 1] > 0],
                           process=False)  # fmt: skip
    nearest, distance, _ = trimesh.proximity.closest_point_naive(left, points)
    found = surfaces.contacts(points)
    np.testing.assert_allclose(np.abs(found.heights), distance, atol=1e-6)
    np.testing.assert_allclose(found.feet, nearest, atol=1e-5)
    shuffled = points[::-1]
    again = surfaces.contacts(shuffled)
    np.testing.assert_allclose(again.heights[::-1], found.heights, atol=1e-6)
    np.testing.assert_array_equal(surfaces.contacts(points).heights, found.heights)


def test_heights_have_the_sign_of_the_side_and_belong_to_the_carrier(person) -> None:
    points = np.array([[0.1, -0.5, 0.1], [0.1, -0.5, 0.05], [-0.1, -0.5, 0.05]])
    found = worn(person, points, 1).posed(person.vertices).contacts(points)
    np.testing.assert_allclose(found.heights[:2], [0.02, -0.03], atol=1e-3)
    np.testing.assert_allclose(found.normals[:2], [[0, 0, 1]] * 2, atol=0.03)
    assert found.heights[2] > 0.1, "inside the other leg, far outside its own"


def test_the_other_leg_is_met_from_ones_own(person) -> None:
    """Legs 4 cm apart at their widest. A point beyond the gap is inside the other leg, however deep."""
    points = np.array([[-0.015, -0.5, 0.0], [-0.03, -0.5, 0.0], [-0.15, -0.5, 0.0], [0.21, -0.5, 0.0]])
    found = worn(person, points, 1).posed(person.vertices).contacts(points)
    np.testing.assert_allclose(found.room[:3], 0.04, atol=1e-3)
    assert np.isinf(found.room[3])
    np.testing.assert_allclose(found.depths, [0, 0.01, 0.13, 0], atol=1.5e-3)
    assert not found.overlapping.any()


def test_legs_that_overlap_are_told(body, person) -> None:
    """The left leg moved 6 cm into the right one."""
    moved = person.vertices - 0.06 * body.skin_weights[:, [1]] * (1, 0, 0)
    points = np.array([[-0.045, -0.5, 0.0], [0.04, -0.5, 0.085]])
    surfaces: LimbSurfaces = worn(person, points + np.array([0.06, 0, 0]), 1).posed(moved)
    found = surfaces.contacts(points)
    np.testing.assert_array_equal(found.overlapping, [True, False])
    np.testing.assert_array_equal(found.depths, 0)


def test_a_vertex_that_both_carry_has_no_other(person) -> None:
    points = np.array([[0.0, -0.5, 0.0]])
    weights = np.array([[0, 0.5, 0, 0.5, 0, 0]], np.float32)
    found = WornBody(person, points, weights).posed(person.vertices).contacts(points)
    assert np.isinf(found.room).all()
    assert not found.overlapping.any()


def test_other_points_are_measured_from_the_vertex_beside_them(person) -> None:
    points = np.array([[0.1, -0.5, 0.1], [0.1, -0.5, -0.1]])
    surfaces = worn(person, points, 1).posed(person.vertices)
    surfaces.contacts(points)
    numbers = np.array([4, 9])
    heights = surfaces.heights(np.array([[0.1, -0.5, 0.07], [0.1, -0.5, -0.09]]), np.array([0, 1], np.int32), numbers)
    np.testing.assert_allclose(heights, [-0.01, 0.01], atol=1e-3)
