"""The borders of a garment whose colours are learned, named by their shape."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from capture4d.captures.take_colours import KnownColours
from capture4d.colours.learning import Light
from capture4d.colours.spaces import Colour, encode_colours, linear_colours
from capture4d.extraction.border_loops import SHIRT
from capture4d.extraction.garment import ColourNotFoundError, cut_out, extract_garment
from capture4d.types import Mesh, Scan
from tests.shapes import tube_faces
from tests.unit.capture4d.extraction.test_border_loops import shirt

CLOTH, YELLOW = (47, 98, 201), (255, 210, 0)
INWARDS = [(0, -1, -0.5), (0, 1, 0.1), (-0.64, 0.77, 0), (0.64, 0.77, 0)]
"""From each loop of a shirt whose arms hang down into the cloth."""
ROW_M, ROWS, PAINTED_ROWS = 0.004, 16, 4
WARM = Light(np.log([[1.0, 0.25, 0.08]]) * (np.arange(12) == 0)[:, None], np.zeros(3), 1.0)
"""Lamplight so red that blue cloth looks grey, alike everywhere."""


def ribbons(paints: tuple[Colour, ...], light: Light | None = None) -> Scan:
    """Four pieces of cloth that end in the loops of a shirt, 16 mm of each end painted."""
    vertices, faces, colours, count = [], [], [], 0
    for loop, inwards, paint in zip(shirt(-50), INWARDS, paints, strict=True):
        way = np.array(inwards) / np.linalg.norm(inwards)
        rows = loop[None] + ROW_M * np.arange(ROWS)[:, None, None] * way
        faces.append(tube_faces(len(loop), ROWS) + count)
        vertices.append(rows.reshape(-1, 3))
        row = np.arange(ROWS).repeat(len(loop))[:, None]
        colours.append(np.where(row <= PAINTED_ROWS, paint, CLOTH))
        count += len(vertices[-1])
    mesh = Mesh(np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int32))
    shown = np.concatenate(colours).astype(np.uint8)
    if light is not None:
        shown = encode_colours(linear_colours(shown) * np.exp(light.coefficients[0]))
    return Scan(mesh, shown, 1, 0.0)


def test_borders_of_one_learned_paint_are_separated_named_and_ordered() -> None:
    scan, paint = ribbons((YELLOW,) * 4, WARM), dict.fromkeys(SHIRT, YELLOW)
    found = cut_out(scan, KnownColours(CLOTH, paint, SHIRT, light=WARM))
    assert found.loop_names == SHIRT
    assert np.bincount(found.boundary_loops).tolist() == [len(loop) for loop in shirt(-50)]
    for index, loop in enumerate(shirt(-50)):
        own = found.boundary_points[found.boundary_loops == index]
        assert np.linalg.norm(own - np.roll(own, 1, axis=0), axis=1).max() < 0.02, "in order around it"
        assert KDTree(loop).query(own)[0].max() < 0.008, "no farther than a sample or two"


def test_the_light_is_taken_out_before_colours_are_told_apart() -> None:
    with pytest.raises(ColourNotFoundError, match="#2f62c9"):
        cut_out(ribbons((YELLOW,) * 4, WARM), KnownColours(CLOTH, dict.fromkeys(SHIRT, YELLOW), SHIRT))


def test_borders_of_given_paints_stay_as_they_are() -> None:
    paints = dict(zip(SHIRT, (YELLOW, (229, 51, 42), (60, 170, 80), (200, 60, 180)), strict=True))
    scan = ribbons(tuple(paints.values()))
    found, plain = cut_out(scan, KnownColours(CLOTH, paints, SHIRT)), extract_garment(scan, CLOTH, paints)
    np.testing.assert_array_equal(found.boundary_points, plain.boundary_points)
    np.testing.assert_array_equal(found.boundary_loops, plain.boundary_loops)
    for index, loop in enumerate(shirt(-50)):
        own = found.boundary_points[found.boundary_loops == index]
        assert KDTree(loop).query(own)[0].max() < 0.008
