"""Bodies that are wrong on purpose: by as much as is said, and nowhere else."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.wrong_bodies import thicker, wrongly_skinned
from capture4d.body.anny import load_anny
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.types import Body, PoseSequence


@pytest.fixture(scope="module")
def body() -> Body:
    return load_anny()


def arm_raised(body: Body) -> PoseSequence:
    rotations = np.tile(np.eye(3, dtype=np.float32), (2, len(body.joint_names), 1, 1))
    rotations[1, body.joint_names.index("upperarm01.L")] = Rotation.from_rotvec([0, 0, 0.9]).as_matrix()
    return PoseSequence(
        rotations, np.zeros((2, 3), np.float32), np.zeros(1, np.float32), np.arange(2, dtype=np.int32), 30.0,
        body.joint_names,
    )  # fmt: skip


def test_a_thicker_body_has_the_same_joints(body: Body) -> None:
    wrong = thicker(body, 2.0)
    moved = wrong.template.vertices - body.template.vertices
    np.testing.assert_allclose(moved, 2 * body.shape_directions[1], atol=1e-6)
    np.testing.assert_array_equal(wrong.joints, body.joints)
    np.testing.assert_array_equal(thicker(body, 0.0).template.vertices, body.template.vertices)


@pytest.mark.parametrize("both", [False, True])
def test_paint_moves_the_skin_as_far_as_it_should(body: Body, both: bool) -> None:
    poses = arm_raised(body)
    wrong = wrongly_skinned(body, poses, 0.05, both=both)
    np.testing.assert_allclose(wrong.skin_weights.sum(axis=1), 1, atol=1e-5)
    true, painted = (pose_frame(with_shape(each, poses.shape), poses, 1).vertices() for each in (body, wrong))
    moved = np.linalg.norm(painted - true, axis=1)
    assert moved.max() == pytest.approx(0.05, rel=1e-3)
    legs = body.template.vertices[:, 1] < body.joints[0, 1] - 0.2
    assert moved[legs].max() < 1e-3
    at_rest = [pose_frame(with_shape(each, poses.shape), poses, 0).vertices() for each in (body, wrong)]
    np.testing.assert_allclose(at_rest[0], at_rest[1], atol=1e-5)
