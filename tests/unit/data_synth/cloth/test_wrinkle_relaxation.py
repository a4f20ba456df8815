"""Fine folds: the stencils are those of the pattern, and relaxation does what each of its parts promises."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from capture4d.body.skinning import ShapedBody, with_pose
from capture4d.geometry.mesh import vertex_normals
from data_synth.cloth.fabrics import Fabric
from data_synth.cloth.panels import Edge, Panel, Pattern
from data_synth.cloth.patterns import PanelMesh, mesh_pattern
from data_synth.cloth.quality import measure_cloth, principal_stretches
from data_synth.cloth.wrinkle_relaxation import (
    BodySurface,
    Finish,
    Level,
    WrinkleMesh,
    lift,
    relax_frame,
    relax_levels,
    wrinkle_mesh,
)
from data_synth.config import RelaxationConfig

SIDE = 0.3
FAR_BODY = np.array([[-9.0, -9.0, -9.0], [9.0, -9.0, -9.0], [0.0, 9.0, -9.0]])
BODY_FACES = np.array([[0, 1, 2]], np.int32)
FAR = BodySurface.create(FAR_BODY, BODY_FACES)


def square(vertices: int, seed: int) -> PanelMesh:
    corners = np.array([[0, 0], [SIDE, 0], [SIDE, SIDE], [0, SIDE], [0, 0]], float)
    edges = tuple(Edge(np.linspace(a, b, 20), "rim|sheet") for a, b in pairwise(corners))
    return mesh_pattern(Pattern((Panel("sheet", edges),), ("rim",)), vertices, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def sheets() -> tuple[PanelMesh, PanelMesh, WrinkleMesh]:
    coarse, fine = square(150, 0), square(4000, 1)
    return coarse, fine, wrinkle_mesh(coarse, fine, RelaxationConfig(), np.random.default_rng(2))


def flat(mesh: PanelMesh, width: float = 1.0) -> np.ndarray:
    return np.column_stack([mesh.vertex_uv * [width, 1], np.zeros(mesh.vertex_count)])


def usual(wrinkles: WrinkleMesh) -> Level:
    return Level(wrinkles, Fabric(), RelaxationConfig())


def test_rest_lengths_are_those_of_the_pattern(sheets) -> None:
    _, fine, wrinkles = sheets
    ends = fine.vertex_uv[wrinkles.edges]
    np.testing.assert_allclose(wrinkles.rest_lengths, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), rtol=1e-6)


def test_bending_stencils_vanish_on_flat_cloth_and_see_a_fold(sheets) -> None:
    _, fine, wrinkles = sheets

    def bent(height: np.ndarray) -> np.ndarray:
        points = np.column_stack([fine.vertex_uv, height])
        return np.einsum("qk,qkc->qc", wrinkles.hinge_weights[:, :4], points[wrinkles.hinges])

    assert np.abs(bent(0.3 * fine.vertex_uv[:, 0] - fine.vertex_uv[:, 1])).max() < 1e-4 * SIDE
    fold = bent(np.abs(fine.vertex_uv[:, 0] - SIDE / 2))
    crossing = np.ptp(np.sign(fine.vertex_uv[wrinkles.hinges[:, 2:], 0] - SIDE / 2), axis=1) > 0
    assert np.abs(fold[crossing, 2]).mean() > 50 * np.abs(fold[~crossing, 2]).mean()


def test_a_plane_is_lifted_to_itself(sheets) -> None:
    coarse, fine, wrinkles = sheets
    lifted, normals = lift(wrinkles, flat(coarse))
    np.testing.assert_allclose(lifted, flat(fine), atol=1e-9)
    np.testing.assert_allclose(normals, np.broadcast_to([0, 0, 1.0], normals.shape), atol=1e-9)


def test_compressed_cloth_folds_until_its_edges_have_their_length(sheets) -> None:
    coarse, fine, wrinkles = sheets
    settings = RelaxationConfig(sweeps=60)
    folded, _ = relax_frame(Level(wrinkles, Fabric(), settings), flat(coarse, 0.93), FAR, None)
    ends = folded[wrinkles.edges]
    stretch = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / wrinkles.rest_lengths
    assert np.percentile(stretch, 5) > 0.97, "7 % of the width should have gone into folds"
    assert np.percentile(stretch, 99) < 1.06
    assert np.abs(folded[:, 2]).max() > 0.002
    assert np.abs(folded - flat(fine, 0.93)).max() < 1.5 * settings.radius_m


def test_the_last_sweeps_give_cloth_its_lengths_back_sooner_over_relaxed(sheets) -> None:
    coarse, fine, wrinkles = sheets
    shortest = []
    for finish in (None, Finish(15, 0.005, 1.0), Finish(15, 0.005, 1.6)):
        level = Level(wrinkles, Fabric(), RelaxationConfig(sweeps=10, start_sweeps_factor=2), finish)
        folded, _ = relax_frame(level, flat(coarse, 0.93), FAR, None)
        shortest.append(np.percentile(principal_stretches(fine, folded)[:, 0], 5))
    assert shortest[0] < shortest[1] < shortest[2] < 1.0


def test_cloth_that_is_pulled_along_does_not_shrink_across_where_long_edges_have_slack(sheets) -> None:
    coarse, fine, wrinkles = sheets
    pulled = flat(coarse) * np.array([1, 1.08, 1])
    least = []
    for slack in (1.0, 0.3):
        level = Level(wrinkles, Fabric(), RelaxationConfig(radius_m=0.004), Finish(60, 0.002, 1.5, slack))
        relaxed, _ = relax_frame(level, pulled, FAR, None)
        least.append(np.percentile(principal_stretches(fine, relaxed)[:, 0], 5))
    assert least[0] < 0.975, "a net of springs shrinks across by a third of what it is stretched along"
    assert least[1] > least[0] + 0.004


def test_a_turned_layer_stands_out_and_is_not_compressed_by_it(person: ShapedBody, sheets) -> None:
    """1 mm outwards of a fold is 5 % of its length where it is bent by a radius of 20 mm."""
    coarse, fine, wrinkles = sheets
    strip = fine.vertex_uv[:, 1] < SIDE / 3
    body = with_pose(person, np.repeat(np.eye(3)[None], len(person.body.joint_names), axis=0), np.zeros(3))
    sheet = flat(coarse, 0.93) + np.array([0, 0, 5])
    finish = Finish(60, 0.005, 1.0)
    thin, thick = (
        relax_levels([Level(mesh, Fabric(), RelaxationConfig(), finish)], sheet, body, None)[0]
        for mesh in (wrinkles, replace(wrinkles, raised=np.where(strip, 0.001, 0.0)))
    )
    outwards = vertex_normals(thin.astype(float), fine.faces)
    height = np.einsum("vc,vc->v", thick - thin, outwards)
    assert np.median(height[strip]) > 0.0008
    assert np.abs(height[fine.vertex_uv[:, 1] > 0.6 * SIDE]).max() < 1e-6
    inside = strip[fine.faces].all(axis=1)
    pushed = thin + np.where(strip, 0.001, 0.0)[:, None] * outwards
    least = [np.percentile(principal_stretches(fine, each)[inside, 0], 2) for each in (pushed, thick, thin)]
    assert least[0] < least[1]
    assert least[1] > least[2] - 0.2 * (least[2] - least[0])


@pytest.mark.parametrize("turned_deg", [0.0, 33.0])
def test_principal_stretches_are_those_of_an_affine_map(sheets, turned_deg: float) -> None:
    _, fine, _ = sheets
    turn = np.radians(turned_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    plane = fine.vertex_uv @ rotation * [0.9, 1.1]
    placed = np.column_stack([plane[:, 0], 0.6 * plane[:, 1], 0.8 * plane[:, 1]])
    np.testing.assert_allclose(principal_stretches(fine, placed), np.tile([0.9, 1.1], (len(fine.faces), 1)), rtol=1e-9)


def test_stiffer_cloth_has_fewer_folds(sheets) -> None:
    coarse, _, wrinkles = sheets
    roughness = []
    for bending in (0.05, 0.6):
        fabric = replace(Fabric(), fold_bending=bending)
        folded, _ = relax_frame(Level(wrinkles, fabric, RelaxationConfig()), flat(coarse, 0.93), FAR, None)
        bent = np.einsum("qk,qkc->qc", wrinkles.hinge_weights[:, :4], folded[wrinkles.hinges])
        roughness.append(float(np.abs(bent).mean()))
    assert roughness[1] < 0.7 * roughness[0]


def test_cloth_stays_outside_the_body(sheets) -> None:
    coarse, _, wrinkles = sheets
    body = np.array([[-9.0, -9.0, 0.001], [9.0, -9.0, 0.001], [0.0, 9.0, 0.001]])  # 1 mm into the sheet
    folded, _ = relax_frame(usual(wrinkles), flat(coarse, 0.93), BodySurface.create(body, BODY_FACES), None)
    assert folded[:, 2].min() > 0.001


def test_folds_of_two_starts_meet(sheets) -> None:
    """The folds follow the pose: runs that start apart agree after a while; with no imperfection they need not."""
    coarse, _, wrinkles = sheets
    frames = [flat(coarse, width) for width in np.linspace(0.99, 0.93, 40)]
    ends = []
    for start in (0, 15):
        offsets = None
        for frame in frames[start:]:
            folded, offsets = relax_frame(usual(wrinkles), frame, FAR, offsets)
        ends.append(folded)
    assert np.abs(ends[0] - ends[1])[:, 2].mean() < 0.25 * np.abs(ends[0][:, 2]).mean()


def test_equal_input_gives_equal_bits(sheets) -> None:
    coarse, _, wrinkles = sheets
    first, second = (relax_frame(usual(wrinkles), flat(coarse, 0.95), FAR, None)[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(("scale", "crushed", "over"), [(0.249, 1, 0), (0.251, 0, 0), (1.99, 0, 0), (2.01, 0, 1)])
def test_area_limits_are_those_of_the_paper(sheets, scale: float, crushed: int, over: int) -> None:
    _, fine, wrinkles = sheets
    quality = measure_cloth(
        fine, wrinkles, flat(fine, scale).astype(np.float32), FAR_BODY.astype(np.float32), BODY_FACES
    )
    faces = len(fine.faces)
    assert quality.crushed_faces == crushed * faces
    assert quality.overstretched_faces == over * faces
    assert bool(quality.reasons) == (bool(crushed or over) or quality.stretch_p99 > 1.2)
