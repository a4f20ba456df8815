"""Cages: curves between labels or through vertices, the patches they leave, and what is smoothed along them."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.geometry.cages.cage import cage_of_curves, cage_of_edges, cage_of_labels, merged_specks
from capture4d.geometry.mesh import boundary_edges, face_areas
from tests.shapes import plane, tube

MESH = plane(cells=6)
MIDDLE = MESH.vertices.astype(float)[MESH.faces].mean(axis=1)


def test_labels_part_the_mesh_where_they_meet() -> None:
    cage = cage_of_labels(MESH.faces, (MIDDLE[:, 0] > 0.5).astype(np.int32))
    x, z = MESH.vertices[:, 0], MESH.vertices[:, 2]
    on_line = np.isclose(x, 0.5) | np.isclose(x % 1, 0) | np.isclose(z % 1, 0)
    np.testing.assert_array_equal(cage.vertices, np.flatnonzero(on_line))
    assert len(cage.edges) == 4 * 6 + 6
    assert cage.patch_count == 2
    assert len({(side, patch) for side, patch in zip(MIDDLE[:, 0] > 0.5, cage.patches, strict=True)}) == 2


def test_a_label_in_two_places_makes_two_patches() -> None:
    outer = np.abs(MIDDLE[:, 0] - 0.5) > 0.3
    assert cage_of_labels(MESH.faces, outer.astype(np.int32)).patch_count == 3


def test_curves_go_the_shortest_way_and_make_the_cage_of_the_same_labels() -> None:
    ends = [int(np.argmin(np.linalg.norm(MESH.vertices[:, [0, 2]] - end, axis=1))) for end in ((0.5, 0), (0.5, 1))]
    curved = cage_of_curves(MESH.vertices, MESH.faces, [np.array(ends)])
    labelled = cage_of_labels(MESH.faces, (MIDDLE[:, 0] > 0.5).astype(np.int32))
    np.testing.assert_array_equal(curved.edges, labelled.edges)
    np.testing.assert_array_equal(curved.patches, labelled.patches)


def test_a_loop_around_a_tube_cuts_it_in_two() -> None:
    mesh = tube(12, 7)
    loop = np.append(np.arange(36, 48), 36)
    assert cage_of_edges(mesh.faces, np.zeros((0, 2), np.int32)).patch_count == 1
    cage = cage_of_curves(mesh.vertices, mesh.faces, [loop[[0, 4, 8, 12]]])
    assert cage.patch_count == 2
    assert set(loop) <= set(cage.vertices.tolist())


def test_smoothing_runs_along_the_curves_alone() -> None:
    """On the tube's two rims, which no curve joins: each becomes even at its own mean."""
    mesh = tube(12, 7)
    cage = cage_of_edges(mesh.faces, boundary_edges(mesh.faces))
    upper = cage.vertices >= 12
    values = np.random.default_rng(0).standard_normal((len(cage.vertices), 2)) + 10 * upper[:, None]
    even = cage.smoothed(values, 400)
    for rim in (upper, ~upper):
        np.testing.assert_allclose(even[rim], np.broadcast_to(values[rim].mean(axis=0), (12, 2)), atol=1e-6)


def test_specks_go_to_their_neighbour() -> None:
    labels = (MIDDLE[:, 0] > 0.5).astype(np.int32)
    labels[np.argmin(np.linalg.norm(MIDDLE - (0.25, 0, 0.5), axis=1))] = 7
    areas = face_areas(MESH.vertices.astype(float), MESH.faces)
    merged = merged_specks(MESH.faces, labels, areas, 0.05)
    np.testing.assert_array_equal(merged, (MIDDLE[:, 0] > 0.5).astype(np.int32) ^ merged[0] ^ labels[0])


def test_marks_that_do_not_fit_are_told() -> None:
    with pytest.raises(InputError, match=r"expected a label for each of 72 triangles, found \(71,\)"):
        cage_of_labels(MESH.faces, np.zeros(71, np.int32))
    with pytest.raises(InputError, match="expected edges of the mesh, found 0 to 48"):
        cage_of_edges(MESH.faces, np.array([[0, 48]]))
    with pytest.raises(InputError, match="curve 0: expected two or more vertices from 0 to 48, found 2 from 0 to 49"):
        cage_of_curves(MESH.vertices, MESH.faces, [np.array([0, 49])])
    both = np.concatenate([MESH.faces, MESH.faces + len(MESH.vertices)])
    with pytest.raises(InputError, match="curve 0: expected a way along edges, found none from 0 to 60"):
        cage_of_curves(np.concatenate([MESH.vertices, MESH.vertices]), both, [np.array([0, 60])])
