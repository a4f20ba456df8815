"""A printed tube that has been turned in its own surface: only its colours show it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.types import Garment, GarmentScan, Mesh
from registration.config import RegistrationConfig
from registration.prints import (
    CONTRAST,
    learn_print,
    learning_positions,
    load_print,
    print_of_picture,
    save_print,
    still_positions,
)
from registration.register import prepare_frame, register_frame
from registration.template import TemplateAnalysis, analyse_template

RADIUS, HEIGHT, TURN = 0.1, 0.2, 0.04
"""Metres, and radians: 4 mm around the tube."""


def tube(around: int, along: int) -> Mesh:
    """A round tube with UVs: metres around it and up, unrolled."""
    angle, height = np.arange(around + 1) / around * 2 * np.pi, np.linspace(0, HEIGHT, along)
    points = np.array([(RADIUS * np.sin(a), y, RADIUS * np.cos(a)) for y in height for a in angle[:-1]])
    flat = np.array([(RADIUS * a, y) for y in height for a in angle])
    faces, uv = [], []
    for row in range(along - 1):
        for column in range(around):
            after = (column + 1) % around
            a, b = row * around + column, row * around + after
            p, q = row * (around + 1) + column, row * (around + 1) + column + 1
            up, over = around, around + 1
            faces += [(a, b, a + up), (b, b + up, a + up)]
            uv += [flat[[p, q, p + over]], flat[[q, q + over, p + over]]]
    return Mesh(points.astype(np.float32), np.array(faces, np.int32), np.array(uv, np.float32))


def blobs(places: np.ndarray, seed: int = 0) -> np.ndarray:
    """sRGB from 0 to 1 of a print with features of about 20 mm, seamless around the tube."""
    rng = np.random.default_rng(seed)
    around, up = places[:, 0] / RADIUS, places[:, 1]
    waves = np.zeros((len(places), 3))
    for _ in range(24):
        turns, rise, phase = rng.integers(-14, 15), rng.uniform(-140, 140), rng.uniform(0, 2 * np.pi, 3)
        waves += np.cos(turns * around[:, None] + rise * up[:, None] + phase)
    return 0.45 + 0.35 * np.tanh(waves / 3)


def stripes(places: np.ndarray) -> np.ndarray:
    """Rings around the tube, which say nothing of turning."""
    return np.repeat(0.45 + 0.35 * np.sin(2 * np.pi * places[:, 1:] / 0.03), 3, axis=1)


def scan_of(ink: Callable[[np.ndarray], np.ndarray], *, turn: float = 0.0, lift: float = 0.0, lamp: float = 0.0):
    """A tube whose print is turned and lifted, under a lamp at one side."""
    mesh = tube(250, 81)
    points = mesh.vertices.astype(float)
    angle = np.arctan2(points[:, 0], points[:, 2])
    colours = ink(np.column_stack([RADIUS * (angle - turn), points[:, 1] - lift]))
    colours *= (1 - lamp * 0.5 * (1 + np.sin(angle)))[:, None] * (1 - lamp * np.array([0.0, 0.2, 0.1]))
    none = np.zeros((0, 3), np.float32)
    return GarmentScan(
        mesh, none, np.zeros(0, np.int32), (), 1, np.clip(np.rint(255 * colours), 0, 255).astype(np.uint8)
    )


@pytest.fixture(scope="module")
def config() -> RegistrationConfig:
    return RegistrationConfig()


@pytest.fixture(scope="module")
def template(config) -> TemplateAnalysis:
    return analyse_template(Garment(tube(46, 15)), config)


@pytest.fixture(scope="module")
def printed(template, config) -> TemplateAnalysis:
    cloth, _ = learn_print(template, None, [0], [1], load=lambda _: scan_of(blobs), config=config)
    return replace(template, cloth=cloth)


def moved(analysis: TemplateAnalysis, scan: GarmentScan, config: RegistrationConfig) -> tuple[float, float]:
    """How far registration takes the template around the tube, and up, millimetres; median of its inner vertices."""
    frame = prepare_frame(analysis, scan, config)
    found = register_frame(analysis, frame, analysis.rest, config=config, schedule="warm").vertices
    inner = np.abs(analysis.rest[:, 1] - HEIGHT / 2) < 0.06
    angle = [np.arctan2(points[inner, 0], points[inner, 2]) for points in (found, analysis.rest)]
    turned = np.angle(np.exp(1j * (angle[0] - angle[1])))
    up = (found - analysis.rest)[inner, 1]
    return 1e3 * RADIUS * float(np.median(turned)), 1e3 * float(np.median(up))


@pytest.mark.parametrize("lamp", [0.0, 0.5])
def test_a_turn_that_no_shape_shows_is_found_by_colours_under_any_lamp(template, printed, config, lamp) -> None:
    scan = scan_of(blobs, turn=TURN, lamp=lamp)
    assert abs(moved(template, scan, config)[0]) < 0.5
    assert moved(printed, scan, config)[0] == pytest.approx(1e3 * RADIUS * TURN, abs=0.4)


def test_without_colours_of_the_template_those_of_the_scan_change_nothing(template, config) -> None:
    coloured, bare = scan_of(blobs, turn=TURN), replace(scan_of(blobs, turn=TURN), colours=None)
    results = [
        register_frame(template, prepare_frame(template, scan, config), template.rest, config=config, schedule="warm")
        for scan in (coloured, bare)
    ]
    np.testing.assert_array_equal(results[0].vertices, results[1].vertices)


def test_a_scan_without_colours_is_registered_as_if_there_were_no_print(template, printed, config) -> None:
    bare = replace(scan_of(blobs, turn=TURN), colours=None)
    results = [
        register_frame(each, prepare_frame(each, bare, config), template.rest, config=config, schedule="warm")
        for each in (template, printed)
    ]
    np.testing.assert_array_equal(results[0].vertices, results[1].vertices)


def test_stripes_pull_across_and_not_along(template, config) -> None:
    cloth, contrast = learn_print(template, None, [0], [1], load=lambda _: scan_of(stripes), config=config)
    assert contrast > CONTRAST
    scan = scan_of(stripes, turn=TURN, lift=0.004)
    around, up = moved(replace(template, cloth=cloth), scan, config)
    assert up == pytest.approx(4, abs=0.6)
    assert abs(around) < 1.5  # all diagonals of the template lean one way


@pytest.mark.parametrize("lamp", [0.0, 0.6])
def test_plain_cloth_is_told_from_printed(template, config, lamp) -> None:
    rng = np.random.default_rng(1)

    def dye(places: np.ndarray) -> np.ndarray:
        return np.array([0.3, 0.4, 0.7]) + 0.015 * rng.standard_normal((len(places), 3))

    cloth, contrast = learn_print(template, None, [0], [1], load=lambda _: scan_of(dye, lamp=lamp), config=config)
    assert cloth == ()
    assert 0 < contrast < CONTRAST / 2


def test_scans_without_colours_teach_nothing(template, config) -> None:
    bare = replace(scan_of(blobs), colours=None)
    cloth, contrast = learn_print(template, None, [0], [1], load=lambda _: bare, config=config)
    assert cloth == ()
    assert np.isnan(contrast)


def test_a_picture_says_what_scans_do(template, printed) -> None:
    rows, columns = 200, 629
    v = HEIGHT * (1 - (np.arange(rows) + 0.5) / rows)
    u = 2 * np.pi * RADIUS * (np.arange(columns) + 0.5) / columns
    places = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    picture = np.rint(255 * blobs(places)).astype(np.uint8).reshape(rows, columns, 3)
    for given, learned in zip(print_of_picture(template, picture), printed.cloth, strict=True):
        known = learned.known & given.known
        assert known.mean() > 0.4
        about = [each.values[known] - each.values[known].mean(axis=0) for each in (given, learned)]
        assert np.corrcoef(about[0].ravel(), about[1].ravel())[0, 1] > 0.97
        assert given.steepness == pytest.approx(learned.steepness, rel=0.25)


def test_a_print_is_the_same_after_it_was_written(template, printed, tmp_path) -> None:
    save_print(tmp_path / "print.npz", printed.cloth, 1.0)
    for again, first in zip(load_print(tmp_path / "print.npz", template), printed.cloth, strict=True):
        np.testing.assert_allclose(again.values, first.values, atol=1e-6)
        assert (again.steepness, again.spread, again.reach) == (first.steepness, first.spread, first.reach)
    with pytest.raises(InputError, match="values"):
        load_print(tmp_path / "print.npz", analyse_template(Garment(tube(20, 8)), RegistrationConfig()))
    save_print(tmp_path / "plain.npz", (), 0.1)
    assert load_print(tmp_path / "plain.npz", template) == ()


def test_a_print_is_learned_from_the_first_second_whatever_the_rate() -> None:
    assert learning_positions(1000, 60) == range(0, 55, 3)
    assert learning_positions(1000, 20) == range(0, 19, 1)
    assert learning_positions(5, 60) == range(0, 5, 3)


def test_a_print_is_learned_where_the_body_stands_as_in_the_first_frame(template) -> None:
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])

    def skinned(position: int) -> np.ndarray:
        bent = template.rest + np.array([0.0, 0.0, 0.003 * position]) * (template.rest[:, 1:2] > HEIGHT / 2)
        return bent @ turn.T + 0.1 * position

    kept = still_positions(skinned, range(0, 60, 3))
    assert kept == [*range(0, len(kept) * 3, 3)]
    assert 3 < len(kept) < 20
    assert still_positions(lambda position: (1 + position) * template.rest, range(10)) == [0, 1, 2]
