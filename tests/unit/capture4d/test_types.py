"""What the values that pass between stages tell about themselves."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.types import BlendshapeModel, Body, Garment, Mesh, PoseSequence


def motion(frame_ids: list[int]) -> PoseSequence:
    count = len(frame_ids)
    rotations = np.tile(np.eye(3, dtype=np.float32), (count, 1, 1, 1))
    still, shape = np.zeros((count, 3), np.float32), np.zeros(1, np.float32)
    return PoseSequence(rotations, still, shape, np.array(frame_ids, np.int32), 60.0, ("root",))


def test_a_frame_has_one_row_in_a_motion() -> None:
    assert [motion([9, 4, 7]).row(frame_id) for frame_id in (9, 4, 7)] == [0, 1, 2]
    with pytest.raises(InputError, match="expected a pose for frame 5, found frames 9 to 7"):
        motion([9, 4, 7]).row(5)
    with pytest.raises(InputError, match="expected a pose for frame 5, found no frames"):
        motion([]).row(5)


def test_poses_of_some_frames_are_theirs_in_their_order() -> None:
    ids = np.array([3, 5, 9], np.int32)
    rotations = (
        Rotation.from_rotvec(np.arange(18).reshape(-1, 3) / 9).as_matrix().reshape(3, 2, 3, 3).astype(np.float32)
    )
    places = np.arange(9, dtype=np.float32).reshape(3, 3)
    poses = PoseSequence(rotations, places, np.zeros(1, np.float32), ids, 60.0, ("root", "elbow"))
    some = poses.of_frames(np.array([9, 3], np.int32))
    assert some.frame_ids.tolist() == [9, 3]
    np.testing.assert_array_equal(some.rotations, rotations[[2, 0]])
    np.testing.assert_array_equal(some.translations, places[[2, 0]])
    assert (some.fps, some.joint_names) == (poses.fps, poses.joint_names)
    with pytest.raises(InputError, match="found none for frame 4"):
        poses.of_frames(np.array([3, 4], np.int32))


# --- what is no value ------------------------------------------------------------------------------------------------


def rotated(change: Callable[[np.ndarray], np.ndarray]) -> PoseSequence:
    rotations = Rotation.from_rotvec(np.arange(18).reshape(-1, 3) / 9).as_matrix().reshape(3, 2, 3, 3)
    still, ids = np.zeros((3, 3), np.float32), np.arange(3, dtype=np.int32)
    return PoseSequence(change(rotations).astype(np.float32), still, np.zeros(1, np.float32), ids, 60.0, ("a", "b"))


@pytest.mark.parametrize("change", [
    lambda rotations: 1.01 * rotations, lambda rotations: -rotations, lambda rotations: 0 * rotations,
    lambda rotations: rotations @ np.diag([1, -1, 1]), lambda rotations: rotations + [[0, 0.01, 0]] * 3,
])  # fmt: skip
def test_what_scales_mirrors_or_shears_is_no_rotation(change: Callable[[np.ndarray], np.ndarray]) -> None:
    with pytest.raises(InputError, match=r"PoseSequence\.rotations: expected rotations, found .* in row 0, joint 0"):
        rotated(change)


@pytest.mark.parametrize("digits", [3, 4, 6])
def test_rotations_that_somebody_rounded_are_rotations(digits: int) -> None:
    rotated(lambda rotations: rotations.round(digits))
    rotated(lambda rotations: rotations.astype(np.float16))


@pytest.mark.parametrize("fps", [0.0, -60.0, np.nan, np.inf, 1e300, 1e-300, 1e6])
def test_a_rate_that_no_camera_has_is_none(fps: float) -> None:
    with pytest.raises(InputError, match=r"PoseSequence\.fps: expected a frame rate from 0\.01 to 100000, found"):
        replace(motion([1, 2]), fps=fps)


@pytest.mark.parametrize(("ids", "said"), [([3, 3], "duplicates"), ([-1, 4], "found -1")])
def test_frames_are_numbered_once_each_from_0(ids: list[int], said: str) -> None:
    with pytest.raises(InputError, match=rf"PoseSequence\.frame_ids: .*{said}"):
        motion(ids)


SQUARE = Mesh(
    np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
)


@pytest.mark.parametrize(("row", "said"), [([2, -1], "no negative"), ([0.5, 0.4], "sum to 1"), ([np.nan, 1], "NaN")])
def test_weights_share_out_one(row: list[float], said: str) -> None:
    weights = np.tile(np.array([0.25, 0.75], np.float32), (4, 1))
    good = Garment(SQUARE, skin_weights=weights)
    weights = weights.copy()
    weights[2] = row
    with pytest.raises(InputError, match=rf"Garment\.skin_weights: .*{said}"):
        replace(good, skin_weights=weights)


@pytest.mark.parametrize("loop", [[], [0, 1], [0, 1, 2, 0], [0, 1, 4], [0, 1, -1]])
def test_a_loop_names_three_vertices_or_more_once_each(loop: list[int]) -> None:
    with pytest.raises(InputError, match=r"Garment\.loops\['hem'\]"):
        Garment(SQUARE, {"hem": np.array(loop, np.int32)})


@pytest.mark.parametrize(("name", "value"), [
    ("embedding_barycentric", np.full((4, 3), 2 / 3, np.float32)),
    ("embedding_barycentric", np.tile(np.array([3, -1, -1], np.float32), (4, 1))),
    ("embedding_barycentric", None),
    ("embedding_faces", np.array([0, 1, -1, 0], np.int32)),
    ("embedding_faces", None),
])  # fmt: skip
def test_points_on_a_body_lie_in_its_triangles(name: str, value: np.ndarray | None) -> None:
    inside = np.full((4, 3), 1 / 3, np.float32)
    good = Garment(SQUARE, embedding_faces=np.zeros(4, np.int32), embedding_barycentric=inside)
    with pytest.raises(InputError, match=r"Garment\.embedding_"):
        replace(good, **{name: value})


@pytest.mark.parametrize(("name", "value"), [
    ("joint_names", ("a", "a")),
    ("pose_directions", np.zeros((18, 4, 3), np.float32)),
    ("regions", np.array([0, 1, 2, 4], np.uint8)),
    ("parents", np.array([0, -1], np.int32)),
    ("parents", np.array([-1, 1], np.int32)),
])  # fmt: skip
def test_a_body_is_of_one_piece(name: str, value: Any) -> None:
    body = Body(
        SQUARE, np.zeros((1, 4, 3), np.float32), np.zeros((2, 3), np.float32), np.zeros((1, 2, 3), np.float32),
        ("a", "b"), np.array([-1, 0], np.int32), np.full((4, 2), 0.5, np.float32), np.zeros((9, 4, 3), np.float32),
        np.array([0, 1, 2, 3], np.uint8),
    )  # fmt: skip
    with pytest.raises(InputError, match=rf"Body\.{name}: expected"):
        replace(body, **{name: value})


@pytest.mark.parametrize(("name", "value"), [
    ("std", np.array([1, -1], np.float32)), ("joint_names", ("a", "a")), ("fps", np.inf),
])  # fmt: skip
def test_a_model_of_blendshapes_is_of_one_piece(name: str, value: Any) -> None:
    garment = Garment(SQUARE, skin_weights=np.full((4, 2), 0.5, np.float32))
    basis = np.zeros((2, 4, 3), np.float32)
    model = BlendshapeModel(garment, SQUARE.vertices, basis, np.ones(2, np.float32), ("a", "b"), 60.0)
    with pytest.raises(InputError, match=rf"BlendshapeModel\.{name}: expected"):
        replace(model, **{name: value})
