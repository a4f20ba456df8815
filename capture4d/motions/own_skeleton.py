"""BVH files of a body's own skeleton: taken joint by joint, with the shape that the bones' lengths show.

BVH has no unit, and tools that such files pass through scale them, turn them, or hang them on a joint of their own.
"""

from __future__ import annotations

import numpy as np

from capture4d.body.skinning import with_shape
from capture4d.motions.anatomy import bare
from capture4d.motions.bvh import Bvh
from capture4d.motions.clips import MotionWords, understood
from capture4d.motions.retargeting import relative
from capture4d.types import Body, PoseSequence

__all__ = ["poses_of_own_skeleton"]

_UNITS = {"centimetres": 0.01, "metres": 1.0, "millimetres": 0.001, "inches": 0.0254, "decimetres": 0.1, "feet": 0.3048}
"""Metres in each; written are centimetres."""
_EXACT_M = 0.002
"""Root mean square between the file's bones and those of a shape, of files of this very body, rounded."""
_NEAR_M, _NEAR_SHAPE = 0.03, 4.0
"""The same of a skeleton with other proportions whose joints still turn as ours do, and how far from the mean, standard
deviations, its shape may seem; beyond it is retargeted."""


def poses_of_own_skeleton(
    bvh: Bvh, body: Body, words: MotionWords, fps: float
) -> tuple[PoseSequence, list[str]] | None:
    """Poses of a file that has all joints of the body, and what was found of it; None if it is another skeleton."""
    order = _order(bvh, body)
    if order is None or words.names != "auto" or words.given is not None:
        return None
    if _untouched(bvh, body) and not words.up and not words.facing:
        world, rest = bvh.world_rotations(), bvh.rest_places()
        root, notes = bvh.translations[:, 0], [*bvh.notes, "Y up, Z forward"]
    else:
        clip, notes = understood(bvh, words)
        world, rest, root = clip.world, clip.rest, clip.pelvis
        if clip.anatomy.pelvis != order[0]:
            return None
    parents = np.maximum(body.parents, 0)
    fitted = _fitted(body, (rest[order] - rest[order][parents])[1:])
    if fitted is None:
        return None
    metres, shape = fitted
    unit = next((name for name, known in _UNITS.items() if known == metres), f"units of {1e3 * metres:.4g} mm")
    notes = [*notes, f"the body's own skeleton, in {unit}"]
    translations = root * metres - with_shape(body, shape).joints[0]
    poses = PoseSequence(
        relative(world[:, order], body.parents).astype(np.float32),
        translations.astype(np.float32),
        shape,
        np.arange(len(translations), dtype=np.int32),
        fps,
        body.joint_names,
    )
    return poses, notes


def _order(bvh: Bvh, body: Body) -> list[int] | None:
    """Where each joint of the body stands in the file; None if one is missing or there twice."""
    found: dict[str, list[int]] = {}
    for joint, name in enumerate(bvh.joint_names):
        found.setdefault(bare(name).lower(), []).append(joint)
    places = [found.get(name.lower(), []) for name in body.joint_names]
    return [joint for joint, *_ in places] if all(len(place) == 1 for place in places) else None


def _untouched(bvh: Bvh, body: Body) -> bool:
    """Whether the joints are the body's and no others, and lie at rest as ours do: then its world is ours too."""
    if len(bvh.joint_names) != len(body.joint_names):
        return False
    order = _order(bvh, body)
    assert order is not None
    rest, ours = bvh.rest_places()[order], body.joints - body.joints[0]
    return bool((rest * ours).sum() > 0.95 * np.linalg.norm(rest) * np.linalg.norm(ours))


def _fitted(body: Body, bones: np.ndarray) -> tuple[float, np.ndarray] | None:
    """Metres in the file's unit, and the shape that its bones show; None if they are nobody's in our shape space."""
    fits = [(*_shape_of_bones(body, bones * metres), metres) for metres in _UNITS.values()]
    shape, apart, metres = min(fits, key=lambda fit: fit[1])
    if apart < _EXACT_M:
        return metres, shape
    shape, apart, own_metres = _shape_and_scale(body, bones)
    if apart < _EXACT_M and own_metres > 0:
        return own_metres, shape
    shape, apart, metres = min(fits, key=lambda fit: np.abs(fit[0]).max(initial=0))
    return (metres, shape) if apart < _NEAR_M and np.abs(shape).max(initial=0) < _NEAR_SHAPE else None


def _shape_of_bones(body: Body, bones: np.ndarray) -> tuple[np.ndarray, float]:
    """The shape whose bones are nearest to the given ones, (S,) float32, and how far these are from its, metres."""
    mean, columns = _bone_space(body)
    error = bones.ravel() - mean
    shape = np.linalg.solve(columns.T @ columns + 1e-9 * np.eye(columns.shape[1]), columns.T @ error)
    return shape.astype(np.float32), _apart(error - columns @ shape)


def _shape_and_scale(body: Body, bones: np.ndarray) -> tuple[np.ndarray, float, float]:
    """The same with the scale that fits best: bones * metres = mean + columns @ shape is linear in both."""
    mean, columns = _bone_space(body)
    size = max(float(np.linalg.norm(bones)), 1e-30)
    system = np.column_stack([bones.ravel() / size, -columns])
    solved = np.linalg.solve(system.T @ system + 1e-9 * np.eye(system.shape[1]), system.T @ mean)
    return solved[1:].astype(np.float32), _apart(system @ solved - mean), float(solved[0] / size)


def _bone_space(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Bones of the mean shape, and what a standard deviation of each component adds to them: (3(J - 1),), (.., S)."""
    parents = body.parents[1:]
    mean = (body.joints[1:] - body.joints[parents]).astype(np.float64)
    directions = (body.joint_directions[:, 1:] - body.joint_directions[:, parents]).astype(np.float64)
    return mean.ravel(), directions.reshape(len(directions), -1).T


def _apart(error: np.ndarray) -> float:
    return float(np.sqrt(3 * np.square(error).mean()))
