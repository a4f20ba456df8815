"""Values of every kind that a file can hold, small: what the kinds of `benchmarks.reader_kinds` write."""

from __future__ import annotations

import numpy as np

from capture4d.body.smpl import SMPL_JOINTS
from capture4d.motions.retargeting import SMPL_TREE
from capture4d.types import BlendshapeModel, Body, Garment, Mesh, PoseSequence, Rig

__all__ = [
    "BLENDSHAPES",
    "BODY",
    "GARMENT",
    "JOINTS",
    "MESH",
    "NAMES",
    "PARENTS",
    "POSES",
    "RIG",
    "RNG",
    "SMPL",
    "SMPL_BODY",
    "SMPL_POSES",
]

RNG = np.random.default_rng(12)
MESH = Mesh(
    RNG.random((6, 3), np.float32),
    np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5]], np.int32),
    RNG.random((3, 3, 2), np.float32),
)
JOINTS = 24
NAMES = tuple(f"joint{joint}" for joint in range(JOINTS))
PARENTS = np.array([-1, *range(JOINTS - 1)], np.int32)
BODY = Body(
    Mesh(MESH.vertices, MESH.faces),
    shape_directions=(0.01 * RNG.standard_normal((2, 6, 3))).astype(np.float32),
    joints=RNG.random((JOINTS, 3), np.float32),
    joint_directions=(0.01 * RNG.standard_normal((2, JOINTS, 3))).astype(np.float32),
    joint_names=NAMES,
    parents=PARENTS,
    skin_weights=RNG.dirichlet(np.ones(JOINTS), 6).astype(np.float32),
)
POSES = PoseSequence(
    np.tile(np.eye(3, dtype=np.float32), (3, JOINTS, 1, 1)),
    RNG.random((3, 3), np.float32),
    np.zeros(2, np.float32),
    np.arange(3, dtype=np.int32),
    60.0,
    NAMES,
)
GARMENT = Garment(
    MESH,
    {"hem": np.array([0, 1, 2, 3], np.int32)},
    np.array([0, 1, 2, 0, 1, 2], np.int32),
    RNG.dirichlet(np.ones(3), 6).astype(np.float32),
    BODY.skin_weights,
    np.zeros(2, np.float32),
)
RIG = Rig(
    ("left", "right"),
    np.tile(np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]]), (2, 1, 1)),
    np.zeros((2, 5)),
    np.tile(np.eye(4), (2, 1, 1)),
    np.array([[640, 480], [640, 480]], np.int32),
)
SMPL = {
    "v_template": RNG.normal(size=(6, 3)),
    "shapedirs": RNG.normal(size=(6, 3, 4)),
    "posedirs": RNG.normal(size=(6, 3, 9 * (JOINTS - 1))),
    "J_regressor": RNG.dirichlet(np.ones(6), JOINTS),
    "weights": RNG.dirichlet(np.ones(JOINTS), 6),
    "kintree_table": np.stack([np.concatenate([[2**32 - 1], np.arange(JOINTS - 1)]), np.arange(JOINTS)]),
    "f": MESH.faces,
}


BLENDSHAPES = BlendshapeModel(
    GARMENT, MESH.vertices, RNG.random((2, 6, 3), np.float32), np.ones(2, np.float32), NAMES, 60.0, "none"
)


def _smpl_body() -> tuple[Body, PoseSequence]:
    """SMPL's joints, where retargeting looks for them."""
    parents = [*(parent for parent, _ in SMPL_TREE.values()), 20, 21]
    offsets = [*(offset for _, offset in SMPL_TREE.values()), (0.08, 0, 0), (-0.08, 0, 0)]
    joints = np.zeros((JOINTS, 3), np.float32)
    for joint, (parent, offset) in enumerate(zip(parents, offsets, strict=True)):
        joints[joint] = np.array(offset) + (joints[parent] if parent >= 0 else 0)
    body = Body(
        Mesh(MESH.vertices, MESH.faces),
        shape_directions=BODY.shape_directions,
        joints=joints,
        joint_directions=BODY.joint_directions,
        joint_names=tuple(SMPL_JOINTS),
        parents=np.array(parents, np.int32),
        skin_weights=BODY.skin_weights,
    )
    poses = PoseSequence(
        POSES.rotations, POSES.translations, POSES.shape, POSES.frame_ids, POSES.fps, tuple(SMPL_JOINTS)
    )
    return body, poses


SMPL_BODY, SMPL_POSES = _smpl_body()
