"""Where a shirt's excess is, what of it is stiff, and what keeps its sleeves off its sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import ShapedBody, with_pose
from data_synth.cloth.fabrics import Fabric
from data_synth.cloth.panels import Pattern
from data_synth.cloth.patterns import PanelMesh, locate, mesh_pattern
from data_synth.cloth.tailoring import WALL_RETREAT_M, Made, bending_factors, shrunk, tailor, wall_heights, walls
from data_synth.cloth.tshirt import tshirt_pattern
from data_synth.config import FoldConfig, GarmentStyle
from data_synth.drapes.config import STYLES
from data_synth.drapes.garments import GARMENTS

FOLDS = FoldConfig()


@pytest.fixture(scope="module")
def shirt(person: ShapedBody) -> tuple[Pattern, PanelMesh]:
    pattern = tshirt_pattern(person, GarmentStyle(ease=0.3))
    return pattern, mesh_pattern(pattern, 1500, np.random.default_rng(0))


def test_chest_and_shoulder_blades_are_calm_and_the_rest_is_not(shirt) -> None:
    pattern, mesh = shirt
    excess = 1 - tailor(mesh, pattern, FOLDS).scale[:, 0]
    front = next(panel for panel in pattern.panels if panel.name == "front")
    u, v = (mesh.uv.mean(axis=1) - front.origin).T
    underarm = front.edges[1].curve[-1, 1] - front.origin[1]
    on_front = mesh.face_panels == [panel.name for panel in pattern.panels].index("front")
    chest, below = on_front & (np.abs(u) < 0.08) & (v > underarm), on_front & (v < underarm - 0.2)
    assert excess[chest].max() <= 3 * (1 - FOLDS.calm_shrink[0]) + 1e-12
    assert excess[below, 0].mean() > 5 * excess[chest, 0].mean()
    assert excess[:, 0].max() <= FOLDS.most_excess


def test_a_waistband_is_calm_and_legs_are_not(person: ShapedBody) -> None:
    pattern = GARMENTS["trousers"].draft(person, STYLES["trousers"]())
    mesh = mesh_pattern(pattern, 1500, np.random.default_rng(0))
    excess = 1 - tailor(mesh, pattern, FOLDS).scale[:, 0, 0]
    waist, legs = (
        np.isin(mesh.faces, np.concatenate([mesh.loops[name] for name in names])).any(axis=1)
        for names in (("waist",), ("leg_left", "leg_right"))
    )
    assert excess[waist].max() <= 4 * (1 - FOLDS.calm_shrink[0])
    assert excess[legs].mean() > 5 * excess[waist].mean()


def test_every_mesh_of_a_garment_has_its_excess_in_the_same_places(shirt) -> None:
    pattern, mesh = shirt
    other = mesh_pattern(pattern, 4000, np.random.default_rng(1))
    found, _ = locate(mesh, other.uv.mean(axis=1))
    coarse, fine = (1 - tailor(each, pattern, FOLDS).scale[:, 0, 0] for each in (mesh, other))
    assert np.corrcoef(coarse[found], fine)[0, 1] > 0.95
    assert np.std(fine) > 0.3 * np.mean(fine), "patches, not the same everywhere"


def test_a_share_of_the_excess_is_left(shirt) -> None:
    pattern, mesh = shirt
    scale = tailor(mesh, pattern, FOLDS).scale
    np.testing.assert_allclose(shrunk(mesh, scale, 0).uv, mesh.uv)
    np.testing.assert_allclose(shrunk(mesh, scale).uv, mesh.uv * scale)


def test_hems_and_seams_are_stiffer_and_so_is_the_grain(shirt) -> None:
    pattern, mesh = shirt
    made = Made(tailor(mesh, pattern, FOLDS), replace(FOLDS, strip_bending=4.0, seam_bending=3.0))
    hem, seam = mesh.loops["hem"], mesh.seams["side_left"]
    sewn = np.concatenate(list(mesh.seams.values()))
    middle = np.setdiff1d(np.flatnonzero(~made.tailoring.strip), sewn)[:2]
    edges = np.array([hem[:2], seam[len(seam) // 2 :][:2], middle])
    np.testing.assert_allclose(bending_factors(mesh, made, Fabric(), edges), [4, 3, 1])
    across = np.abs(mesh.vertex_uv[hem[1]] - mesh.vertex_uv[hem[0]])
    assert across[1] == pytest.approx(0, abs=1e-9)
    assert bending_factors(mesh, made, Fabric(grain_bending=2.0), hem[None, :2])[0] == pytest.approx(8)


@pytest.mark.parametrize("raised_deg", [0, 60])
def test_a_wall_parts_arm_and_trunk(person: ShapedBody, shirt, raised_deg: float) -> None:
    pattern, mesh = shirt
    names = person.body.joint_names
    rotations = np.repeat(np.eye(3)[None], len(names), axis=0)
    turn = np.radians(raised_deg)
    rotations[names.index("upperarm01.L")] = [
        [np.cos(turn), -np.sin(turn), 0],
        [np.sin(turn), np.cos(turn), 0],
        [0, 0, 1],
    ]
    body = with_pose(person, rotations, np.zeros(3))
    sleeves = tailor(mesh, pattern, FOLDS).sleeves
    assert [each.side for each in sleeves] == ["L", "R"]
    left, wall = sleeves[0], walls(sleeves, body)[0]
    joints = body.joint_centres()
    shoulder, elbow = (joints[names.index(f"{bone}.L")] for bone in ("upperarm01", "lowerarm01"))
    points = np.zeros((mesh.vertex_count, 3))
    points[left.underarm] = shoulder - [0.02, 0.12, 0]
    on_arm, on_side = elbow, points[left.underarm] - [0, 0.25, 0]
    for place, wrong in ((on_arm, left.signs < 0), (on_side, left.signs > 0)):
        points[left.rows[left.rows != left.underarm]] = place
        heights, below = wall_heights(points, left, wall)
        here = left.rows != left.underarm
        assert below[here].min() > 0
        np.testing.assert_array_equal(heights[here] < 0, wrong[here])


def test_the_wall_of_an_arm_that_points_forwards_leaves_the_chest_alone(person: ShapedBody, shirt) -> None:
    pattern, mesh = shirt
    names = person.body.joint_names
    left = tailor(mesh, pattern, FOLDS).sleeves[0]
    rest = np.repeat(np.eye(3)[None], len(names), axis=0)
    joints = with_pose(person, rest, np.zeros(3)).joint_centres()
    arm = joints[names.index("lowerarm01.L")] - joints[names.index("upperarm01.L")]
    forwards = rest.copy()
    forwards[names.index("upperarm01.L")] = Rotation.align_vectors([[0.0, -0.3, 1.0]], [arm])[0].as_matrix()
    aside, ahead = (walls((left,), with_pose(person, each, np.zeros(3)))[0] for each in (rest, forwards))
    assert (aside.retreat, ahead.retreat) == (0, WALL_RETREAT_M)
    points = np.zeros((mesh.vertex_count, 3))
    points[left.rows[left.rows != left.underarm]] = [-0.03, -0.02, 0.1]  # the chest, before the underarm
    heights, below = wall_heights(points, left, ahead)
    trunk = left.signs < 0
    assert below[trunk].max() > 0
    assert heights[trunk].min() > 0
