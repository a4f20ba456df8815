"""Projection against OpenCV's, derivatives against finite differences, and the way back."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.simulated_views import calibration_rig
from capture4d.cameras.coverage import camera_counts
from capture4d.cameras.projection import (
    Lens,
    lens_jacobian,
    point_jacobian,
    project,
    project_world,
    rays,
    rotation_angle_deg,
    rotation_from_vector,
    transform,
    triangulate,
    twist_jacobian,
    undistort,
)

K = np.array([[1400.0, 0, 700.3], [0, 1410.0, 512.8], [0, 0, 1]])
D = np.array([-0.12, 0.09, 4e-4, -6e-4, 0.01])
LENS = Lens(K, D)


@pytest.fixture(params=[0, 1])
def points(request: pytest.FixtureRequest) -> np.ndarray:
    rng = np.random.default_rng(request.param)
    return np.concatenate([rng.uniform(-0.9, 0.9, (60, 2)), rng.uniform(1.5, 3.0, (60, 1))], axis=1)


def test_it_is_opencvs_model(points: np.ndarray):
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)[0].reshape(-1, 2)
    np.testing.assert_allclose(project(points, LENS), expected, atol=1e-9)


def test_derivatives_are_those_of_finite_differences(points: np.ndarray):
    step = 1e-6

    def central(function) -> np.ndarray:
        return (function(step) - function(-step)) / (2 * step)

    for axis in range(3):
        shift = np.eye(3)[axis]
        numeric = central(lambda h, shift=shift: project(points + h * shift, LENS))
        np.testing.assert_allclose(point_jacobian(points, LENS)[:, :, axis], numeric, rtol=1e-6, atol=1e-5)
        turned = central(lambda h, shift=shift: points @ rotation_from_vector(h * shift).T)
        np.testing.assert_allclose(twist_jacobian(points)[:, :, axis], turned, atol=1e-8)
    np.testing.assert_array_equal(twist_jacobian(points)[:, :, 3:], np.tile(np.eye(3), (len(points), 1, 1)))
    places = [(0, 0), (1, 1), (0, 2), (1, 2)]
    for index in range(8):
        lens, bent = np.zeros((3, 3)), np.zeros(5)
        if index < 4:
            lens[places[index]] = 1
        else:
            bent[index - 4] = 1
        numeric = central(lambda h, lens=lens, bent=bent: project(points, Lens(K + h * lens, D + h * bent)))
        np.testing.assert_allclose(lens_jacobian(points, LENS)[:, :, index], numeric, rtol=1e-6, atol=1e-5)


def test_undistort_is_the_inverse(points: np.ndarray):
    expected = points[:, :2] / points[:, 2:]
    np.testing.assert_allclose(undistort(project(points, LENS), LENS), expected, atol=1e-12)


def test_what_several_cameras_see_is_triangulated_exactly():
    rng = np.random.default_rng(4)
    rig = calibration_rig(6, rng=rng)
    points = rng.uniform(-0.3, 0.3, (50, 3)) + np.array([0.0, 1.1, 0.0])
    pixels, seen = zip(*(project_world(rig, camera, points) for camera in range(6)), strict=True)
    seen = np.stack(seen)
    seen[2:, 0] = False
    seen[1:, 1] = False
    found = triangulate(rig, np.stack(pixels), seen)
    assert np.isnan(found[1]).all()
    np.testing.assert_allclose(np.delete(found, 1, axis=0), np.delete(points, 1, axis=0), atol=1e-11)


FISHEYE = Lens(K, np.array([0.05, -0.02, 0.006, -0.001, 0]), "fisheye")


@pytest.fixture(params=[0, 1])
def wide(request: pytest.FixtureRequest) -> np.ndarray:
    """Points up to 85 degrees off the axis, some on it."""
    rng = np.random.default_rng(request.param)
    angle, around = np.radians(rng.uniform(0, 85, 60)), rng.uniform(0, 2 * np.pi, 60)
    angle[:3] = 0, 1e-9, 1e-5
    flat = np.sin(angle)[:, None] * np.stack([np.cos(around), np.sin(around)], axis=1)
    return rng.uniform(0.5, 3, (60, 1)) * np.column_stack([flat, np.cos(angle)])


@pytest.mark.parametrize("distortion", [np.zeros(5), FISHEYE.distortion, np.array([-0.03, 0.01, -0.004, 5e-4, 0])])
def test_a_fisheye_is_opencvs(wide: np.ndarray, distortion: np.ndarray):
    expected = cv2.fisheye.projectPoints(wide[:, None], np.zeros(3), np.zeros(3), K, distortion[:4])[0].reshape(-1, 2)
    np.testing.assert_allclose(project(wide, Lens(K, distortion, "fisheye")), expected, atol=1e-8)


def test_a_fisheyes_derivatives_are_those_of_finite_differences(wide: np.ndarray):
    step = 1e-6
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        numeric = (project(wide + shift, FISHEYE) - project(wide - shift, FISHEYE)) / (2 * step)
        np.testing.assert_allclose(point_jacobian(wide, FISHEYE)[:, :, axis], numeric, rtol=1e-5, atol=1e-4)
    for index, (row, column) in enumerate([(0, 0), (1, 1), (0, 2), (1, 2)]):
        by = np.zeros((3, 3))
        by[row, column] = step
        ends = [project(wide, Lens(K + sign * by, FISHEYE.distortion, "fisheye")) for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(lens_jacobian(wide, FISHEYE)[:, :, index], numeric, rtol=1e-6, atol=1e-5)
    for index in range(4):
        by = step * np.eye(5)[index]
        ends = [project(wide, Lens(K, FISHEYE.distortion + sign * by, "fisheye")) for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(lens_jacobian(wide, FISHEYE)[:, :, 4 + index], numeric, rtol=1e-5, atol=1e-4)


def test_a_fisheyes_rays_are_the_way_back(wide: np.ndarray):
    looks = rays(project(wide, FISHEYE), FISHEYE)
    np.testing.assert_allclose(looks, wide / np.linalg.norm(wide, axis=1, keepdims=True), atol=1e-11)
    flat = undistort(project(wide, FISHEYE), FISHEYE)
    np.testing.assert_allclose(flat, wide[:, :2] / wide[:, 2:], atol=1e-8)


def test_a_fisheye_sees_sideways_but_not_beyond_its_circle():
    """d(t) = t (1 - t^2 / 6) grows up to t = sqrt(2), 81 degrees; the plain one sees behind itself."""
    narrow, plain = (Lens(K, np.array([k1, 0, 0, 0, 0]), "fisheye") for k1 in (-1 / 6, 0.0))
    np.testing.assert_allclose((narrow.widest, plain.widest), (np.sqrt(2), np.pi))
    beyond = K[:2, 2] + K[0, 0] * np.array([[1.0, 0], [0.5, 0]])
    assert np.isnan(rays(beyond, narrow)).any(axis=1).tolist() == [True, False]
    sideways = K[:2, 2] + K[0, 0] * np.array([[2.0, 0]])
    np.testing.assert_allclose(rays(sideways, plain), [[np.sin(2), 0, np.cos(2)]], atol=1e-12)
    assert np.isnan(undistort(sideways, plain)).all()
    rig = calibration_rig(1, rng=np.random.default_rng(0), image_size=(8000, 8000))
    rig = replace(rig, T_camera_world=np.eye(4)[None], lenses=("fisheye",), distortion=narrow.distortion[None])
    angles = np.radians([0, 60, 80, 82, 120])
    points = np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])
    assert project_world(rig, 0, points)[1].tolist() == [True, True, True, False, False]
    np.testing.assert_array_equal(camera_counts(rig, points), [1, 1, 1, 0, 0])


def test_mixed_rigs_triangulate_exactly():
    rng = np.random.default_rng(4)
    rig = calibration_rig(6, rng=rng)
    rig = replace(rig, lenses=("brown", "fisheye") * 3, distortion=rig.distortion * np.array([0.2, 0.1, 1, 1, 0]))
    points = rng.uniform(-0.3, 0.3, (50, 3)) + np.array([0.0, 1.1, 0.0])
    pixels, seen = zip(*(project_world(rig, camera, points) for camera in range(6)), strict=True)
    np.testing.assert_allclose(triangulate(rig, np.stack(pixels), np.stack(seen)), points, atol=1e-11)


def test_what_is_behind_or_outside_is_not_seen():
    rig = calibration_rig(4, rng=np.random.default_rng(0))
    rig = replace(rig, T_camera_world=np.tile(np.eye(4), (4, 1, 1)))
    _, seen = project_world(rig, 0, np.array([[0, 0, 2.0], [0, 0, -2.0], [5.0, 0, 2.0]]))
    assert seen.tolist() == [True, False, False]


@pytest.mark.parametrize("degrees", [1e-7, 0.02, 45.0, 179.0])
def test_angles_are_exact_even_if_tiny(degrees: float):
    rotation = rotation_from_vector(np.radians(degrees) * np.array([0.6, 0.0, 0.8]))
    np.testing.assert_allclose(rotation_angle_deg(rotation[None]), [degrees], rtol=1e-6)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


def test_transform_takes_b_to_a():
    T_a_b = np.eye(4)
    T_a_b[:3, :3], T_a_b[:3, 3] = rotation_from_vector(np.array([0, 0, np.pi / 2])), (1.0, 2.0, 3.0)
    np.testing.assert_allclose(transform(T_a_b, np.array([[1.0, 0, 0]])), [[1, 3, 3]], atol=1e-12)
