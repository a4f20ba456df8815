"""The built-in body with few vertices, which moves as the whole one does, and clips on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.body.anny import load_anny
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.body.smpl import SMPL_JOINTS
from capture4d.motions.motion_files import read_motion
from capture4d.motions.retargeting import SMPL_TREE
from capture4d.types import Body, Mesh, PoseSequence

Placed = Callable[..., np.ndarray]


@pytest.fixture(scope="session")
def light_body() -> Body:
    body = load_anny()
    kept = np.argsort(body.template.vertices[:, 1])[:: len(body.template.vertices) // 200]
    faces = np.arange(len(kept) // 3 * 3, dtype=np.int32).reshape(-1, 3)
    return replace(
        body,
        template=Mesh(body.template.vertices[kept], faces),
        shape_directions=body.shape_directions[:, kept],
        skin_weights=body.skin_weights[kept],
        regions=None,
    )


@pytest.fixture(scope="session")
def smpl_like() -> Body:
    """SMPL's 24 joints on a generated cloud of faces."""
    parents = [*(parent for parent, _ in SMPL_TREE.values()), 20, 21]
    offsets = [*(offset for _, offset in SMPL_TREE.values()), (0.08, 0, 0), (-0.08, 0, 0)]
    joints = np.zeros((24, 3))
    for joint, (parent, offset) in enumerate(zip(parents, offsets, strict=True)):
        joints[joint] = np.array(offset) + (joints[parent] if parent >= 0 else 0)
    rng = np.random.default_rng(0)
    vertices = np.repeat(joints, 3, axis=0) + 0.03 * rng.standard_normal((72, 3))
    return Body(
        template=Mesh(vertices.astype(np.float32), np.arange(72, dtype=np.int32).reshape(-1, 3)),
        shape_directions=(0.01 * rng.standard_normal((10, 72, 3))).astype(np.float32),
        joints=joints.astype(np.float32),
        joint_directions=(0.01 * rng.standard_normal((10, 24, 3))).astype(np.float32),
        joint_names=tuple(SMPL_JOINTS),
        parents=np.array(parents, np.int32),
        skin_weights=np.repeat(np.eye(24, dtype=np.float32), 3, axis=0),
    )


@pytest.fixture
def placed(light_body: Body, tmp_path: Path) -> Placed:
    """A BVH's text -> where the body's joints are, (T, J, 3)."""

    def places(text: str, **how) -> np.ndarray:
        (tmp_path / "clip.bvh").write_text(text)
        return joints_of(light_body, read_motion(tmp_path / "clip.bvh", light_body, **how))

    return places


def joints_of(body: Body, poses: PoseSequence) -> np.ndarray:
    shaped = with_shape(body, poses.shape)
    return np.stack([pose_frame(shaped, poses, t).joint_centres() for t in range(len(poses.frame_ids))])
