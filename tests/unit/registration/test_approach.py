"""From afar: a bent finger is followed, and half a tube; landmarks tell what shape does not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.types import Garment, Mesh
from registration.approach import approach, spread_evenly
from registration.config import ApproachConfig, MeshRegistrationConfig
from registration.correspondences import prepare_scan
from registration.landmarks import Landmarks
from registration.register_mesh import register_mesh
from registration.template import analyse_template


def finger(points: np.ndarray) -> np.ndarray:
    """The tube, slim and all but closed at its upper end."""
    points = np.asarray(points, float)
    narrow = 0.35 * np.sqrt(1.0 - 0.98 * np.clip((points[:, 1] - 0.2) / 0.3, 0.0, 1.0) ** 2)
    return np.column_stack([points[:, 0] * narrow, points[:, 1], points[:, 2] * narrow])


def bent(points: np.ndarray, degrees: float = 45.0) -> np.ndarray:
    """The finger's axis becomes an arc above its lower fifth; lengths along the axis stay."""
    points = finger(points)
    turn = np.radians(degrees) / 0.4
    angle, side = np.maximum(points[:, 1] - 0.1, 0.0) * turn, points[:, 0]
    x = (1.0 / turn) * (1.0 - np.cos(angle)) + side * np.cos(angle)
    y = np.minimum(points[:, 1], 0.1) + np.sin(angle) / turn - side * np.sin(angle)
    return np.column_stack([x, y, points[:, 2]])


def straight(garment: Garment) -> Garment:
    return replace(garment, template=garment.template.with_vertices(finger(garment.template.vertices).astype("f4")))


def mean_error(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(found - truth, axis=1).mean())


def test_a_bent_finger_is_followed(garment, scan_of, config) -> None:
    analysis = analyse_template(straight(garment), config)
    scan = scan_of(bent, around=80, along=60).mesh
    surface = prepare_scan(scan.vertices, scan.faces, smoothing_passes=0)
    truth = bent(garment.template.vertices)
    found = approach(analysis, surface, analysis.rest, ApproachConfig())
    assert mean_error(found, truth) < 0.4 * mean_error(analysis.rest, truth)


def test_signatures_bring_a_finger_round_that_nearness_does_not(garment, scan_of, tube, config) -> None:
    """Half a turn: the tip comes to lie beside the root. The signature here is the height on the straight finger."""
    analysis = analyse_template(straight(garment), config)
    scan = scan_of(lambda points: bent(points, 180.0), around=80, along=60).mesh
    surface = prepare_scan(scan.vertices, scan.faces, smoothing_passes=0)
    truth = bent(garment.template.vertices, 180.0)
    heights = garment.template.vertices[:, 1:2].astype(float), tube(80, 60).vertices[:, 1:2].astype(float)
    without = approach(analysis, surface, analysis.rest, ApproachConfig())
    told = approach(analysis, surface, analysis.rest, ApproachConfig(), signatures=heights)
    assert mean_error(told, truth) < 0.5 * mean_error(without, truth)


def test_what_is_not_scanned_follows_its_neighbours(garment, scan_of, config) -> None:
    analysis = analyse_template(garment, config)
    scan = scan_of(lambda points: points + np.array([0.05, 0.02, 0.0])).mesh
    upper = scan.faces[(scan.vertices[scan.faces, 1] > 0.27).all(axis=1)]
    surface = prepare_scan(scan.vertices, upper, smoothing_passes=0)
    found = approach(analysis, surface, analysis.rest + np.array([0.02, 0.02, 0.0]), ApproachConfig())
    lengths = np.linalg.norm(found[analysis.edges[:, 1]] - found[analysis.edges[:, 0]], axis=1)
    assert np.percentile(lengths / analysis.rest_lengths, 99) < 1.3
    truth = analysis.rest + np.array([0.05, 0.02, 0.0])
    lower = analysis.rest[:, 1] < 0.2
    assert mean_error(found[lower, ::2], truth[lower, ::2]) < 0.01  # what slides along the tube no shape tells


def test_two_meshes_far_apart_need_no_schedule(garment, scan_of) -> None:
    scan = scan_of(bent, around=80, along=60).mesh
    config = MeshRegistrationConfig(align="none", lengths="kept")
    result = register_mesh(straight(garment).template, scan, config=config)
    assert result.way != "near"
    assert result.quality.verdict != "failed"
    assert mean_error(result.vertices, bent(garment.template.vertices)) < 0.01


def test_what_lies_beyond_the_borders_is_told(garment, scan_of) -> None:
    longer = scan_of(lambda points: points * [1.0, 1.5, 1.0], around=80, along=60).mesh
    config = MeshRegistrationConfig(align="none", lengths="kept")
    quality = register_mesh(garment.template, longer, config=config).quality
    assert quality.verdict != "good"
    assert any("beyond the template's borders" in reason for reason in quality.reasons)


def test_landmarks_say_which_way_round(garment, scan_of) -> None:
    """Half a turn about its own axis, which an oval hardly shows."""
    half = Rotation.from_euler("y", 180, degrees=True).as_matrix()
    template, scan = garment.template, scan_of(lambda points: points @ half.T, around=80, along=50).mesh
    truth = template.vertices @ half.T
    config = MeshRegistrationConfig()
    marks = Landmarks(template.vertices[[0, 9, 300, 611]].astype(float), truth[[0, 9, 300, 611]].astype(float))
    told = register_mesh(template, scan, config=config, landmarks=marks)
    assert mean_error(told.vertices, truth) < 0.01
    untold = register_mesh(template, scan, config=replace(config, align="none"))
    assert mean_error(untold.vertices, truth) > 0.05


@pytest.mark.parametrize("count", [50, 400])
def test_points_are_spread_by_area_not_by_number(count: int) -> None:
    rng = np.random.default_rng(0)
    square = np.column_stack([rng.random((4000, 2)), np.zeros(4000)])
    crowded = np.concatenate([square, np.column_stack([0.5 * rng.random((20000, 2)), np.zeros(20000)])])
    chosen = crowded[spread_evenly(crowded, count)]
    assert len(chosen) == pytest.approx(count, rel=0.2)
    assert (chosen[:, :2] < 0.5).all(axis=1).mean() == pytest.approx(0.25, abs=0.07)


def test_another_thing_is_called_failed(garment, scan_of) -> None:
    half = Mesh(0.4 * garment.template.vertices, garment.template.faces)
    result = register_mesh(garment.template, half, config=MeshRegistrationConfig(lengths="kept"))
    assert result.quality.verdict == "failed"
    assert result.quality.reasons
