"""A tube of cloth on a tube of a body that bends in the middle."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.body.body_candidates import BodyCandidates
from capture4d.body.limbs import WornBody
from capture4d.body.skinning import ShapedBody, skin, with_pose, with_shape
from capture4d.geometry.intersection_removal import Penetration
from capture4d.types import Body, Mesh
from tests.shapes import tube

MARGIN_M = 0.002


def weights_of(points: np.ndarray) -> np.ndarray:
    bend = np.clip((points[:, 1] - 0.3) / 0.2, 0, 1)
    return np.stack([1 - bend, bend], axis=1).astype(np.float32)


@pytest.fixture(scope="module")
def person() -> ShapedBody:
    mesh = tube(24, 33, radius=0.1, height=0.8)
    body = Body(
        template=mesh,
        shape_directions=np.zeros((1, len(mesh.vertices), 3), np.float32),
        joints=np.array([[0, 0, 0], [0, 0.4, 0]], np.float32),
        joint_directions=np.zeros((1, 2, 3), np.float32),
        joint_names=("root", "knee"),
        parents=np.array([-1, 0], np.int32),
        skin_weights=weights_of(mesh.vertices),
    )
    return with_shape(body, np.zeros(1))


@pytest.fixture(scope="module")
def cloth() -> Mesh:
    return tube(20, 21, radius=0.104, height=0.6, start=0.1)


def candidates(person: ShapedBody, cloth: Mesh, **others: float) -> BodyCandidates:
    weights = weights_of(cloth.vertices)
    return BodyCandidates(person, cloth.vertices, cloth.faces, weights, margin_m=MARGIN_M, **others)


def pose(angle: float, turned: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    return np.stack([Rotation.from_rotvec(turned).as_matrix(), Rotation.from_euler("x", angle).as_matrix()])


def depths(
    person: ShapedBody, cloth: Mesh, points: np.ndarray, rotations: np.ndarray, place: np.ndarray
) -> Penetration:
    body = WornBody(person, cloth.vertices, weights_of(cloth.vertices))
    return Penetration.of(body.posed(with_pose(person, rotations, place).vertices()).contacts(points))


def test_skinning_is_that_of_all_joints(person, cloth) -> None:
    posed = with_pose(person, pose(0.7), np.array([0.1, 0.2, 0.3]))
    wanted = skin(cloth.vertices.astype(np.float64), weights_of(cloth.vertices), posed.transforms)
    np.testing.assert_allclose(candidates(person, cloth).skinned(cloth.vertices, posed), wanted, atol=1e-7)


def test_what_is_outside_stays_where_it_is(person, cloth) -> None:
    posed = with_pose(person, pose(0.0), np.zeros(3))
    np.testing.assert_array_equal(candidates(person, cloth).pushed_out(cloth.vertices, posed), cloth.vertices)


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.1])
@pytest.mark.parametrize("seed", [0, 1])
def test_what_is_inside_comes_out(person, cloth, angle: float, seed: int) -> None:
    """Cloth with dents of up to 2 cm, and bends of the knee that fold its own skin over it."""
    near = candidates(person, cloth)
    rng = np.random.default_rng(seed)
    dented = cloth.vertices * (1 - rng.uniform(0, 0.2, (len(cloth.vertices), 1)) * (1, 0, 1))
    rotations, place = pose(angle), np.array([0.0, 1.0, 0.0])
    posed = with_pose(person, rotations, place)
    start = near.skinned(dented, posed)
    kept = start.copy()
    found = near.pushed_out(start, posed)
    np.testing.assert_array_equal(start, kept)
    before, after = (depths(person, cloth, each, rotations, place) for each in (start, found))
    assert before.inside_percent > 30
    assert after.inside_percent <= 1.0
    assert after.depth_max_mm < 0.3 * before.depth_max_mm


def test_pushing_turns_with_body_and_cloth(person, cloth) -> None:
    """To a tenth of a millimetre: on round bodies two candidates may be equally near."""
    near = candidates(person, cloth)
    turned, moved = np.array([0.3, -1.0, 0.4]), np.array([0.5, -0.2, 2.0])
    dented = cloth.vertices * (0.9, 1.0, 0.9)
    still = with_pose(person, pose(0.4), np.zeros(3))
    away = with_pose(person, pose(0.4, tuple(turned)), moved)
    plain = near.pushed_out(near.skinned(dented, still), still)
    rigid = away.transforms[0] @ np.linalg.inv(still.transforms[0])
    np.testing.assert_allclose(
        near.pushed_out(near.skinned(dented, away), away), plain @ rigid[:3, :3].T + rigid[:3, 3], atol=1e-4
    )


def test_edges_are_no_longer_than_allowed(person, cloth) -> None:
    """A single vertex pushed 3 cm out draws its neighbours along."""
    dented = cloth.vertices.astype(np.float64)
    dented[205] *= (0.7, 1.0, 0.7)
    posed = with_pose(person, pose(0.0), np.zeros(3))
    loose, tight = (candidates(person, cloth, longest=longest) for longest in (np.inf, 1.0))
    moved = [np.linalg.norm(near.pushed_out(dented, posed) - dented, axis=1) for near in (loose, tight)]
    assert all(each[205] > 0.02 for each in moved)
    assert (moved[1] > 1e-5).sum() > (moved[0] > 1e-5).sum()


def test_only_near_skin_is_posed(person, cloth) -> None:
    short = Mesh(*(getattr(tube(20, 5, radius=0.104, height=0.1, start=0.1), name) for name in ("vertices", "faces")))
    near = candidates(person, short)
    assert 0 < near.count < len(person.vertices) / 2
    assert near.count < candidates(person, cloth).count


def test_pose_correctives_are_seen(person, cloth) -> None:
    """Skin that swells with the bend pushes the cloth farther out."""
    swelling = np.zeros((9, len(person.vertices), 3), np.float32)
    swelling[4] = -0.5 * person.vertices * (1, 0, 1)
    swollen = with_shape(replace(person.body, pose_directions=swelling), np.zeros(1))
    rotations = pose(0.6)
    found = []
    for each in (person, swollen):
        posed = with_pose(each, rotations, np.zeros(3))
        near = candidates(each, cloth)
        found.append(near.pushed_out(near.skinned(cloth.vertices, posed), posed))
    assert np.linalg.norm(found[1] - found[0], axis=1).max() > 0.005
    assert depths(swollen, cloth, found[1], rotations, np.zeros(3)).inside_percent < 1.0
