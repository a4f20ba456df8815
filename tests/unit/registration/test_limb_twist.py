"""Arms that turned about themselves: hands tell, and round sleeves say nothing."""

from dataclasses import replace

import numpy as np
import pytest

from capture4d.types import Garment, Mesh
from registration.correspondences import prepare_scan
from registration.limb_twist import untwisted
from registration.template import TemplateAnalysis, analyse_template
from tests.shapes import tube_faces

LENGTH = 1.0


def arms(around: int, along: int, *, handed: bool) -> Mesh:
    """A bar along X, closed but for a pinhole at both ends, with hands there: flat, bent and with a thumb each."""
    x = np.linspace(-LENGTH / 2, LENGTH / 2, along)
    angle = 2 * np.pi * np.arange(around) / around
    end = np.clip((np.abs(x) - 0.36) / 0.06, 0.0, 1.0) * handed
    radius = 0.05 * np.sqrt(np.maximum(1.0 - (np.abs(x) / (LENGTH / 2)) ** 12, 1e-3))
    y = radius[:, None] * (1.0 + 0.5 * end[:, None]) * np.cos(angle)
    z = radius[:, None] * (1.0 - 0.6 * end[:, None]) * np.sin(angle)
    thumb = np.exp(-((angle - 0.3) ** 2) / 0.1) * np.exp(-((np.abs(x)[:, None] - 0.42) ** 2) / 0.0006)
    y, z = y + 0.05 * handed * thumb, z + end[:, None] * 0.02 * np.cos(angle) ** 2
    ring = np.stack([np.broadcast_to(x[:, None], y.shape), y, z], axis=2)
    return Mesh(ring.reshape(-1, 3).astype(np.float32), tube_faces(around, along))


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    """The right end turned about X, as by a wrist."""
    points = np.asarray(points, float)
    angle = np.radians(degrees) * np.clip((points[:, 0] - 0.24) / 0.1, 0.0, 1.0)
    y, z = points[:, 1], points[:, 2]
    return np.column_stack([points[:, 0], np.cos(angle) * y - np.sin(angle) * z, np.sin(angle) * y + np.cos(angle) * z])


def analysis_of(mesh: Mesh, config) -> TemplateAnalysis:
    return analyse_template(Garment(mesh, {}), config)


def mean_error(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(found - truth, axis=1).mean())


@pytest.mark.parametrize("degrees", [90.0, -120.0])
def test_an_arm_whose_hand_lies_turned_is_turned_back(degrees: float, config) -> None:
    analysis = analysis_of(arms(24, 60, handed=True), config)
    scan = arms(40, 140, handed=True)
    surface = prepare_scan(scan.vertices, scan.faces, smoothing_passes=0)
    start = turned(analysis.rest, degrees)
    found = untwisted(analysis, surface, start)
    assert found is not None
    hand, left = analysis.rest[:, 0] > 0.42, analysis.rest[:, 0] < -0.2
    assert mean_error(found[hand], analysis.rest[hand]) < 0.4 * mean_error(start[hand], analysis.rest[hand])
    np.testing.assert_array_equal(found[left], start[left])


def test_hands_in_their_places_stay(config) -> None:
    analysis = analysis_of(arms(24, 60, handed=True), config)
    scan = arms(40, 140, handed=True)
    surface = prepare_scan(scan.vertices, scan.faces, smoothing_passes=0)
    assert untwisted(analysis, surface, analysis.rest) is None


def test_what_is_round_fits_whichever_way_it_is_turned_and_stays(config) -> None:
    analysis = analysis_of(arms(24, 60, handed=False), config)
    scan = arms(40, 140, handed=False)
    surface = prepare_scan(scan.vertices, scan.faces, smoothing_passes=0)
    assert untwisted(analysis, surface, turned(analysis.rest, 90.0)) is None


def test_a_limb_that_is_not_scanned_stays(config) -> None:
    analysis = analysis_of(arms(24, 60, handed=True), config)
    scan = arms(40, 140, handed=True)
    seen = replace(scan, faces=scan.faces[(scan.vertices[scan.faces, 0] < 0.0).all(axis=1)])
    surface = prepare_scan(seen.vertices, seen.faces, smoothing_passes=0)
    assert untwisted(analysis, surface, turned(analysis.rest, 90.0)) is None
