"""A style and a person are found again in garments that the model itself made, and in those of the formula."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.captures.drapes.style_sets import StyleSet
from capture4d.errors import InputError
from capture4d.types import Mesh
from retarget.mixture.config import StylesConfig
from retarget.mixture.learning import learn_styles
from retarget.mixture.lesson import StyleLesson, style_lesson
from retarget.mixture.style_fit import SeenFrame, fit_style
from retarget.mixture.styled_garment import StyledGarment
from tests.unit.retarget.mixture.conftest import ALONG, AROUND, motion

LOOPS = {"waist": np.arange(AROUND, dtype=np.int32), "hem": np.arange(AROUND, dtype=np.int32) + AROUND * (ALONG - 1)}
Saw = Callable[..., SeenFrame]


@pytest.fixture(scope="module")
def lesson(style_set: StyleSet) -> StyleLesson:
    return style_lesson(style_set)


@pytest.fixture(scope="module")
def garment(lesson: StyleLesson, tmp_path_factory: pytest.TempPathFactory) -> StyledGarment:
    """Kernels alone, which are learned at once."""
    learned = learn_styles(lesson, StylesConfig(members=0), tmp_path_factory.mktemp("learned"))[0]
    return replace(learned, garment=replace(learned.garment, loops=LOOPS))


@pytest.fixture(scope="module")
def saw(garment: StyledGarment) -> Saw:
    """A frame in which the model's own garment is seen: its vertices, or another surface of twice as many sides."""

    def seen(length: float, beta: float, angle: float, *, surface: bool = False, tracked: float | None = None,
             place: tuple[float, float, float] = (0.1, 0.5, -0.2)) -> SeenFrame:  # fmt: skip
        pose = motion([angle], np.array([place]))
        vertices = garment.vertices(pose, (beta,), {"length": length}, remove_intersections=False)[0]
        mesh = Mesh(vertices, garment.garment.template.faces)
        points = np.concatenate([vertices[loop] for loop in LOOPS.values()])
        names = tuple(name for name, loop in LOOPS.items() for _ in loop)
        if surface:
            mesh = finer(mesh)
        shown = motion([angle if tracked is None else tracked], np.array([place]))
        return SeenFrame(shown.rotations[0], shown.translations[0], mesh, not surface, points, names)

    return seen


def finer(mesh: Mesh) -> Mesh:
    """Each face cut in three at its middle; the new vertices come first."""
    a, b, c = mesh.faces.T
    middle, corners = mesh.vertices[mesh.faces].mean(axis=1), len(mesh.faces)
    points = np.concatenate([middle, mesh.vertices])
    rows = np.arange(corners)
    faces = np.concatenate([np.stack([rows, p + corners, q + corners], 1) for p, q in ((a, b), (b, c), (c, a))])
    return Mesh(points.astype(np.float32), faces.astype(np.int32))


@pytest.mark.parametrize(("length", "beta", "angle"), [(0.7, 0.4, 0.3), (0.45, -0.8, 1.0), (0.6, 0.9, 0.0)])
def test_what_the_model_made_is_found_again(garment: StyledGarment, saw: Saw, length: float, beta: float, angle: float):
    fit = fit_style(garment, [saw(length, beta, angle)], fit_pose=False)
    assert fit.style["length"] == pytest.approx(length, abs=0.004)
    assert fit.beta[0] == pytest.approx(beta, abs=0.02)
    assert fit.residual_mm[0] < 0.3
    assert fit.at_limit == ()
    np.testing.assert_allclose(fit.translations[0], (0.1, 0.5, -0.2), atol=1e-3)


def test_a_surface_with_vertices_of_its_own_will_do(garment: StyledGarment, saw: Saw):
    fit = fit_style(garment, [saw(0.7, 0.4, 0.5, surface=True)], fit_pose=False)
    assert fit.style["length"] == pytest.approx(0.7, abs=0.02)
    assert fit.beta[0] == pytest.approx(0.4, abs=0.15)
    assert fit.residual_mm[0] < 1.0


def test_a_pose_that_was_tracked_badly_is_turned_right(garment: StyledGarment, saw: Saw):
    """By three degrees: the style is no worse for it, and the knee is nearer to where it was."""
    angle, off = 0.6, np.radians(3.0)
    held, turned = (fit_style(garment, [saw(0.7, 0.4, angle, tracked=angle + off)], fit_pose=pose)
                    for pose in (False, True))  # fmt: skip
    knee = Rotation.from_euler("x", angle)
    assert turned.residual_mm[0] < held.residual_mm[0]
    apart = [np.degrees((knee.inv() * Rotation.from_matrix(fit.rotations[0, 1])).magnitude()) for fit in (held, turned)]
    assert apart[0] == pytest.approx(3.0, abs=0.01)
    assert apart[1] < 2.0
    assert abs(turned.style["length"] - 0.7) < 0.02


def test_frames_share_the_style_and_not_the_pose(garment: StyledGarment, saw: Saw):
    frames = [saw(0.55, -0.3, angle, place=(angle, 0.0, 0.0)) for angle in (0.1, 0.5, 0.9)]
    fit = fit_style(garment, frames)
    assert fit.style["length"] == pytest.approx(0.55, abs=0.01)
    assert fit.rotations.shape == (3, 3, 3, 3)
    np.testing.assert_allclose(fit.translations[:, 0], (0.1, 0.5, 0.9), atol=0.003)


def test_test_pairs_of_the_formula_are_found(garment: StyledGarment, style_set: StyleSet):
    """Garments that the model never saw, in poses that it never saw."""
    for pair in style_set.pairs:
        if pair.role != "test":
            continue
        drapes = pair.drapes
        mesh = Mesh(drapes.vertices[1], garment.garment.template.faces)
        frame = SeenFrame(drapes.rotations[1], np.zeros(3), mesh, True, np.zeros((0, 3), np.float32), ())
        found = fit_style(garment, [frame], fit_pose=False).numbers
        wanted = garment.ranges.numbers(drapes.style, drapes.shape)
        np.testing.assert_allclose(found, wanted, atol=0.15)


def test_what_is_beyond_the_range_ends_at_it_and_says_so(garment: StyledGarment, saw: Saw):
    frame = saw(0.8, 0.0, 0.2)
    grown = frame.mesh.vertices * np.float32(1.2)
    fit = fit_style(garment, [replace(frame, mesh=frame.mesh.with_vertices(grown))], fit_pose=False)
    assert "length" in fit.at_limit
    assert (np.abs(fit.numbers) <= 1 + 1e-9).all()


def test_a_tracked_person_stays(garment: StyledGarment, saw: Saw):
    """More components than were learned are left out, one beyond the range is brought to its end."""
    fits = [fit_style(garment, [saw(0.7, 0.3, 0.3)], shape=shape, fit_pose=False) for shape in ((0.9, 1.0), (5.0,), ())]
    assert [fit.beta[0] for fit in fits] == pytest.approx([0.9, 1.0, 0.3], abs=0.1)
    assert [fit.style["length"] for fit in fits] == pytest.approx([0.7, 0.7, 0.7], abs=0.03)


def test_what_cannot_be_fitted_is_one_line(garment: StyledGarment, saw: Saw, tmp_path: Path):
    frame = saw(0.7, 0.4, 0.3)
    with pytest.raises(InputError, match="frames: expected at least one"):
        fit_style(garment, [])
    with pytest.raises(InputError, match=r"frame 1: expected a pose of 3 joints, found \(2, 3, 3\)"):
        fit_style(garment, [replace(frame, rotations=frame.rotations[:2])])
    with pytest.raises(InputError, match="frame 1: expected 70 vertices"):
        fit_style(garment, [replace(frame, mesh=finer(frame.mesh))])
