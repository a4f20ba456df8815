import numpy as np
import pytest

from capture4d.captures.evaluation import (
    border_errors,
    correspondence_errors,
    curve_distances,
    drift_per_frame,
    drift_ratio,
    material_points,
    truth_distances,
)
from capture4d.geometry.ray_casting import closest_points, surface_distances
from tests.shapes import plane


def test_distance_to_a_plane_is_height_inside_and_distance_to_the_rim_outside():
    points = np.array([[0.3, 0.2, 0.6], [0.5, -0.1, 0.5], [1.3, 0.4, 0.5], [2.0, 0.0, 2.0]], np.float32)
    expected = [0.2, 0.1, 0.5, np.sqrt(2)]
    np.testing.assert_allclose(surface_distances(plane(), points), expected, rtol=1e-5)


def test_closest_points_are_the_barycentric_points_they_claim():
    rng = np.random.default_rng(0)
    mesh = plane(cells=3)
    points, faces, barycentric = closest_points(mesh, rng.standard_normal((50, 3)))
    np.testing.assert_allclose(material_points(mesh.vertices, mesh.faces, faces, barycentric), points, atol=1e-6)


def test_truth_distance_goes_both_ways_and_leaves_out_what_has_no_data():
    small, large = plane(1.0, height=0.1), plane(2.0)
    covered = np.zeros(len(small.vertices), bool)
    covered[:5] = True
    there, back = truth_distances(small, large, covered=covered)
    np.testing.assert_allclose(there, np.full(5, 0.1), rtol=1e-5)
    assert back.max() == pytest.approx(np.sqrt(2 + 0.01), rel=1e-5)


def test_correspondence_error_sees_sliding_that_the_surface_distance_does_not():
    mesh = plane()
    slid = mesh.vertices + np.array([0.05, 0, 0], np.float32)
    inside = slid[:, 0] < 1
    assert surface_distances(mesh, slid[inside]).max() < 1e-6
    np.testing.assert_allclose(correspondence_errors(slid, mesh.vertices), 0.05, rtol=1e-5)


def test_drift():
    assert drift_per_frame(3 + 0.25 * np.arange(100)) == pytest.approx(0.25)
    assert drift_per_frame(np.array([2.0])) == 0
    assert drift_ratio(np.full(100, 0.7)) == pytest.approx(1)
    assert drift_ratio(np.concatenate([np.full(50, 1.0), np.full(50, 1.5)])) == pytest.approx(1.5)
    assert drift_ratio(np.array([1.0, 2.0])) == pytest.approx(2)


def test_curve_distance_is_to_segments_and_closes_the_curve():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]], np.float32)
    points = np.array([[0.5, 0, -0.2], [-0.1, 0, 0.5], [0.5, 0, 0.5], [2, 0, 2]], np.float32)
    np.testing.assert_allclose(curve_distances(points, square), [0.2, 0.1, 0.5, np.sqrt(2)], rtol=1e-6)


def test_border_errors_compare_loops_of_one_name_both_ways():
    def circle(radius, count):
        angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
        return np.column_stack([radius * np.cos(angle), 0 * angle, radius * np.sin(angle)])

    found = {"neck": circle(1.0, 400), "cuff": circle(5, 10)}
    errors = border_errors(found, {"neck": circle(1.1, 300), "hem": circle(9, 9)})
    assert len(errors) == 700
    np.testing.assert_allclose(errors, 0.1, atol=1e-3)
    assert len(border_errors({}, {"neck": circle(1.0, 10)})) == 0
