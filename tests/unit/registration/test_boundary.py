"""DeepWrinkles Eq. 2 on points one can count on one's fingers."""

import numpy as np
import pytest

from registration.boundary import border_targets, tangent_free_metric

TEMPLATE = np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0]])
SCAN = np.array([[0.5, 0, 0], [1, 3, 0], [-1, 1, 0], [11, 0, 0], [9, 3, 0], [12, -1, 0]])
"""The first three vote for template point 0, the others for 1; nobody votes for 2."""
NO_LOOPS, ONE_LOOP = np.full(6, -1, np.int32), np.zeros(3, np.int32)


def test_argmax_takes_the_farthest_voter_not_the_nearest_point() -> None:
    found = border_targets(TEMPLATE, ONE_LOOP, SCAN, NO_LOOPS, rule="argmax", gate=100.0)
    np.testing.assert_array_equal(found.points[:2], [SCAN[1], SCAN[4]])


def test_a_vertex_without_voters_has_no_target() -> None:
    for rule in ("argmax", "mean"):
        found = border_targets(TEMPLATE, ONE_LOOP, SCAN, NO_LOOPS, rule=rule, gate=100.0)
        np.testing.assert_array_equal(found.valid, [True, True, False])


def test_nearest_and_mean() -> None:
    nearest = border_targets(TEMPLATE, ONE_LOOP, SCAN, NO_LOOPS, rule="nearest", gate=100.0)
    np.testing.assert_array_equal(nearest.points, [SCAN[0], SCAN[3], SCAN[5]])
    mean = border_targets(TEMPLATE, ONE_LOOP, SCAN, NO_LOOPS, rule="mean", gate=100.0)
    np.testing.assert_allclose(mean.points[:2], [SCAN[:3].mean(axis=0), SCAN[3:].mean(axis=0)])


def test_voters_change_as_the_template_moves() -> None:
    moved = border_targets(TEMPLATE - [10, 0, 0], ONE_LOOP, SCAN, NO_LOOPS, rule="argmax", gate=100.0)
    np.testing.assert_array_equal(moved.valid, [False, True, True])


def test_loops_keep_to_themselves_where_the_paint_tells() -> None:
    loops, scan_loops = np.array([0, 1, 1], np.int32), np.ones(6, np.int32)
    found = border_targets(TEMPLATE, loops, SCAN, scan_loops, rule="argmax", gate=100.0)
    np.testing.assert_array_equal(found.valid, [False, True, False])
    np.testing.assert_array_equal(found.points[1], SCAN[2])


@pytest.mark.parametrize("rule", ["argmax", "mean", "nearest"])
def test_loops_that_share_a_paint_have_targets_beside_one_that_has_its_own(rule) -> None:
    """Loop 1 has a paint of its own; loops 0 and 2 share one, so its points vote for both and not for loop 1."""
    loops = np.array([0, 1, 2], np.int32)
    scan = np.array([[9.0, 1, 0], [8, 0, 0], [11, 0, 0], [21, 0, 0]])
    scan_loops = np.array([1, -1, -1, -1], np.int32)
    found = border_targets(TEMPLATE, loops, scan, scan_loops, rule=rule, gate=100.0)
    assert found.valid.all()
    expected = {"argmax": [1, 0, 2], "nearest": [1, 0, 3]}
    if rule == "mean":
        np.testing.assert_allclose(found.points, [scan[1], scan[0], (scan[2] + scan[3]) / 2])
    else:
        np.testing.assert_array_equal(found.points, scan[expected[rule]])


@pytest.mark.parametrize("rule", ["argmax", "mean", "nearest"])
def test_the_gate_holds(rule) -> None:
    found = border_targets(TEMPLATE, ONE_LOOP, SCAN + np.array([0, 50, 0]), NO_LOOPS, rule=rule, gate=10.0)
    assert not found.valid.any()


def test_no_rule_no_points_no_targets() -> None:
    assert not border_targets(TEMPLATE, ONE_LOOP, SCAN, NO_LOOPS, rule="none", gate=1.0).valid.any()
    nothing = np.zeros((0, 3)), np.zeros(0, np.int32)
    assert not border_targets(TEMPLATE, ONE_LOOP, *nothing, rule="argmax", gate=1.0).valid.any()


def test_along_the_curve_sliding_is_free() -> None:
    metric = tangent_free_metric(np.array([[1.0, 0, 0]]), np.array([3.0]))[0]
    np.testing.assert_allclose(metric, np.diag([0, 3.0, 3.0]))
