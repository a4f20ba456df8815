"""The inner rim of a border's paint draws the border straight, and leaves how far out it lies to the template."""

from dataclasses import replace

import numpy as np
import pytest

from registration.border_strip import BorderStrip, PaintRim
from registration.config import SettleConfig
from registration.register import prepare_frame
from registration.settling import settle
from registration.solver import gauss_newton_step
from registration.template import analyse_template

HEIGHT, WIDTH = 0.5, 0.015


def ring(height: float | np.ndarray, count: int = 300) -> np.ndarray:
    """Points around the tube of the fixtures."""
    angle = 2 * np.pi * np.arange(count) / count
    radius = 0.15 + 0.03 * np.cos(2 * angle) + 0.015 * np.cos(3 * angle + 1)
    return np.column_stack([radius * np.sin(angle), np.broadcast_to(height, count), radius * np.cos(angle)])


@pytest.fixture
def analysis(garment, config):
    return analyse_template(garment, config)


def test_distances_from_the_border_are_those_at_rest(analysis) -> None:
    strip = BorderStrip.of(analysis, 0.03)
    points = np.einsum("pc,pca->pa", strip.shares, analysis.rest[strip.corners])
    np.testing.assert_allclose(strip.distance, np.minimum(points[:, 1], HEIGHT - points[:, 1]), atol=5e-4)
    _, inwards, distance = strip.under(ring(HEIGHT - WIDTH), 2.0 * analysis.rest - analysis.rest.mean(axis=0))
    assert not len(distance)  # twice as large it lies elsewhere
    _, inwards, distance = strip.under(ring(HEIGHT - WIDTH), analysis.rest)
    assert len(distance) == 300
    np.testing.assert_allclose(distance, WIDTH, atol=5e-4)
    np.testing.assert_allclose(inwards[:, 1], -1.0, atol=0.05)


def test_what_lies_too_far_out_is_drawn_in_and_the_mean_is_left(analysis) -> None:
    """The border is tilted: on the one side it hangs higher, and the rim of its paint lies lower on the cloth there."""
    rim = PaintRim.of(analysis, ring(HEIGHT - WIDTH), ring(HEIGHT))
    assert rim is not None
    high = 0.02 * analysis.rest[:, 0] * (analysis.rest[:, 1] > 0.4)
    vertices = analysis.rest + np.column_stack([0 * high, high, 0 * high])
    change, _ = gauss_newton_step(
        rim.terms(vertices, 1.0), None, len(vertices), damping=0.03, tolerance=1e-6, max_iterations=100
    )
    _, _, before = rim.strip.under(rim.points, vertices)
    _, _, after = rim.strip.under(rim.points, vertices + change[:, :, 0])
    assert before.std() > 0.0015
    assert after.std() < 0.3 * before.std()
    assert abs(np.median(after) - np.median(before)) < 0.0005


def test_paint_of_uneven_width_is_not_used(analysis) -> None:
    turn = np.sin(2 * np.pi * np.arange(300) / 300)
    assert PaintRim.of(analysis, ring(HEIGHT - WIDTH * (1.0 + 0.8 * turn)), ring(HEIGHT)) is None
    assert PaintRim.of(analysis, ring(HEIGHT - WIDTH * (1.0 + 0.1 * turn)), ring(HEIGHT)) is not None
    assert PaintRim.of(analysis, np.zeros((0, 3)), ring(HEIGHT)) is None


def test_a_border_that_the_scan_has_lost_settles_in_its_place(analysis, scan_of, config) -> None:
    """The scan ends 4 mm short of the upper border on one side; points on what is seen say that it ends there."""
    scan = scan_of(lambda points: points, around=160, along=200)
    lost = 0.004 * (np.sin(2 * np.pi * np.arange(300) / 300) > 0.0)
    short = scan.mesh.vertices[:, 1] > HEIGHT - 0.0045
    short &= scan.mesh.vertices[:, 0] > 0.0
    kept = scan.mesh.faces[~short[scan.mesh.faces].any(axis=1)]
    seen = ring(HEIGHT - lost).astype(np.float32)
    ends = replace(
        scan,
        mesh=replace(scan.mesh, faces=kept),
        boundary_points=seen,
        boundary_loops=np.full(len(seen), 1, np.int32),
    )
    frame = prepare_frame(analysis, ends, config)
    rim = PaintRim.of(analysis, ring(HEIGHT - WIDTH), ring(HEIGHT))
    start = analysis.rest + np.array([0.0, 0.003, 0.0])
    upper = analysis.rest[:, 1] == HEIGHT
    away = [np.ptp(settle(analysis, frame, start, SettleConfig(), config, rim=each)[upper, 1]) for each in (None, rim)]
    assert away[0] > 0.002
    assert away[1] < 0.5 * away[0]
