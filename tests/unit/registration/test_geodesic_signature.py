"""Signatures know a place on a surface in every pose, and nothing of where it lies."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from registration.geodesic_signature import geodesic_signatures, likeness
from tests.shapes import tube_faces

AROUND, ALONG, LENGTH, RADIUS = 36, 90, 1.0, 0.05


def limb(bend_deg: float) -> np.ndarray:
    """A tube whose axis is an arc of so many degrees; lengths along the axis stay."""
    angle, at = np.meshgrid(2 * np.pi * np.arange(AROUND) / AROUND, np.linspace(0, LENGTH, ALONG))
    across, up = RADIUS * np.cos(angle).ravel(), RADIUS * np.sin(angle).ravel()
    turn = np.radians(max(bend_deg, 1e-3)) / LENGTH
    bent = turn * at.ravel()
    x, y = (1 - np.cos(bent)) / turn + across * np.cos(bent), np.sin(bent) / turn - across * np.sin(bent)
    return np.column_stack([x, y, up])


@pytest.fixture
def faces() -> np.ndarray:
    return tube_faces(AROUND, ALONG)


def test_of_a_thin_limb_they_are_quantiles_of_lengths(faces) -> None:
    """Of a tube all distances are known: those from its end are spread evenly over its length, from its middle over
    half of it."""
    found = geodesic_signatures(limb(0.0), faces)
    ends, middle = found[:AROUND].mean(axis=0), found[AROUND * (ALONG // 2) :][:AROUND].mean(axis=0)
    shares = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
    np.testing.assert_allclose(ends, shares * LENGTH, atol=0.12)
    np.testing.assert_allclose(middle, shares * LENGTH / 2, atol=0.12)


def test_bending_and_turning_change_them_little(faces) -> None:
    straight, bent = limb(0.0), limb(150.0)
    turned = bent @ Rotation.from_euler("xyz", [30, 50, 70], degrees=True).as_matrix().T + np.array([3.0, -1.0, 0.5])
    own, other = geodesic_signatures(straight, faces), geodesic_signatures(turned, faces)
    found = likeness(own, straight, other, turned)
    assert found.gap < 0.05
    assert 0.95 < found.size < 1.05
    assert np.abs(own - found.levelled).mean() < 0.03
    assert np.ptp(own[:, 2]) > 0.2  # what they tell is many times that


def test_a_part_is_told_from_the_whole(faces) -> None:
    whole, part = limb(0.0), limb(0.0)[: AROUND * (ALONG // 2)]
    half = faces[(faces < len(part)).all(axis=1)]
    found = likeness(geodesic_signatures(whole, faces), whole, geodesic_signatures(part, half), part)
    assert found.size < 0.7


def test_between_pieces_ways_run_through_the_air(faces) -> None:
    both = np.concatenate([limb(0.0), limb(0.0) + np.array([0.5, 0.0, 0.0])])
    found = geodesic_signatures(both, np.concatenate([faces, faces + AROUND * ALONG]))
    assert np.isfinite(found).all()
    assert found[:, 4].min() > 0.4  # a tenth of the surface lies beyond the gap
