"""A painted tube on a grey body: cut out by colour under uneven light, its border found behind holes."""

import numpy as np
import pytest

from capture4d.colours.labels import classify_colours
from capture4d.errors import InputError
from capture4d.extraction.garment import ColourNotFoundError, extract_garment, painted_border
from capture4d.types import Mesh, Scan
from tests.shapes import tube_faces

CLOTH, TOP, BOTTOM, SUIT = (47, 98, 201), (255, 196, 0), (229, 51, 42), (150, 152, 156)
AROUND, ALONG, BAND = 200, 120, 0.012
SPACING = 0.003
"""Of the samples of a ragged sheet, metres."""


def painted_tube(rng: np.random.Generator, *, holes: int = 0, bottom: tuple[int, int, int] = BOTTOM) -> Scan:
    """A tube 0.3 m high with 12 mm of paint at either end, going on as a grey suit beyond its lower border."""
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    heights = np.linspace(-0.1, 0.3, ALONG)
    ring = np.stack([0.1 * np.sin(angle), 0.1 * np.cos(angle)], axis=1)
    vertices = np.concatenate([np.column_stack([ring[:, 0], np.full(AROUND, y), ring[:, 1]]) for y in heights])
    faces = tube_faces(AROUND, ALONG)
    y = vertices[:, 1]
    colours = np.full((len(vertices), 3), SUIT, float)
    colours[y >= 0] = CLOTH
    colours[(y >= 0) & (y < BAND)] = bottom
    colours[y > 0.3 - BAND] = TOP
    light = 0.55 + 0.45 * np.clip(vertices[:, 2:] / 0.1, -1, 1)  # from nearly dark to full
    colours = np.clip(255 * (((colours / 255) ** 2.2) * np.maximum(light, 0.25)) ** (1 / 2.2), 0, 255)
    colours += 4 * rng.standard_normal(colours.shape)
    keep = np.ones(len(faces), bool)
    for _ in range(holes):
        centre = np.array([*ring[rng.integers(AROUND)], 0])[[0, 2, 1]] + [0, rng.uniform(0, 0.02), 0]
        keep &= np.linalg.norm(vertices[faces].mean(axis=1) - centre, axis=1) > 0.006
    mesh = Mesh(vertices.astype(np.float32), faces[keep])
    return Scan(mesh, np.clip(colours, 0, 255).astype(np.uint8), 3, 0.0)


def test_the_garment_is_cut_out_whole() -> None:
    scan = painted_tube(np.random.default_rng(0))
    found = extract_garment(scan, CLOTH, {"top": TOP, "bottom": BOTTOM})
    expected = scan.mesh.vertices[scan.mesh.vertices[:, 1] >= 0]
    assert len(found.mesh.vertices) == pytest.approx(len(expected), rel=0.01)
    assert found.mesh.vertices[:, 1].min() > -0.007


@pytest.mark.parametrize("holes", [0, 25])
def test_border_points_lie_on_the_border(holes: int) -> None:
    found = extract_garment(painted_tube(np.random.default_rng(1), holes=holes), CLOTH, {"top": TOP, "bottom": BOTTOM})
    height = found.boundary_points[:, 1]
    top, bottom = found.boundary_loops == 0, found.boundary_loops == 1
    assert top.sum() > 150
    assert bottom.sum() > 120
    assert np.abs(height[top] - 0.3).mean() < 0.002  # the scan ends here, at the bottom it goes on; samples: 3.4 mm
    assert np.abs(height[bottom]).mean() < 0.0025
    assert np.percentile(np.abs(height[bottom]), 95) < 0.006


def ragged_sheet(rng: np.random.Generator, lost: tuple[float, float]) -> tuple[Mesh, np.ndarray, float]:
    """A sheet that ends raggedly before its painted border, its colours, and where the border truly is.

    Args:
        lost: from least to most, in sample spacings, beside what is lost between samples.
    """
    height, along = np.arange(50) * SPACING, np.arange(120) * SPACING
    grid = np.stack(np.meshgrid(along, height, indexing="ij"), axis=2).reshape(-1, 2)
    grid += rng.uniform(-0.2, 0.2, grid.shape) * SPACING
    border = grid[:, 1].max()
    corner = (np.arange(119)[:, None] * 50 + np.arange(49)).reshape(-1)
    faces = np.concatenate([corner[:, None] + [0, 50, 51], corner[:, None] + [0, 51, 1]]).astype(np.int32)
    ends = border - np.repeat(rng.uniform(*lost, 120), 50) * SPACING
    faces = faces[(grid[:, 1] < ends)[faces].all(axis=1)]
    used, renumbered = np.unique(faces, return_inverse=True)
    vertices = np.column_stack([grid, np.zeros(len(grid))])[used].astype(np.float32)
    colours = np.where(vertices[:, 1:2] > border - 0.015, TOP, CLOTH).astype(np.uint8)
    return Mesh(vertices, renumbered.reshape(-1, 3).astype(np.int32)), colours, border


def inner_heights(found: np.ndarray) -> np.ndarray:
    """Of border points that are not at the sides of the sheet."""
    return found[(found[:, 0] > 0.03) & (found[:, 0] < 119 * SPACING - 0.03), 1]


@pytest.mark.parametrize("seed", range(3))
def test_what_a_ragged_scan_lost_of_the_paint_is_given_back(seed: int) -> None:
    mesh, colours, border = ragged_sheet(np.random.default_rng(seed), (0.2, 1.6))
    columns = np.rint(mesh.vertices[:, 0] / SPACING).astype(int)
    ends = [mesh.vertices[columns == column, 1].max() for column in range(120)]
    assert border - np.mean(ends) > SPACING
    found = inner_heights(painted_border(mesh, colours, TOP)[0])
    assert len(found) > 60
    assert abs(found.mean() - border) < 0.5 * SPACING


@pytest.mark.parametrize("seed", range(3))
def test_scans_of_the_body_as_well_have_lost_less(seed: int) -> None:
    mesh, colours, border = ragged_sheet(np.random.default_rng(seed), (0.0, 0.8))
    body = mesh.vertices + np.array([0, 0, -0.05], np.float32)
    both = Mesh(np.concatenate([mesh.vertices, body]), np.concatenate([mesh.faces, mesh.faces + len(body)]))
    scan = Scan(both, np.concatenate([colours, np.full_like(colours, SUIT)]), 1, 0.0)
    found = inner_heights(extract_garment(scan, CLOTH, {"top": TOP}).boundary_points)
    assert len(found) > 60
    assert abs(found.mean() - border) < 0.2 * SPACING


@pytest.mark.parametrize("seed", range(3))
def test_a_border_with_nothing_behind_it_is_as_widely_painted_as_one_that_is_scanned_to_its_end(seed: int) -> None:
    rng, spacing, border = np.random.default_rng(seed), 0.0027, 0.17
    across, up = np.meshgrid(np.arange(200) * spacing, np.arange(80) * spacing, indexing="ij")
    grid = np.stack([across, up], axis=2).reshape(-1, 2) + rng.uniform(-0.2, 0.2, (200 * 80, 2)) * spacing
    corner = (np.arange(199)[:, None] * 80 + np.arange(79)).reshape(-1)
    faces = np.concatenate([corner[:, None] + [0, 80, 81], corner[:, None] + [0, 81, 1]]).astype(np.int32)
    bare = grid[:, 0] > 0.25
    cloth = (grid[:, 1] < border - np.where(bare, 0.0048, 0.0))[faces].all(axis=1)
    suit = (grid[:, 1] > border + 0.01)[faces].all(axis=1)
    colours = np.where(grid[:, 1:2] > border - 0.015, TOP, CLOTH)
    colours = np.where(grid[:, 1:2] > border, SUIT, colours).astype(np.uint8)
    vertices = np.column_stack([grid, np.zeros(len(grid))]).astype(np.float32)
    scan = Scan(Mesh(vertices, faces[cloth | suit]), colours, 1, 0.0)
    found = extract_garment(scan, CLOTH, {"top": TOP}).boundary_points
    for here in (found[:, 0] < 0.2, found[:, 0] > 0.3):
        inside = found[here & (found[:, 0] > 0.03) & (found[:, 0] < 0.5) & (found[:, 1] > 0.1)]
        assert len(inside) > 60
        assert abs(inside[:, 1].mean() - border) < 0.45 * spacing


def test_one_paint_cannot_tell_loops_apart() -> None:
    found = extract_garment(painted_tube(np.random.default_rng(2), bottom=TOP), CLOTH, {"top": TOP, "bottom": TOP})
    assert found.loop_names == ("top", "bottom")
    assert (found.boundary_loops == -1).all()


def test_specks_are_cleaned_and_other_parts_dropped() -> None:
    rng = np.random.default_rng(3)
    scan = painted_tube(rng)
    colours = scan.colours.copy()
    specks = rng.choice(np.flatnonzero(scan.mesh.vertices[:, 1] > 0.05), 60, replace=False)
    colours[specks] = SUIT
    hand = scan.mesh.vertices[:, 1] < -0.08
    colours[hand] = TOP
    found = extract_garment(Scan(scan.mesh, colours, 3, 0.0), CLOTH, {"top": TOP, "bottom": BOTTOM})
    assert found.mesh.vertices[:, 1].min() > -0.007
    clean = extract_garment(scan, CLOTH, {"top": TOP, "bottom": BOTTOM})
    assert len(found.mesh.faces) > 0.99 * len(clean.mesh.faces)


def test_shading_does_not_change_the_class() -> None:
    shades = (np.array([CLOTH, TOP, BOTTOM, SUIT])[:, None] * np.linspace(0.5, 1, 8)[:, None]).reshape(-1, 3)
    labels = classify_colours(shades.astype(np.uint8), CLOTH, (TOP, BOTTOM)).reshape(4, 8)
    np.testing.assert_array_equal(labels, np.repeat([[1], [2], [3], [0]], 8, axis=1))


def test_missing_colours_are_named_with_what_was_found() -> None:
    scan = painted_tube(np.random.default_rng(4))
    with pytest.raises(ColourNotFoundError, match=r"scans/3.ply: garment colour #00ff00 not found: .* found 0 %"):
        extract_garment(scan, (0, 255, 0), {"top": TOP}, source="scans/3.ply")
    with pytest.raises(InputError, match=r"border colour #ff00ff not found: expected at least 0.1 %"):
        extract_garment(scan, CLOTH, {"top": (255, 0, 255)})


def test_no_painted_borders_no_border_points() -> None:
    found = extract_garment(painted_tube(np.random.default_rng(5)), CLOTH, {})
    assert len(found.boundary_points) == 0
    assert len(found.mesh.faces) > 0
