"""Rest lengths and difference operators of a template."""

from dataclasses import replace

import numpy as np
import pytest

from capture4d.types import Mesh
from registration.template import UnknownBorderError, analyse_template, require_borders


def test_an_atlas_of_the_template_changes_nothing(garment, config) -> None:
    """Charts that were cut out of the mesh know no more than the mesh: its lengths stay as without any UVs."""
    mesh = garment.template
    without = analyse_template(garment, config)
    with_atlas = analyse_template(replace(garment, template=replace(mesh, uv=_one_by_one(mesh))), config)
    np.testing.assert_array_equal(with_atlas.rest_lengths, without.rest_lengths)


def _one_by_one(mesh: Mesh) -> np.ndarray:
    """Every triangle squeezed by a tenth, beside the one before."""
    corners = mesh.vertices[mesh.faces]
    return (corners[..., :2] * (0.9, 1.0) + np.arange(len(corners))[:, None, None]).astype(np.float32)


def test_paints_that_name_no_border_may_be_on_any(garment, config) -> None:
    border = analyse_template(garment, config).border
    require_borders(border, ["hem", "border", "paint_0", "paint_12"])
    for name in ("borders", "paint_x", "Hem"):
        with pytest.raises(UnknownBorderError, match=f"expected border loops named {name}, as the paints are; found"):
            require_borders(border, ["neck", name])


def test_laplacian_vanishes_on_constants_and_follows_the_border(garment, config) -> None:
    analysis = analyse_template(garment, config)
    ones = np.ones((len(analysis.rest), 3, 1))
    np.testing.assert_allclose(analysis.laplacian_rows.apply(ones), 0, atol=1e-12)
    hem = garment.loops["hem"]
    rest = analysis.rest
    found = analysis.laplacian_rows.apply(rest[:, :, None])[hem]
    expected = rest[hem] - 0.5 * (rest[np.roll(hem, 1)] + rest[np.roll(hem, -1)])
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_border_vertices_carry_the_coarse_data_term(garment, config) -> None:
    analysis = analyse_template(garment, config)
    assert set(np.concatenate(list(garment.loops.values()))) <= set(analysis.coarse_vertices)
    tangents = analysis.border.tangents(analysis.rest)
    np.testing.assert_allclose(np.linalg.norm(tangents, axis=1), 1)
    np.testing.assert_allclose(tangents[:, 1], 0, atol=1e-6)
