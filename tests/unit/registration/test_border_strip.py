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
    under = strip.under(ring(HEIGHT - WIDTH), 2.0 * analysis.rest - analysis.rest.mean(axis=0))
    assert not len(under.distance)  # twice as large it lies elsewhere
    under = strip.under(ring(HEIGHT - WIDTH), analysis.rest)
    assert under.found.all()
    np.testing.assert_allclose(under.distance, WIDTH, atol=5e-4)
    np.testing.assert_allclose(under.inwards[:, 1], -1.0, atol=0.05)
    assert (strip.loops[under.nearest] == analysis.border.names.index("neck")).all()


@pytest.fixture
def frame(analysis, scan_of, config):
    """The template's own shape, with points on both borders that do not tell which is which."""
    scan = scan_of(lambda points: points)
    return prepare_frame(
        analysis, replace(scan, boundary_loops=np.full(len(scan.boundary_loops), -1, np.int32)), config
    )


def test_what_lies_too_far_out_is_drawn_in_and_the_mean_is_left(analysis, frame) -> None:
    """The border is tilted: on the one side it hangs higher, and the rim of its paint lies lower on the cloth there."""
    rim = PaintRim.of(analysis, ring(HEIGHT - WIDTH), ring(HEIGHT))
    assert rim is not None
    high = 0.02 * analysis.rest[:, 0] * (analysis.rest[:, 1] > 0.4)
    vertices = analysis.rest + np.column_stack([0 * high, high, 0 * high])
    change, _ = gauss_newton_step(
        rim.terms(frame, vertices, 1.0)[0], None, len(vertices), damping=0.03, tolerance=1e-6, max_iterations=100
    )
    before = rim.strip.under(rim.points, vertices).distance
    after = rim.strip.under(rim.points, vertices + change[:, :, 0]).distance
    assert before.std() > 0.0015
    assert after.std() < 0.3 * before.std()
    assert abs(np.median(after) - np.median(before)) < 0.0005


def upper_points(scan) -> int:
    return int((scan.border_points[:, 1] > HEIGHT / 2).sum())


def test_a_border_without_a_sound_rim_keeps_its_points(analysis, frame) -> None:
    """The rim of the lower border is sound throughout; of the upper one, even or not, whole or a fifth of it."""
    assert PaintRim.of(analysis, np.zeros((0, 3)), ring(HEIGHT)) is None
    turn, both = np.sin(2 * np.pi * np.arange(300) / 300), np.concatenate([ring(0.0), ring(HEIGHT)])
    count = upper_points(frame)
    assert len(frame.border_points) == 2 * count > 0
    for upper, kept in (
        (ring(HEIGHT - WIDTH * (1.0 + 0.1 * turn)), 0),
        (ring(HEIGHT - WIDTH * (1.0 + 0.8 * turn)), count),
        (ring(HEIGHT - WIDTH)[:60], count),
        (ring(HEIGHT - WIDTH)[:0], count),
    ):
        rim = PaintRim.of(analysis, np.concatenate([ring(WIDTH), upper]), both)
        assert rim is not None
        for left in (rim.others(frame, analysis.rest), rim.terms(frame, analysis.rest, 1.0)[1]):
            assert upper_points(left) == len(left.border_points) == kept


@pytest.mark.parametrize("lower_count", [245, 367])
def test_borders_may_be_painted_in_different_widths(analysis, frame, lower_count: int) -> None:
    """15 and 25 mm, each with most of the rim's points in turn; both hold, and no border that lies right is moved."""
    points = np.concatenate([ring(0.015, lower_count), ring(HEIGHT - 0.025)])
    rim = PaintRim.of(analysis, points, np.concatenate([ring(0.0), ring(HEIGHT)]))
    assert rim is not None
    (term,), left = rim.terms(frame, analysis.rest, 1.0)
    assert not len(left.border_points)
    assert len(term.metric) == len(points)
    weights = np.trace(term.metric, axis1=1, axis2=2) * len(points)
    assert weights.min() > 0.9
    np.testing.assert_allclose(term.residual, 0.0, atol=5e-4)


def test_what_hangs_low_moves_no_other_border(analysis, frame) -> None:
    """The lower border, which has most of the rim's points, lies 4 mm beside its place."""
    points = np.concatenate([ring(WIDTH, 400), ring(HEIGHT - WIDTH)])
    rim = PaintRim.of(analysis, points, np.concatenate([ring(0.0), ring(HEIGHT)]))
    assert rim is not None
    low = analysis.rest - np.array([0.0, 0.004, 0.0]) * (analysis.rest[:, 1:2] < HEIGHT / 2)
    (term,), _ = rim.terms(frame, low, 1.0)
    np.testing.assert_allclose(term.residual, 0.0, atol=5e-4)


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
