"""Which part of the body each vertex of a garment meets."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.body.skinning import ShapedBody
from data_synth.cloth.panels import mirrored_name
from data_synth.cloth.patterns import mesh_pattern
from data_synth.drapes.config import STYLES
from data_synth.drapes.draping import part_contacts
from data_synth.drapes.garments import GARMENTS, panel_vertices

OTHER_SIDE = {"tshirt": [0, 2, 1], "shirt": [0, 2, 1], "trousers": [1, 0, 2], "skirt": [0], "necktie": [0]}


@pytest.mark.parametrize("name", OTHER_SIDE)
def test_a_vertex_meets_one_part_and_its_mirror_image_the_other_side_s(person: ShapedBody, name: str):
    kind = GARMENTS[name]
    pattern = kind.draft(person, STYLES[name]())
    mesh = mesh_pattern(pattern, 500, np.random.default_rng(0), symmetric=True)
    panels, _ = panel_vertices(mesh, pattern)
    vertices, parts = part_contacts(mesh, panels, kind)
    np.testing.assert_array_equal(vertices, np.arange(mesh.vertex_count))
    assert mesh.mirror is not None
    np.testing.assert_array_equal(parts[mesh.mirror], np.array(OTHER_SIDE[name])[parts])
    assert set(parts) == set(range(len(OTHER_SIDE[name])))
    for panel in pattern.panels:
        inner = np.setdiff1d(
            mesh.faces[[pattern.panels[i].name == panel.name for i in mesh.face_panels]],
            mesh.faces[[pattern.panels[i].name != panel.name for i in mesh.face_panels]],
        )
        assert set(parts[inner]) == set(kind.meets[panel.name])
        assert kind.meets[mirrored_name(panel.name)] == (OTHER_SIDE[name][kind.meets[panel.name][0]],)
