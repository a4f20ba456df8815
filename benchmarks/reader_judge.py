"""A judge of values: which rule of SECURITY.md one breaks.

It is written apart from the readers and from `capture4d.types`: it knows only what the numbers mean.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from capture4d.types import BlendshapeModel, Body, Garment, Mesh, PoseSequence, RegisteredSequence, Rig, Scan

__all__ = ["nonsense_in"]

_MAY_BE_NAN = ("residual_m",)
"""Of a vertex that no scan covers."""
ROTATION, WEIGHTS = 5e-3, 2e-3
"""What is forgiven of rotations and of weights."""


def nonsense_in(value: Any) -> str:
    """Which rule a value breaks, and where; empty if none."""
    if isinstance(value, PoseSequence):
        found = _poses(value)
    elif isinstance(value, Body):
        found = _body(value)
    elif isinstance(value, Garment):
        found = _garment(value)
    elif isinstance(value, BlendshapeModel):
        found = "a rate" if not 0.01 <= value.fps <= 1e5 else "a negative deviation" if (value.std < 0).any() else ""
    elif isinstance(value, RegisteredSequence):
        found = _frames(value.frame_ids)
    elif isinstance(value, Mesh):
        found = _mesh(value)
    elif isinstance(value, Scan):
        found = "" if len(value.colours) == len(value.mesh.vertices) else "colours of other vertices"
    elif isinstance(value, Rig):
        found = _rig(value)
    elif isinstance(value, np.memmap):
        found = ""  # whoever maps it reads the part that is needed, and judges that
    elif isinstance(value, float | np.ndarray):
        finite = not np.issubdtype(np.asarray(value).dtype, np.floating) or bool(np.isfinite(value).all())
        found = "" if finite else "a number that is not finite"
    else:
        found = ""
    if found:
        return f"{type(value).__name__}: {found}"
    return next(filter(None, map(nonsense_in, _parts(value))), "")


def _parts(value: Any) -> list[Any]:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value)]
        return [getattr(value, name) for name in names if name not in _MAY_BE_NAN]
    if isinstance(value, Mapping):
        return list(value.values())
    return list(value) if isinstance(value, list | tuple) else []


def _mesh(mesh: Mesh) -> str:
    if not np.isfinite(mesh.vertices).all():
        return "a vertex that is not finite"
    if mesh.faces.size and not ((mesh.faces >= 0) & (mesh.faces < len(mesh.vertices))).all():
        return "a face without a vertex"
    return ""


def _rig(rig: Rig) -> str:
    for K, T in zip(rig.intrinsics, rig.T_camera_world, strict=True):
        turn = T[:3, :3]
        if not np.abs(turn @ turn.T - np.eye(3)).max() < ROTATION or np.linalg.det(turn) < 0:
            return "a rotation that is none"
        if not (K[0, 0] > 0 and K[1, 1] > 0):
            return "a focal length"
    if (rig.image_sizes <= 0).any():
        return "the size of an image"
    return "a camera's name twice" if len(set(rig.names)) < len(rig.names) else ""


def _frames(frame_ids: np.ndarray) -> str:
    numbers = frame_ids.tolist()
    return "frame numbers" if len(set(numbers)) < len(numbers) or min(numbers, default=0) < 0 else ""


def _poses(poses: PoseSequence) -> str:
    for rotation in poses.rotations.reshape(-1, 3, 3).astype(np.float64):
        if not np.abs(rotation @ rotation.T - np.eye(3)).max() < ROTATION or np.linalg.det(rotation) < 0:
            return "a rotation that is none"
    if not 0.01 <= poses.fps <= 1e5:
        return "a rate"
    if not (np.isfinite(poses.translations).all() and np.isfinite(poses.shape).all()):
        return "a number that is not finite"
    return _frames(poses.frame_ids) or ("a joint's name twice" if len(set(poses.joint_names)) < len(poses.joint_names)
                                        else "")  # fmt: skip


def _weights(weights: np.ndarray) -> str:
    wrong = len(weights) and not np.abs(weights.astype(np.float64).sum(axis=1) - 1).max() < WEIGHTS
    return "weights" if wrong or (weights < -WEIGHTS).any() else ""


def _body(body: Body) -> str:
    for joint, parent in enumerate(body.parents.tolist()):
        if parent != -1 if joint == 0 else not 0 <= parent < joint:
            return "a parent"
    if body.pose_directions is not None and len(body.pose_directions) != 9 * (len(body.parents) - 1):
        return "pose directions"
    return _weights(body.skin_weights)


def _garment(garment: Garment) -> str:
    uses: dict[frozenset[int], int] = {}
    for face in garment.template.faces.tolist():
        for edge in zip(face, [*face[1:], face[0]], strict=True):
            uses[frozenset(edge)] = uses.get(frozenset(edge), 0) + 1
    for name, loop in garment.loops.items():
        vertices = loop.tolist()
        closed = all(uses.get(frozenset(edge)) == 1 for edge in pairwise([*vertices, *vertices[:1]]))
        if len(vertices) < 3 or len(set(vertices)) < len(vertices) or not closed:
            return f"a loop {name}"
    if garment.embedding_barycentric is not None:
        sums = garment.embedding_barycentric.sum(axis=1)
        if not (np.abs(sums - 1) < 0.02).all():
            return "a point off its triangle"
    return "" if garment.skin_weights is None else _weights(garment.skin_weights)
