"""Other bodies, other poses, and cloth that is not inside anybody."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import with_pose, with_shape
from capture4d.captures.animations.config import RemovalConfig
from capture4d.captures.animations.frame_files import AnimatedFrame
from capture4d.captures.animations.known_poses import nearest_poses, pose_quaternions
from capture4d.errors import InputError
from capture4d.geometry.mesh import unique_edges
from capture4d.types import BlendshapeModel, Body, Garment, PoseSequence
from retarget.animation.animator import Animator
from retarget.animation.bodies import captured_person, retargeted_mean
from retarget.config import AnimateConfig
from retarget.shapes.pose_normalisation import unpose_frame
from tests.shapes import laid_flat


def model_on(garment: Garment, body: Body, shape: tuple[float, float]) -> BlendshapeModel:
    worn = replace(garment, body_shape=np.array(shape, np.float32))
    count = len(garment.template.vertices)
    mean = (garment.template.vertices * (1 + 0.2 * shape[0], 1, 1 + 0.2 * shape[0])).astype(np.float32)
    return BlendshapeModel(
        worn, mean, np.ones((1, count, 3), np.float32), np.ones(1, np.float32), body.joint_names, 60.0
    )


def test_the_mean_follows_the_body_and_the_captured_shape_counts_once(garment, body) -> None:
    model = model_on(garment, body, (1.0, 0.0))
    captured = captured_person(model, body)
    same = retargeted_mean(model, captured, with_shape(body, np.array([1.0, 0.0])))
    np.testing.assert_allclose(same, model.mean, atol=1e-9)
    # 2 cm thicker at 10 cm radius: the cloth keeps its distance to the skin.
    thick = retargeted_mean(model, captured, with_shape(body, np.array([2.0, 0.0])))
    grown = np.linalg.norm(thick[:, [0, 2]], axis=1) - np.linalg.norm(model.mean[:, [0, 2]], axis=1)
    np.testing.assert_allclose(grown, 0.02, atol=5e-3)  # smoothed along a coarse tube
    printed = retargeted_mean(model, captured, with_shape(body, np.array([2.0, 0.0])), formula="printed")
    twice = np.linalg.norm(printed[:, [0, 2]], axis=1) - np.linalg.norm(model.mean[:, [0, 2]], axis=1)
    np.testing.assert_allclose(twice, 2 * grown, atol=5e-4)
    as_is = retargeted_mean(model, captured, with_shape(body, np.array([2.0, 0.0])), formula="captured")
    np.testing.assert_array_equal(as_is, model.mean)


def test_printed_and_corrected_agree_on_an_average_subject(garment, body) -> None:
    model = model_on(garment, body, (0.0, 0.0))
    person = with_shape(body, np.array([-1.0, 2.0]))
    captured = captured_person(model, body)
    formulas = [retargeted_mean(model, captured, person, formula=name) for name in ("corrected", "printed")]
    np.testing.assert_allclose(formulas[0], formulas[1], atol=1e-6)


def test_other_skeletons_and_meshes_are_refused(garment, body) -> None:
    model = model_on(garment, body, (0.0, 0.0))
    with pytest.raises(InputError, match="expected the 3 joints of the model"):
        captured_person(model, replace(body, joint_names=("a", "b", "c")))
    other = replace(body, template=replace(body.template, faces=body.template.faces[::-1].copy(), uv=None))
    with pytest.raises(InputError, match="the body the garment was learned on"):
        retargeted_mean(model, captured_person(model, body), with_shape(other, np.zeros(2)))


def dented(garment: Garment) -> np.ndarray:
    """The tube with a dent of 6 cm in one side, 3 cm deep in the body at most."""
    vertices = garment.template.vertices.astype(np.float64)
    depth = 0.06 * np.exp(-((vertices - [0, 0.25, 0.13]) ** 2).sum(axis=1) / 0.05**2)
    vertices[:, 2] -= depth
    return vertices


def animated(garment: Garment, body: Body, vertices: np.ndarray, **settings) -> AnimatedFrame:
    """A garment whose mean is `vertices`, on the captured person in the rest pose."""
    model = model_on(garment, body, (0.0, 0.0))
    count = len(body.joint_names)
    still = PoseSequence(
        np.tile(np.eye(3, dtype=np.float32), (1, count, 1, 1)), np.zeros((1, 3), np.float32), np.zeros(2, np.float32),
        np.array([1], np.int32), 60.0, body.joint_names,
    )  # fmt: skip
    animator = Animator(model, captured_person(model, body), vertices, AnimateConfig(**settings))
    return animator.frames(still, np.zeros((1, 1), np.float32), [0])[0]


def test_a_dent_in_the_body_is_taken_out_and_cloth_keeps_its_lengths(garment, body) -> None:
    frame = animated(garment, body, dented(garment))
    removed = frame.removed
    assert removed.before.inside_percent > 0.5
    assert 15 < removed.before.depth_max_mm < 31
    assert removed.after.inside_percent == removed.after.overlap_percent == 0.0
    assert removed.rest_moved_mm < 3.0
    assert not removed.flipped.any()
    assert frame.stretch_p99 < 1.3
    off = animated(garment, body, dented(garment), removal=RemovalConfig(enabled=False), longest=0.0)
    np.testing.assert_allclose(off.vertices, dented(garment), atol=1e-6)
    assert off.removed.after == off.removed.before == removed.before


def cut_longer(garment: Garment, factor: float) -> Garment:
    """The same garment with a pattern, whose lengths are so many times the template's."""
    return replace(
        garment, template=replace(garment.template, uv=factor * laid_flat(garment.template)), pattern_metres=1.0
    )


@pytest.mark.parametrize("longer", [1.0, 1.05])
def test_stretch_is_told_over_the_cloth_of_the_person(garment, body, longer: float) -> None:
    """A person 14 % taller, in a mean that is a tenth too wide: what counts is the pattern, which folds of the template
    have shortened, or the template without one, graded to the person."""
    model = model_on(cut_longer(garment, longer) if longer > 1 else garment, body, (0.0, 0.0))
    tall = with_shape(body, np.array([0.0, 1.4]))
    template = garment.template.vertices + (0, 0.14, 0) * garment.template.vertices
    wide = template * (1.1, 1.0, 1.1)
    motion = PoseSequence(
        np.tile(np.eye(3, dtype=np.float32), (1, 3, 1, 1)), np.zeros((1, 3), np.float32), np.zeros(2, np.float32),
        np.array([1], np.int32), 60.0, body.joint_names,
    )  # fmt: skip
    animator = Animator(model, tall, wide, AnimateConfig())
    frame = animator.frames(motion, np.zeros((1, 1), np.float32), [0])[0]
    edges = unique_edges(garment.template.faces)
    ratios = [np.linalg.norm(wide[i] - wide[j]) / np.linalg.norm(template[i] - template[j]) for i, j in edges]
    assert frame.stretch_p99 == pytest.approx(np.percentile(ratios, 99) / longer, abs=5e-3)
    np.testing.assert_allclose(frame.vertices, wide, atol=1e-6)


def test_distances_of_poses_are_angles(motion) -> None:
    poses = motion(8, 0)
    known = pose_quaternions(poses.rotations, (1, 2))
    distance, nearest = nearest_poses(known, known)
    np.testing.assert_array_equal(nearest, np.arange(8))
    np.testing.assert_allclose(distance, 0, atol=0.05)
    turned = poses.rotations.copy()
    turned[:, 1] = turned[:, 1] @ Rotation.from_euler("x", 30, degrees=True).as_matrix().astype(np.float32)
    away = nearest_poses(pose_quaternions(turned, (1, 2)), known[3:4])[0]
    assert away[3] == pytest.approx(30 / np.sqrt(2), abs=0.05)


def test_unposing_gives_back_the_rest_pose_and_singular_vertices_count_for_nothing(garment, body) -> None:
    rotations = np.tile(np.eye(3), (3, 1, 1))
    rotations[1] = Rotation.from_euler("y", 180, degrees=True).as_matrix()
    transforms = with_pose(with_shape(body, np.zeros(2)), rotations, np.zeros(3)).transforms
    weights = garment.skin_weights.copy()
    weights[:] = (0, 1, 0)
    weights[5] = (0.5, 0.5, 0)
    seen = np.arange(len(weights)) % 2 == 1
    rest, worth = unpose_frame(garment.template.vertices, seen, weights, transforms, unseen_weight=0.1)
    assert worth[5] == 0.0
    np.testing.assert_array_equal(worth[7:], np.where(seen, 1.0, 0.1).astype(np.float32)[7:])
    again = rest[6].astype(float) @ transforms[1, :3, :3].T + transforms[1, :3, 3]
    np.testing.assert_allclose(again, garment.template.vertices[6], atol=1e-6)
