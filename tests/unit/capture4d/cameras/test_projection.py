"""Projection against OpenCV's, derivatives against finite differences, and the way back."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.simulated_views import calibration_rig
from capture4d.cameras.projection import (
    Lens,
    lens_jacobian,
    point_jacobian,
    project,
    project_world,
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
