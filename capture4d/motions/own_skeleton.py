"""BVH files of a body's own skeleton: taken joint by joint, with the shape that the bones' lengths show.

BVH has no unit, and tools that such files pass through scale them, turn them, or hang them on a joint of their own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from capture4d.body.skinning import with_shape
from capture4d.errors import InputError
from capture4d.motions.anatomy import bare
from capture4d.motions.bvh import Bvh
from capture4d.motions.clips import MotionWords, understood
from capture4d.motions.retargeting import relative
from capture4d.types import Body, PoseSequence

__all__ = ["poses_of_own_skeleton"]

_UNITS = {"centimetres": 0.01, "metres": 1.0, "millimetres": 0.001, "inches": 0.0254, "decimetres": 0.1, "feet": 0.3048}
"""Metres in each; written are centimetres."""
_SHAPE_MOST = 6.0
"""Standard deviations: nobody is further from the mean."""
_APART_M = 0.03
"""Root mean square between the file's bones and those of the nearest shape: beyond it, it is another skeleton."""


def poses_of_own_skeleton(
    bvh: Bvh, body: Body, words: MotionWords, fps: float
) -> tuple[PoseSequence, list[str]] | None:
    """Poses of a file that has all joints of the body, and what was found of it; None if it is another skeleton.

    Raises:
        InputError: it is this skeleton, but in no unit that makes a person of it.
    """
    order = _order(bvh, body)
    if order is None or words.names != "auto" or words.given is not None:
        return None
    if _untouched(bvh, body):
        words = replace(words, up=words.up or "y")
    clip, notes = understood(bvh, words)
    if clip.anatomy.pelvis != order[0]:
        return None
    parents = np.maximum(body.parents, 0)
    bones = (clip.rest[order] - clip.rest[order][parents])[1:]
    fits = {unit: _shape_of_bones(body, bones * metres) for unit, metres in _UNITS.items()}
    unit, (shape, apart) = min(fits.items(), key=lambda fit: (not _human(*fit[1]), _furthest(fit[1][0])))
    if not _human(shape, apart):
        if _alike(body, bones):
            raise InputError(f"expected this body's skeleton in {', '.join(_UNITS)}, found a leg of {clip.leg:.3g}; "
                             "scale it to one of them", where=bvh.path)  # fmt: skip
        return None
    translations = clip.pelvis * _UNITS[unit] - with_shape(body, shape).joints[0]
    poses = PoseSequence(
        relative(clip.world[:, order], body.parents).astype(np.float32),
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


def _shape_of_bones(body: Body, bones: np.ndarray) -> tuple[np.ndarray, float]:
    """The shape whose bones are nearest to the given ones, (S,) float32, and how far these are from its, metres."""
    parents = body.parents[1:]
    mean = (body.joints[1:] - body.joints[parents]).astype(np.float64)
    directions = (body.joint_directions[:, 1:] - body.joint_directions[:, parents]).astype(np.float64)
    columns = directions.reshape(len(directions), -1).T
    ridge = 1e-9 * np.eye(columns.shape[1])
    error = (bones - mean).ravel()
    shape = np.linalg.solve(columns.T @ columns + ridge, columns.T @ error)
    return shape.astype(np.float32), float(np.sqrt(np.square(error - columns @ shape).sum() / len(bones)))


def _human(shape: np.ndarray, apart: float) -> bool:
    return _furthest(shape) <= _SHAPE_MOST and apart <= _APART_M


def _furthest(shape: np.ndarray) -> float:
    return float(np.abs(shape).max(initial=0))


def _alike(body: Body, bones: np.ndarray) -> bool:
    """Whether bones are the mean body's but for their scale."""
    mean = (body.joints[1:] - body.joints[body.parents[1:]]).astype(np.float64)
    scaled = bones * (bones * mean).sum() / max(np.square(bones).sum(), 1e-30)
    return float(np.sqrt(np.square(scaled - mean).sum() / len(mean))) <= _APART_M
