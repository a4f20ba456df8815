"""Laws of skinning, and the SMPL-family reader against a body made here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import SINGULAR_CONDITION, _near_singular, skin, unskin, with_pose, with_shape
from capture4d.errors import InputError
from capture4d.types import Body, Mesh


def make_body(joints: int = 4, verts: int = 60, seed: int = 0) -> Body:
    rng = np.random.default_rng(seed)
    weights = rng.dirichlet(np.ones(joints), verts).astype(np.float32)
    return Body(
        template=Mesh(rng.normal(size=(verts, 3)).astype(np.float32), rng.integers(0, verts, (40, 3)).astype(np.int32)),
        shape_directions=(0.1 * rng.normal(size=(3, verts, 3))).astype(np.float32),
        joints=rng.normal(size=(joints, 3)).astype(np.float32),
        joint_directions=(0.1 * rng.normal(size=(3, joints, 3))).astype(np.float32),
        joint_names=tuple(f"j{i}" for i in range(joints)),
        parents=np.arange(-1, joints - 1).astype(np.int32),
        skin_weights=weights / weights.sum(axis=1, keepdims=True),
    )


def some_pose(body: Body, size: float, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return Rotation.from_rotvec(size * rng.normal(size=(len(body.joint_names), 3))).as_matrix()


def test_identity_pose_is_the_rest_pose() -> None:
    body = make_body()
    shaped = with_shape(body, np.zeros(3))
    posed = with_pose(shaped, np.repeat(np.eye(3)[None], 4, axis=0), np.zeros(3))
    np.testing.assert_allclose(posed.vertices(), shaped.vertices, atol=1e-12)


def test_root_rotation_moves_everything_rigidly() -> None:
    body = make_body()
    shaped = with_shape(body, np.array([1.0, -0.5]))
    rotations = np.repeat(np.eye(3)[None], 4, axis=0)
    rotations[0] = Rotation.from_euler("y", 70, degrees=True).as_matrix()
    moved = with_pose(shaped, rotations, np.array([1.0, 2.0, 3.0])).vertices()
    expected = (shaped.vertices - shaped.joints[0]) @ rotations[0].T + shaped.joints[0] + [1, 2, 3]
    np.testing.assert_allclose(moved, expected, atol=1e-12)


def test_joint_follows_its_parent_and_keeps_bone_length() -> None:
    body = make_body()
    shaped = with_shape(body, np.zeros(0))
    posed = with_pose(shaped, some_pose(body, 0.8), np.zeros(3))
    moved = np.einsum("jab,jb->ja", posed.transforms[:, :3, :3], shaped.joints) + posed.transforms[:, :3, 3]
    for joint in range(1, 4):
        parent = body.parents[joint]
        carried = posed.transforms[parent, :3, :3] @ shaped.joints[joint] + posed.transforms[parent, :3, 3]
        np.testing.assert_allclose(moved[joint], carried, atol=1e-12)


@pytest.mark.parametrize("size", [0.1, 0.5, 0.9])
def test_unskin_inverts_skin_in_float64(size: float) -> None:
    body = make_body()
    shaped = with_shape(body, np.zeros(3))
    transforms = with_pose(shaped, some_pose(body, size), np.ones(3)).transforms
    rest, flagged = unskin(skin(shaped.vertices, body.skin_weights, transforms), body.skin_weights, transforms)
    assert not flagged.any()
    np.testing.assert_allclose(rest, shaped.vertices, atol=1e-9)


def test_half_turn_blended_with_identity_is_flagged_not_inverted() -> None:
    transforms = np.repeat(np.eye(4)[None], 2, axis=0)
    transforms[1, :3, :3] = Rotation.from_euler("z", 180, degrees=True).as_matrix()
    weights = np.array([[0.5, 0.5], [0.9, 0.1]])
    rest, flagged = unskin(np.ones((2, 3)), weights, transforms)
    assert flagged.tolist() == [True, False]
    assert np.isfinite(rest).all()


def test_too_many_shape_coefficients_are_refused() -> None:
    with pytest.raises(InputError, match="expected at most 3 coefficients, found 4"):
        with_shape(make_body(), np.zeros(4))


@pytest.mark.parametrize("name", ["shape_directions", "joints", "joint_directions", "skin_weights"])
def test_a_body_is_of_finite_numbers(name: str) -> None:
    body = make_body()
    broken = getattr(body, name).copy()
    broken[(0,) * broken.ndim] = np.nan
    with pytest.raises(InputError, match=rf"Body\.{name}: expected finite numbers"):
        replace(body, **{name: broken})


def test_matrices_that_cannot_be_inverted_are_found_without_singular_values() -> None:
    rng = np.random.default_rng(6)
    matrices = rng.standard_normal((400, 3, 3))
    matrices[::2, 2] = matrices[::2, 0] + 10.0 ** rng.uniform(-7, -1, (200, 1)) * matrices[::2, 2]
    matrices[0] = 0
    bad = np.linalg.cond(matrices) > SINGULAR_CONDITION
    assert 20 < bad.sum() < 180
    np.testing.assert_array_equal(_near_singular(matrices), bad)
