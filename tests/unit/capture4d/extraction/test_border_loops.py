"""Loops of a shirt in any pose: straightened, separated, ordered, named."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.extraction.border_loops import (
    SHIRT,
    SKIRT,
    TROUSERS,
    loop_order,
    name_loops,
    separate_loops,
    straighten,
)


def ring(middle: tuple[float, float, float], axis: tuple[float, float, float], radius: float, count: int) -> np.ndarray:
    n = np.array(axis) / np.linalg.norm(axis)
    a = np.cross(n, (0.3, 0.2, 1.0))
    a /= np.linalg.norm(a)
    angle = 2 * np.pi * np.arange(count)[:, None] / count
    return np.array(middle) + radius * (np.cos(angle) * a + np.sin(angle) * np.cross(n, a))


def shirt(arms_deg: float) -> list[np.ndarray]:
    """Neck, hem, left and right cuff of somebody who faces +Z, their upper arms so far above the horizontal."""
    c, s = np.cos(np.radians(arms_deg)), np.sin(np.radians(arms_deg))
    cuffs = [ring((x * (0.2 + 0.25 * c), 1.4 + 0.25 * s, 0), (x * c, s, 0), 0.075, 90) for x in (1, -1)]
    return [ring((0, 1.45, 0), (0, 1, 0.5), 0.085, 100), ring((0, 0.85, 0), (0, 1, 0.1), 0.2, 240), *cuffs]


@pytest.mark.parametrize("arms_deg", [-50, 0, 60])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_shirts_loops_are_named_whatever_the_pose_and_the_order_of_points(arms_deg: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    loops = shirt(arms_deg)
    points = np.concatenate(loops) + 0.001 * rng.standard_normal((sum(map(len, loops)), 3))
    truth = np.repeat(np.arange(4), [len(loop) for loop in loops])
    turned = Rotation.from_euler("yx", (rng.uniform(0, 360), rng.uniform(-20, 20)), degrees=True).apply(points)
    order = rng.permutation(len(points))
    names = list(rng.permutation(SHIRT))
    found = name_loops(turned[order] + rng.normal(size=3), names)
    assert [names[index] for index in found] == [SHIRT[index] for index in truth[order]]


def test_what_is_not_a_shirt_or_has_a_level_neck_is_not_guessed() -> None:
    loops = shirt(-50)
    points = np.concatenate(loops)
    assert (name_loops(points, ("border_0", "border_1", "border_2", "border_3")) == -1).all()
    assert (name_loops(np.concatenate(loops[:3]), SHIRT) == -1).all()
    level = [ring((0, 1.45, 0), (0, 1, 0), 0.085, 100), *loops[1:]]
    named = name_loops(np.concatenate(level), SHIRT)
    assert set(named.tolist()) == {-1, 0, 1}


def test_pieces_of_loops_are_not_named() -> None:
    neck, hem, left, right = shirt(-50)
    halves = hem[(np.arange(240) % 120) > 20]  # two pieces, and no right cuff: four curves again
    assert (separate_loops(np.concatenate([neck, halves, left]), 4) >= 0).all()
    assert (name_loops(np.concatenate([neck, halves, left]), SHIRT) == -1).all()
    crumbs = hem[(np.arange(240) % 24) > 11]  # pieces of 6 cm, too short for loops
    assert (name_loops(np.concatenate([crumbs, hem[100:139], neck, left, right]), SHIRT) == -1).all()


def test_loops_are_separated_across_small_holes_and_strays_are_left_out() -> None:
    first, second = ring((0, 0, 0), (0, 1, 0), 0.2, 300), ring((0, 0.3, 0), (0, 1, 0), 0.1, 150)
    stray = np.array([[0.0, 0.15, 0.0]])
    holed = first[(np.arange(300) % 100) > 5]  # gaps of 29 mm
    loop = separate_loops(np.concatenate([second, stray, holed]), 2)
    np.testing.assert_array_equal(loop, [1] * 150 + [-1] + [0] * len(holed))
    assert (separate_loops(np.concatenate([second, holed]), 3) == -1).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_order_goes_once_around(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = ring((1, 2, 3), tuple(rng.normal(size=3).tolist()), 0.15, 80)
    shuffled = points[rng.permutation(80)]
    ordered = shuffled[loop_order(shuffled)]
    steps = np.linalg.norm(ordered - np.roll(ordered, 1, axis=0), axis=1)
    np.testing.assert_allclose(steps, 2 * 0.15 * np.sin(np.pi / 80), rtol=1e-6)


def test_straightening_removes_noise_across_a_curve_and_leaves_a_line_alone() -> None:
    rng = np.random.default_rng(3)
    clean = ring((0, 0, 0), (0, 1, 0), 0.1, 250)
    noisy = clean + 0.0015 * rng.standard_normal(clean.shape)

    def error(points: np.ndarray) -> float:
        return float(np.hypot(np.hypot(points[:, 0], points[:, 2]) - 0.1, points[:, 1]).mean())

    assert error(straighten(noisy, 0.01)) < 0.6 * error(noisy)
    line = np.linspace(0, 1, 200)[:, None] * [0.3, 0.2, 0.1]
    np.testing.assert_allclose(straighten(line, 0.01), line, atol=1e-12)
    np.testing.assert_array_equal(straighten(line[:2], 0.01), line[:2])


def trousers(seat_m: float, thigh_m: float = 0.0) -> tuple[list[np.ndarray], np.ndarray]:
    """Waist, left and right leg of somebody who faces +Z, and a surface whose seat stands out so far, the thighs bent
    forward by as much."""
    loops = [
        ring((0, 1.05, 0), (0, 1, 0.1), 0.14, 160),
        *(ring((x, 0.15, 0), (0, 1, 0), 0.07, 80) for x in (0.12, -0.12)),
    ]
    seat = ring((0, 0.9, -seat_m), (0, 1, 0), 0.15, 200)
    shins = [ring((x, y, thigh_m), (0, 1, 0), 0.08, 60) for x in (0.12, -0.12) for y in (0.3, 0.5)]
    return loops, np.concatenate([*loops, seat, *shins])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_legs_of_trousers_are_told_by_the_seat(seed: int) -> None:
    rng = np.random.default_rng(seed)
    loops, surface = trousers(0.04)
    turn, order = (
        Rotation.from_euler("yx", (rng.uniform(0, 360), rng.uniform(-8, 8)), degrees=True),
        rng.permutation(320),
    )
    points = turn.apply(np.concatenate(loops) + 0.001 * rng.standard_normal((320, 3)))[order]
    names = list(rng.permutation(TROUSERS))
    found = name_loops(points, names, turn.apply(surface))
    truth = np.repeat(np.arange(3), [160, 80, 80])[order]
    assert [names[index] for index in found] == [TROUSERS[index] for index in truth]


def test_legs_are_not_guessed_without_a_seat_or_while_they_are_bent() -> None:
    for loops, surface in (trousers(0.002), trousers(0.04, thigh_m=0.5), (trousers(0.04)[0], None)):
        named = name_loops(np.concatenate(loops), TROUSERS, surface)
        assert set(named[:160]) == {0}
        assert set(named[160:]) == {-1}
    _, left, right = trousers(0.04)[0]
    equal = [ring((0, 1.05, 0), (0, 1, 0), 0.075, 90), left, right]
    assert set(name_loops(np.concatenate(equal), TROUSERS)) == {-1}


def test_the_hem_of_a_skirt_hangs_below_its_waist() -> None:
    wide, narrow = ring((0, 0.5, 0), (0, 1, 0.2), 0.25, 200), ring((0, 1.0, 0), (0, 1, 0), 0.14, 130)
    named = name_loops(np.concatenate([wide, narrow]), SKIRT)
    assert set(named[:200]) == {SKIRT.index("hem")}
    assert set(named[200:]) == {SKIRT.index("waist")}
    level = ring((0.6, 0.52, 0), (0, 1, 0), 0.14, 130)
    assert set(name_loops(np.concatenate([wide, level]), SKIRT)) == {-1}
