"""Trousers, skirts, neckties and long sleeves: sewn right, the same on both sides, one mesh for all styles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from capture4d.body.skinning import ShapedBody
from data_synth.cloth.panels import curve_length, mirrored_name
from data_synth.cloth.patterns import PanelMesh, grade, mesh_pattern
from data_synth.cloth.stencils import rest_areas
from data_synth.drapes.config import STYLES
from data_synth.drapes.garments import GARMENTS

BORDERS = {
    "tshirt": {"neck", "hem", "cuff_left", "cuff_right"},
    "shirt": {"neck", "hem", "cuff_left", "cuff_right"},
    "trousers": {"waist", "leg_left", "leg_right"},
    "skirt": {"waist", "hem"},
    "necktie": {"outline"},
}
OTHER_STYLE = {
    "tshirt": {"sleeve_length": 0.9, "ease": 0.4},
    "shirt": {"sleeve_length": 0.5, "cuff_width": 0.9},
    "trousers": {"length": 0.5, "hem_width": 1.0},
    "skirt": {"length_m": 0.7, "flare": 2.0},
    "necktie": {"width_m": 0.06},
}


def meshed(person: ShapedBody, name: str, vertices: int = 800) -> PanelMesh:
    pattern = GARMENTS[name].draft(person, STYLES[name]())
    return mesh_pattern(pattern, vertices, np.random.default_rng(0), symmetric=True)


@pytest.mark.parametrize("name", GARMENTS)
def test_the_borders_that_stay_open_have_names(person: ShapedBody, name: str):
    mesh = meshed(person, name)
    assert set(mesh.loops) == BORDERS[name]
    assert abs(mesh.vertex_count - 800) < 120


@pytest.mark.parametrize("name", GARMENTS)
def test_the_left_of_a_mesh_is_its_right_mirrored(person: ShapedBody, name: str):
    mesh = meshed(person, name)
    assert mesh.mirror is not None
    np.testing.assert_array_equal(mesh.mirror[mesh.mirror], np.arange(mesh.vertex_count))
    own, image = (np.unique(np.sort(faces, axis=1), axis=0) for faces in (mesh.faces, mesh.mirror[mesh.faces]))
    np.testing.assert_array_equal(own, image)
    for loop, vertices in mesh.loops.items():
        assert set(mesh.mirror[vertices]) == set(mesh.loops[mirrored_name(loop)])


@pytest.mark.parametrize("name", GARMENTS)
def test_both_sides_of_a_seam_are_as_long(person: ShapedBody, name: str):
    lengths: dict[str, list[float]] = {}
    for panel in GARMENTS[name].draft(person, STYLES[name]()).panels:
        for edge in panel.edges:
            lengths.setdefault(edge.name, []).append(curve_length(edge.curve))
    sewn = {seam: sides for seam, sides in lengths.items() if len(sides) == 2}
    for seam, (first, second) in sewn.items():
        # Inseams and outseams of a wider back are eased in; all others are exact.
        assert first == pytest.approx(second, rel=0.04 if seam.startswith(("in_", "out_", "centre")) else 1e-6), seam


@pytest.mark.parametrize("name", GARMENTS)
def test_one_mesh_serves_every_style(person: ShapedBody, name: str):
    kind, style = GARMENTS[name], STYLES[name]()
    mesh = meshed(person, name)
    other = replace(style, **OTHER_STYLE[name])
    graded = grade(mesh, kind.draft(person, style), kind.draft(person, other))
    np.testing.assert_array_equal(graded.faces, mesh.faces)
    assert graded.mirror is mesh.mirror
    change = rest_areas(graded) / rest_areas(mesh)
    assert change.min() > 0.1
    assert np.abs(np.log(change)).max() > 0.1, "the style changes the pattern"
    first, second = graded.uv[:, 1] - graded.uv[:, 0], graded.uv[:, 2] - graded.uv[:, 0]
    assert (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).min() > 0, "no face is turned over"
