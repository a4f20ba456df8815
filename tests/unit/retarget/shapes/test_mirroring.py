"""A mirror: twice is once more the same, left is right, and a garment that has no sides is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.types import Mesh, PoseSequence
from retarget.shapes.mirroring import Mirror, find_mirror, opposite_joints

NAMES = ("root", "arm.L", "arm.R", "spine", "hand.L", "hand.R")


def sheet(shift: float = 0.0) -> Mesh:
    """A rectangle from x = -0.3 to 0.3, whose triangles lean to one side."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 14), np.linspace(0, 0.5, 10))
    vertices = np.stack([x.ravel() + shift, y.ravel(), np.zeros(x.size)], axis=1).astype(np.float32)
    row, column = (index.ravel() for index in np.indices((9, 13)))
    a = row * 14 + column
    faces = np.concatenate([np.stack([a, a + 1, a + 15], 1), np.stack([a, a + 15, a + 14], 1)])
    return Mesh(vertices, faces.astype(np.int32))


def some_poses(seed: int = 0, frames: int = 3) -> PoseSequence:
    rng = np.random.default_rng(seed)
    turned = (
        Rotation.from_rotvec(rng.standard_normal((frames * len(NAMES), 3)))
        .as_matrix()
        .reshape(frames, len(NAMES), 3, 3)
    )
    places = rng.standard_normal((frames, 3)).astype(np.float32)
    ids = np.arange(frames, dtype=np.int32)
    return PoseSequence(turned.astype(np.float32), places, np.zeros(1, np.float32), ids, 60.0, NAMES)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (NAMES, [0, 2, 1, 3, 5, 4]),
        (("pelvis", "left_hip", "right_hip"), [0, 2, 1]),
        (("Hips", "RightArm", "LeftArm"), [0, 2, 1]),
        (("hips", "arm_l", "arm_r", "tail"), [0, 2, 1, 3]),
    ],
)
def test_partners_follow_from_names(names: tuple[str, ...], expected: list[int]) -> None:
    assert opposite_joints(names).tolist() == expected


def test_a_joint_without_a_partner_is_named() -> None:
    with pytest.raises(InputError, match=r"'arm\.R' beside 'arm\.L'"):
        opposite_joints(("root", "arm.L"))


def test_twice_in_the_mirror_is_the_motion_itself_and_what_it_carries_is_reflected() -> None:
    mirror, poses = Mirror.create(sheet(), NAMES), some_poses()
    seen = mirror.poses(poses)
    np.testing.assert_allclose(mirror.poses(seen).rotations, poses.rotations, atol=1e-6)
    # a point held by the left arm is seen held by the right one, at its own mirror image
    point, across = np.array([0.2, 0.1, 0.4]), np.array([-1.0, 1, 1])
    np.testing.assert_allclose(
        seen.rotations[1, 2] @ (point * across), (poses.rotations[1, 1] @ point) * across, atol=1e-6
    )
    np.testing.assert_allclose(seen.translations, poses.translations * across, atol=1e-7)


def test_a_bump_on_the_left_is_seen_on_the_right() -> None:
    mesh = sheet()
    mirror = Mirror.create(mesh, NAMES)
    frame = mesh.vertices[None].copy()
    frame[0, :, 2] += 0.1 * np.exp(-(((mesh.vertices[:, 0] - 0.15) / 0.1) ** 2))
    weights = np.where(mesh.vertices[None, :, 0] > 0, 1.0, 0.25)
    seen, trusted = mirror.frames(frame, weights)
    expected = 0.1 * np.exp(-(((mesh.vertices[:, 0] + 0.15) / 0.1) ** 2))
    np.testing.assert_allclose(seen[0, :, 2], expected, atol=2e-3)
    np.testing.assert_allclose(seen[0, :, :2], mesh.vertices[:, :2], atol=1e-6)
    assert trusted[0, 0] == 1
    assert trusted[0, 13] == 0.25


def test_what_has_no_two_sides_is_refused_or_left_alone() -> None:
    one_sided = sheet(shift=0.5)
    with pytest.raises(InputError, match="alike on both sides"):
        find_mirror(one_sided, NAMES, "on")
    assert find_mirror(one_sided, NAMES, "auto") is None
    assert find_mirror(sheet(), ("root", "spine"), "auto") is None
    assert find_mirror(sheet(), NAMES, "off") is None
    assert find_mirror(sheet(), NAMES, "auto") is not None
