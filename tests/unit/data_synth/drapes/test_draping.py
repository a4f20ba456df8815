"""Garments put on people that they were not drafted for, and on those that they were."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from capture4d.body.skinning import ShapedBody
from capture4d.geometry.mesh import edge_lengths
from capture4d.types import Body
from data_synth.drapes.config import DrapesConfig, GarmentName, SolverConfig
from data_synth.drapes.draping import Draper


@pytest.fixture
def growing(person: ShapedBody) -> Body:
    """The mannequin with one shape: a tenth larger for each standard deviation."""
    body = person.body
    return replace(
        body,
        shape_directions=0.1 * body.template.vertices[None],
        joint_directions=0.1 * body.joints[None],
    )


def test_a_necktie_of_another_width_is_not_stretched_to_the_drafts_own(growing: Body):
    config = DrapesConfig(garment="necktie", vertices=150, style=("width_m=0.05", "length_m=0.4"))
    draper = Draper(config, growing)
    stretch = edge_lengths(draper.dressed, draper.sheet.edges) / draper.sheet.lengths
    assert np.percentile(stretch, 99) < 1.1


def test_a_garment_is_drafted_for_the_mean_person_or_the_wearer(growing: Body):
    config = DrapesConfig(garment="skirt", vertices=200, beta=(2.0,))
    mean, measured = Draper(config, growing), Draper(replace(config, drafted_for="wearer"), growing)
    np.testing.assert_array_equal(mean.mesh.faces, measured.mesh.faces)
    girths = [
        _ring_length(each.mesh.uv, each.mesh.faces, each.mesh.loops["waist"])
        for each in (Draper(replace(config, beta=()), growing), mean, measured)
    ]
    np.testing.assert_allclose(np.divide(girths, girths[0]), [1.0, 1.0, 1.2], rtol=0.02)
    worn = [each.dressed[each.mesh.loops["waist"]] for each in (mean, measured)]
    rings = [np.linalg.norm(points - np.roll(points, -1, axis=0), axis=1).sum() for points in worn]
    tight, fitting = np.divide(rings, girths[1:])
    assert tight > 1.03 * fitting


@pytest.mark.parametrize(("garment", "frames"), [("skirt", 2), ("necktie", 6)])
def test_what_swings_is_given_three_times_the_frames(growing: Body, garment: GarmentName, frames: int):
    config = DrapesConfig(garment=garment, vertices=150, solver=SolverConfig(frames=2, still_mm=1e-9))
    draper = Draper(config, growing)
    assert draper.drape(draper.dressing).frames == frames


def _ring_length(uv: np.ndarray, faces: np.ndarray, ring: np.ndarray) -> float:
    """Length on the pattern of a closed row of vertices."""
    pairs = {frozenset(pair) for pair in zip(ring.tolist(), np.roll(ring, -1).tolist(), strict=True)}
    total = 0.0
    for corners, places in zip(faces.tolist(), uv, strict=True):
        for i in range(3):
            if frozenset((corners[i], corners[i - 1])) in pairs:
                total += float(np.linalg.norm(places[i] - places[i - 1]))
    return total
