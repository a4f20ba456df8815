"""A shape that turns: nothing resists a limb that turns as a whole, and what lay beside its place slides into it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.types import Garment
from registration.config import SettleConfig
from registration.register import prepare_frame
from registration.settling import TurnedShape, settle
from registration.template import analyse_template


def twisted(points: np.ndarray, degrees: float) -> np.ndarray:
    """The tube, its upper half turned more and more about its axis."""
    points = np.asarray(points, float)
    angle = np.radians(degrees) * np.clip((points[:, 1] - 0.25) / 0.25, 0.0, 1.0)
    x, z = points[:, 0], points[:, 2]
    return np.column_stack([np.cos(angle) * x + np.sin(angle) * z, points[:, 1], np.cos(angle) * z - np.sin(angle) * x])


def mean_length(vectors: np.ndarray) -> float:
    return float(np.linalg.norm(vectors, axis=1).mean())


def test_what_is_turned_as_a_whole_is_not_bent(garment, config) -> None:
    analysis = analyse_template(garment, config)
    turn = Rotation.from_euler("xyz", [200, -50, 90], degrees=True).as_matrix()
    shape = TurnedShape.of(analysis)
    moved = analysis.rest @ turn.T + np.array([0.3, -1.0, 0.2])
    np.testing.assert_allclose(shape.turns(moved), np.broadcast_to(turn, (len(moved), 3, 3)), atol=1e-9)
    np.testing.assert_allclose(shape.bending(moved), 0.0, atol=1e-9)


def test_a_mirrored_neighbourhood_is_turned_and_not_mirrored(garment, config) -> None:
    analysis = analyse_template(garment, config)
    turns = TurnedShape.of(analysis).turns(analysis.rest * np.array([-1.0, 1.0, 1.0]))
    np.testing.assert_allclose(np.linalg.det(turns), 1.0, atol=1e-9)


def test_a_limb_that_turns_is_bent_at_its_joint_alone(garment, config) -> None:
    analysis = analyse_template(garment, config)
    upper = analysis.rest[:, 1] > 0.25
    turn = Rotation.from_euler("z", 50, degrees=True).as_matrix()
    moved = np.where(upper[:, None], analysis.rest @ turn.T, analysis.rest)
    bending = np.linalg.norm(TurnedShape.of(analysis).bending(moved), axis=1)
    away = np.abs(analysis.rest[:, 1] - 0.25) > 0.12
    np.testing.assert_allclose(bending[away], 0.0, atol=1e-9)
    assert bending[~away].max() > 0.01


@pytest.mark.parametrize("degrees", [10.0, -15.0])
def test_what_lies_on_the_scan_and_beside_its_place_slides_into_it(degrees: float, garment, scan_of, config) -> None:
    """The scan is the template itself. No borders are painted: the oval section alone tells the twist."""
    bare = analyse_template(Garment(garment.template, {}), config)
    scan = scan_of(lambda points: points)
    scan = replace(scan, boundary_points=scan.boundary_points[:0], boundary_loops=scan.boundary_loops[:0])
    start = twisted(bare.rest, degrees)
    found = settle(bare, prepare_frame(bare, scan, config), start, SettleConfig(steps=20), config)
    assert mean_length(found - bare.rest) < 0.3 * mean_length(start - bare.rest)
