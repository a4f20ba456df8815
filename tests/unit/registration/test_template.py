"""Rest lengths and difference operators of a template."""

import numpy as np

from capture4d.geometry.mesh import unique_edges
from capture4d.types import Mesh
from registration.template import analyse_template, rest_lengths


def test_lengths_come_from_a_pattern_in_metres_and_else_from_the_mesh(garment) -> None:
    mesh = garment.template
    edges = unique_edges(mesh.faces)
    on_mesh = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1)
    flat = np.zeros((len(mesh.faces), 3, 2), np.float32)
    for face, corners in enumerate(mesh.vertices[mesh.faces].astype(float)):
        along = corners[1] - corners[0]
        length = np.linalg.norm(along)
        second = corners[2] - corners[0]
        flat[face, 1] = length, 0
        flat[face, 2] = second @ along / length, np.linalg.norm(np.cross(along, second)) / length
    pattern = Mesh(mesh.vertices, mesh.faces, 1.1 * flat)
    np.testing.assert_allclose(rest_lengths(pattern, edges), 1.1 * on_mesh, rtol=1e-5)
    unit_square = Mesh(mesh.vertices, mesh.faces, 20 * flat)
    np.testing.assert_allclose(rest_lengths(unit_square, edges), on_mesh, rtol=1e-5)


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
