"""The sewing pattern: sewn right, meshed evenly, and one plane domain for every resolution."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.body.skinning import ShapedBody
from capture4d.geometry.mesh import boundary_edges, unique_edges
from data_synth.cloth.patterns import grade, locate, mesh_pattern
from data_synth.cloth.tshirt import tshirt_pattern
from data_synth.config import GarmentStyle


@pytest.mark.parametrize("vertices", [600, 2500, 20_000])
def test_only_the_four_borders_stay_open(person: ShapedBody, vertices: int) -> None:
    mesh = mesh_pattern(tshirt_pattern(person, GarmentStyle()), vertices, np.random.default_rng(0))
    assert set(mesh.loops) == {"neck", "hem", "cuff_left", "cuff_right"}
    assert sum(len(loop) for loop in mesh.loops.values()) == len(boundary_edges(mesh.faces))
    # Four borders on a sphere: V - E + F = 2 - 4.
    assert mesh.vertex_count - len(unique_edges(mesh.faces)) + len(mesh.faces) == -2
    assert abs(mesh.vertex_count - vertices) < 0.06 * vertices + 30


def test_faces_are_oriented_alike_and_not_slivers(person: ShapedBody) -> None:
    mesh = mesh_pattern(tshirt_pattern(person, GarmentStyle()), 3000, np.random.default_rng(0))
    first, second = mesh.uv[:, 1] - mesh.uv[:, 0], mesh.uv[:, 2] - mesh.uv[:, 0]
    area = 0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    assert area.min() > 0.05 * np.median(area)
    directed = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed), "an edge runs the same way in two faces"


def test_both_sides_of_a_seam_are_equally_long(person: ShapedBody) -> None:
    pattern = tshirt_pattern(person, GarmentStyle())
    lengths: dict[str, list[float]] = {}
    for panel in pattern.panels:
        for edge in panel.edges:
            length = np.linalg.norm(np.diff(edge.curve, axis=0), axis=1).sum()
            lengths.setdefault(edge.name, []).append(float(length))
    sewn = {name: sides for name, sides in lengths.items() if len(sides) == 2}
    assert len(sewn) == 4 + 2 + 4  # sides and shoulders, sleeves, armholes
    for sides in sewn.values():
        assert sides[0] == pytest.approx(sides[1], rel=1e-6)


def test_locate_finds_known_points(person: ShapedBody) -> None:
    pattern = tshirt_pattern(person, GarmentStyle())
    mesh = mesh_pattern(pattern, 2000, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    faces = rng.integers(0, len(mesh.faces), 500)
    weights = rng.dirichlet(np.ones(3), 500)
    points = np.einsum("nk,nkc->nc", weights, mesh.uv[faces])
    found, barycentric = locate(mesh, points)
    np.testing.assert_allclose(np.einsum("nk,nkc->nc", barycentric, mesh.uv[found]), points, atol=1e-12)
    assert barycentric.min() > -1e-9


def test_linear_functions_pass_between_resolutions_exactly(person: ShapedBody) -> None:
    pattern = tshirt_pattern(person, GarmentStyle())
    coarse = mesh_pattern(pattern, 800, np.random.default_rng(0))
    fine = mesh_pattern(pattern, 6000, np.random.default_rng(1))
    faces, weights = locate(coarse, fine.vertex_uv)
    slope = np.array([0.3, -1.7])
    carried = np.einsum("nk,nk->n", weights, coarse.uv[faces] @ slope)
    np.testing.assert_allclose(carried, fine.vertex_uv @ slope, atol=1e-9)


def test_seeds_give_other_connectivities_of_the_same_cloth(person: ShapedBody) -> None:
    pattern = tshirt_pattern(person, GarmentStyle())
    first, second, again = (mesh_pattern(pattern, 1000, np.random.default_rng(seed)) for seed in (0, 1, 0))
    np.testing.assert_array_equal(first.faces, again.faces)
    assert first.faces.shape != second.faces.shape or (first.faces != second.faces).any()


@pytest.mark.parametrize(
    ("style", "measure"),
    [
        (GarmentStyle(ease=0.4), lambda panel: np.ptp(panel["front"][:, 0])),
        (GarmentStyle(hem_drop_m=0.25), lambda panel: np.ptp(panel["front"][:, 1])),
        (GarmentStyle(sleeve_length=0.9), lambda panel: np.ptp(panel["sleeve_left"][:, 1])),
    ],
)
def test_style_parameters_do_what_they_say(person: ShapedBody, style: GarmentStyle, measure) -> None:
    def outlines(of: GarmentStyle) -> dict[str, np.ndarray]:
        pattern = tshirt_pattern(person, of)
        return {panel.name: np.concatenate([edge.curve for edge in panel.edges]) for panel in pattern.panels}

    assert measure(outlines(style)) > 1.05 * measure(outlines(GarmentStyle()))


def test_grading_to_oneself_changes_nothing(person: ShapedBody) -> None:
    pattern = tshirt_pattern(person, GarmentStyle())
    mesh = mesh_pattern(pattern, 800, np.random.default_rng(0))
    same = grade(mesh, pattern, pattern)
    np.testing.assert_allclose(same.uv, mesh.uv, atol=1e-4)
    np.testing.assert_array_equal(same.noise_uv, mesh.vertex_uv)


def test_a_graded_garment_is_the_larger_one_with_the_same_triangles(person: ShapedBody) -> None:
    drafted, graded = (tshirt_pattern(person, GarmentStyle(size=size)) for size in (1.0, 1.2))
    mesh = mesh_pattern(drafted, 1500, np.random.default_rng(0))
    larger, own = grade(mesh, drafted, graded), mesh_pattern(graded, 1500, np.random.default_rng(0))
    np.testing.assert_array_equal(larger.faces, mesh.faces)

    def area(each) -> np.ndarray:
        first, second = each.uv[:, 1] - each.uv[:, 0], each.uv[:, 2] - each.uv[:, 0]
        return 0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])

    assert area(larger).min() > 0
    assert area(larger).sum() == pytest.approx(area(own).sum(), rel=5e-3)
    growth = area(larger) / area(mesh)
    assert np.ptp(np.log(growth)) < 1.2  # evenly: no face grows more than three times as much as another
