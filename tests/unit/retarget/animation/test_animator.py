"""Other bodies, other poses, and cloth that is not inside anybody."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import with_pose, with_shape
from capture4d.errors import InputError
from capture4d.geometry.intersection_removal import ClosedSurface, IntersectionRemoval
from capture4d.types import BlendshapeModel, Body, Garment
from retarget.animation.bodies import captured_person, retargeted_mean
from retarget.config import RemovalConfig
from retarget.regression.known_range import nearest_poses, pose_quaternions
from retarget.shapes.pose_normalisation import unpose_frame


def model_on(garment: Garment, body: Body, shape: tuple[float, float]) -> BlendshapeModel:
    worn = replace(garment, body_shape=np.array(shape, np.float32))
    count = len(garment.template.vertices)
    mean = (garment.template.vertices * (1 + 0.2 * shape[0], 1, 1 + 0.2 * shape[0])).astype(np.float32)
    return BlendshapeModel(
        worn, mean, np.zeros((0, count, 3), np.float32), np.zeros(0, np.float32), body.joint_names, 60.0
    )


def test_the_mean_follows_the_body_and_the_captured_shape_counts_once(garment, body) -> None:
    model = model_on(garment, body, (1.0, 0.0))
    captured = captured_person(model, body)
    same = retargeted_mean(model, captured, with_shape(body, np.array([1.0, 0.0])))
    np.testing.assert_allclose(same, model.mean, atol=1e-9)
    # 2 cm thicker at 10 cm radius: the cloth keeps its distance to the skin.
    thick = retargeted_mean(model, captured, with_shape(body, np.array([2.0, 0.0])))
    grown = np.linalg.norm(thick[:, [0, 2]], axis=1) - np.linalg.norm(model.mean[:, [0, 2]], axis=1)
    np.testing.assert_allclose(grown, 0.02, atol=5e-3)  # smoothed along a coarse tube
    printed = retargeted_mean(model, captured, with_shape(body, np.array([2.0, 0.0])), formula="printed")
    twice = np.linalg.norm(printed[:, [0, 2]], axis=1) - np.linalg.norm(model.mean[:, [0, 2]], axis=1)
    np.testing.assert_allclose(twice, 2 * grown, atol=5e-4)
    as_is = retargeted_mean(model, captured, with_shape(body, np.array([2.0, 0.0])), formula="captured")
    np.testing.assert_array_equal(as_is, model.mean)


def test_printed_and_corrected_agree_on_an_average_subject(garment, body) -> None:
    model = model_on(garment, body, (0.0, 0.0))
    person = with_shape(body, np.array([-1.0, 2.0]))
    captured = captured_person(model, body)
    formulas = [retargeted_mean(model, captured, person, formula=name) for name in ("corrected", "printed")]
    np.testing.assert_allclose(formulas[0], formulas[1], atol=1e-6)


def test_other_skeletons_and_meshes_are_refused(garment, body) -> None:
    model = model_on(garment, body, (0.0, 0.0))
    with pytest.raises(InputError, match="expected the 3 joints of the model"):
        captured_person(model, replace(body, joint_names=("a", "b", "c")))
    other = replace(body, template=replace(body.template, faces=body.template.faces[::-1].copy(), uv=None))
    with pytest.raises(InputError, match="the body the garment was learned on"):
        retargeted_mean(model, captured_person(model, body), with_shape(other, np.zeros(2)))


def surface(body: Body, thickness: float = 0.0) -> ClosedSurface:
    return ClosedSurface(with_shape(body, np.array([thickness, 0.0])).vertices, body.template.faces)


def test_heights_are_distances_with_the_sign_of_the_side(body) -> None:
    points = np.array([[0.13, 0.2, 0.0], [0.06, 0.2, 0.0], [0.0, 0.3, 0.08]])
    heights, normals = surface(body).heights(points)
    np.testing.assert_allclose(heights, [0.03, -0.04, -0.02], atol=1.5e-3)  # a polygon of 24 sides
    np.testing.assert_allclose(normals[0], [1, 0, 0], atol=0.02)


def test_nothing_moves_where_nothing_is_inside(garment, body) -> None:
    vertices = garment.template.vertices.astype(np.float64)
    removed = IntersectionRemoval(garment.template.faces, len(vertices), RemovalConfig())(vertices, surface(body))
    np.testing.assert_array_equal(removed.vertices, vertices)
    assert removed.before.inside_percent == removed.after.inside_percent == 0.0


def dented(garment: Garment) -> np.ndarray:
    """The tube with a dent of 6 cm in one side, 3 cm deep in the body at most."""
    vertices = garment.template.vertices.astype(np.float64)
    depth = 0.06 * np.exp(-((vertices - [0, 0.25, 0.13]) ** 2).sum(axis=1) / 0.05**2)
    vertices[:, 2] -= depth
    return vertices


def test_a_dent_is_taken_out_and_the_rest_stays(garment, body) -> None:
    vertices = dented(garment)
    removal = IntersectionRemoval(garment.template.faces, len(vertices), RemovalConfig())
    removed = removal(vertices, surface(body))
    assert removed.before.inside_percent > 0.5
    assert 15 < removed.before.depth_max_mm < 31
    assert removed.after.inside_percent == 0.0
    assert removed.rest_moved_mm < 1.0
    assert removed.moved_m[removed.was_inside].mean() > 0.005
    off = IntersectionRemoval(garment.template.faces, len(vertices), RemovalConfig(enabled=False))
    np.testing.assert_array_equal(off(vertices, surface(body)).vertices, vertices)


def test_one_round_is_the_least_squares_it_says(garment, body) -> None:
    vertices, faces = dented(garment), garment.template.faces
    config = RemovalConfig(faces=False, rounds=1, leave=400.0)
    heights, normals = surface(body).heights(vertices)
    inside = heights < 0
    wanted = np.where(inside[:, None], (0.002 - heights)[:, None] * normals, 0.0)
    removed = IntersectionRemoval(faces, len(vertices), config)(vertices, surface(body))
    count = len(vertices)
    laplacian = np.eye(count)
    for vertex in range(count):
        around = np.unique(faces[(faces == vertex).any(axis=1)])
        laplacian[vertex, around[around != vertex]] = -1 / (len(around) - 1)
    rows = np.concatenate([laplacian, np.diag(np.where(inside, 20.0, 1.0))])
    right = np.concatenate([np.zeros((count, 3)), np.where(inside[:, None], 20.0 * wanted, 0.0)])
    expected = np.linalg.lstsq(rows, right, rcond=None)[0]
    assert surface(body).heights(vertices + expected)[0].min() > 0, "nothing is left to be moved straight out"
    np.testing.assert_allclose(removed.vertices - vertices, expected, atol=1e-7)


def test_a_body_that_pokes_through_a_face_is_seen(garment, body) -> None:
    """Four long faces around a limb: corners outside, sides inside."""
    corners = np.array([[1, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]]) * 0.115
    up = np.array([0.0, 1.0, 0.0])
    vertices = np.concatenate([corners + 0.1 * up, corners + 0.14 * up])
    ring = np.arange(4)
    after = (ring + 1) % 4
    faces = np.concatenate([np.stack([after, ring, ring + 4], 1), np.stack([after, ring + 4, after + 4], 1)])
    faces = faces.astype(np.int32)
    assert surface(body).heights(vertices)[0].min() > 0
    middles = vertices[faces].mean(axis=1)
    assert surface(body).heights(middles)[0].max() < 0
    removed = IntersectionRemoval(faces, 8, RemovalConfig(rounds=12))(vertices, surface(body))
    assert surface(body).heights(removed.vertices[faces].mean(axis=1))[0].min() > -5e-4
    blind = IntersectionRemoval(faces, 8, RemovalConfig(faces=False))(vertices, surface(body))
    np.testing.assert_array_equal(blind.vertices, vertices)


def test_a_face_that_spans_a_crease_is_not_blown_up() -> None:
    """Two slabs, an arm and a trunk, with 10 mm between them: cloth reaches from one into the other's depth."""
    boxes = [trimesh.creation.box((0.2, 0.2, 0.2)).apply_translation((side * 0.105, 0, 0)) for side in (-1, 1)]
    both = trimesh.util.concatenate(boxes)
    crease = ClosedSurface(both.vertices.astype(np.float32), both.faces.astype(np.int32))
    # a corner in the gap, two above: the edges between pass 8 mm deep through the rims of the slabs
    vertices = np.array([[0.0, 0.09, 0.0], [0.012, 0.101, 0.004], [0.012, 0.101, -0.004]])
    faces = np.array([[0, 1, 2]], np.int32)
    assert crease.heights(vertices)[0].min() > 0
    assert -0.004 < crease.heights(vertices[faces].mean(axis=1))[0][0] < -0.0015
    removed = IntersectionRemoval(faces, 3, RemovalConfig())(vertices, crease)
    np.testing.assert_array_equal(removed.vertices, vertices)


def test_distances_of_poses_are_angles(motion) -> None:
    poses = motion(8, 0)
    known = pose_quaternions(poses.rotations, (1, 2))
    distance, nearest = nearest_poses(known, known)
    np.testing.assert_array_equal(nearest, np.arange(8))
    np.testing.assert_allclose(distance, 0, atol=0.05)
    turned = poses.rotations.copy()
    turned[:, 1] = turned[:, 1] @ Rotation.from_euler("x", 30, degrees=True).as_matrix().astype(np.float32)
    away = nearest_poses(pose_quaternions(turned, (1, 2)), known[3:4])[0]
    assert away[3] == pytest.approx(30 / np.sqrt(2), abs=0.05)


def test_unposing_gives_back_the_rest_pose_and_singular_vertices_count_for_nothing(garment, body) -> None:
    rotations = np.tile(np.eye(3), (3, 1, 1))
    rotations[1] = Rotation.from_euler("y", 180, degrees=True).as_matrix()
    transforms = with_pose(with_shape(body, np.zeros(2)), rotations, np.zeros(3)).transforms
    weights = garment.skin_weights.copy()
    weights[:] = (0, 1, 0)
    weights[5] = (0.5, 0.5, 0)
    seen = np.arange(len(weights)) % 2 == 1
    rest, worth = unpose_frame(garment.template.vertices, seen, weights, transforms, unseen_weight=0.1)
    assert worth[5] == 0.0
    np.testing.assert_array_equal(worth[7:], np.where(seen, 1.0, 0.1).astype(np.float32)[7:])
    again = rest[6].astype(float) @ transforms[1, :3, :3].T + transforms[1, :3, 3]
    np.testing.assert_allclose(again, garment.template.vertices[6], atol=1e-6)
