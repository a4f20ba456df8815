"""Sliders that pose a person of any skeleton: named after limbs, found by its anatomy, in degrees.

A turn raises a limb to its side, swings it forwards, or turns it about itself. Its axes follow from how the limb lies
in the rest pose, so that an arm of an A-pose and one of a T-pose are raised alike. Parts of the spine share a turn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.motions.anatomy import Anatomy, find_anatomy
from capture4d.types import Body

__all__ = ["PoseSlider", "PoseSliders"]

FORWARDS, UP = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
_ARM = (("raise", -45.0, 60.0), ("forwards", -30.0, 60.0), ("turn", -40.0, 40.0))
_LEG = (("aside", -10.0, 30.0), ("forwards", -25.0, 60.0), ("turn", -25.0, 25.0))
_SPINE = (("bend", -15.0, 35.0), ("lean", -20.0, 20.0), ("turn", -30.0, 30.0))
_BARE_LIMITS = (-40.0, 40.0)
"""Of a skeleton that is not a person's."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseSlider:
    """A turn of one joint, or shared by several."""

    name: str
    joints: tuple[int, ...]
    axis: Float64[np.ndarray, "3"]
    """In the rest pose, unit length."""
    low: float
    high: float
    """Degrees."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseSliders:
    """All sliders of a body."""

    sliders: Sequence[PoseSlider]
    joints: int

    @staticmethod
    def of(body: Body) -> PoseSliders:
        """Those of a person; of any other skeleton three for each joint but the root's parents."""
        try:
            anatomy = find_anatomy(body.joint_names, body.parents)
        except InputError:
            return PoseSliders(_of_joints(body), len(body.joint_names))
        return PoseSliders(_of_person(body, anatomy), len(body.joint_names))

    def rotations(self, degrees: Mapping[str, float]) -> Float32[np.ndarray, "joints 3 3"]:
        """Rotations of all joints, as a `PoseSequence` has them.

        Args:
            degrees: by name of the slider; 0 if left out.
        Raises:
            InputError: there is no such slider.
        """
        known = {slider.name for slider in self.sliders}
        unknown = [name for name in degrees if name not in known]
        if unknown:
            raise InputError(f"pose: expected one of the sliders {', '.join(sorted(known))}, found {unknown[0]!r}")
        turns = np.tile(np.eye(3), (self.joints, 1, 1))
        for slider in self.sliders:
            angle = degrees.get(slider.name, 0.0)
            if angle:
                turn = Rotation.from_rotvec(np.radians(angle / len(slider.joints)) * slider.axis).as_matrix()
                for joint in slider.joints:
                    turns[joint] = turns[joint] @ turn
        return turns.astype(np.float32)


def _of_person(body: Body, anatomy: Anatomy) -> list[PoseSlider]:
    found = [
        PoseSlider("turn around", (anatomy.pelvis,), UP, -180.0, 180.0),
        *_limb("spine", anatomy.spine, UP, _SPINE, side=1.0),
    ]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        shoulder, elbow = anatomy.limbs[f"{side}_shoulder"], anatomy.limbs[f"{side}_elbow"]
        along = _direction(body, shoulder, elbow)
        found += _limb(f"{side} arm", (shoulder,), along, _ARM, side=sign)
        fore = _direction(body, elbow, anatomy.limbs[f"{side}_wrist"])
        found.append(PoseSlider(f"{side} elbow", (elbow,), _swing(fore), 0.0, 110.0))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        hip, knee = anatomy.limbs[f"{side}_hip"], anatomy.limbs[f"{side}_knee"]
        found += _limb(f"{side} leg", (hip,), _direction(body, hip, knee), _LEG, side=sign)
        shin = _direction(body, knee, anatomy.limbs[f"{side}_ankle"])
        found.append(PoseSlider(f"{side} knee", (knee,), -_swing(shin), 0.0, 110.0))
    return found


def _limb(
    name: str, joints: tuple[int, ...], along: np.ndarray, ranges: Sequence[tuple[str, float, float]], *, side: float
) -> list[PoseSlider]:
    """To the side, forwards, and about itself, in the order of `ranges`; the spine forwards first."""
    if not joints:
        return []
    aside, swing = side * FORWARDS, _swing(along)
    axes = (swing, -aside, along) if name == "spine" else (aside, swing, side * along)
    return [
        PoseSlider(f"{name} {word}", joints, np.asarray(axis, np.float64), low, high)
        for (word, low, high), axis in zip(ranges, axes, strict=True)
    ]


def _direction(body: Body, start: int, end: int) -> np.ndarray:
    along = (body.joints[end] - body.joints[start]).astype(np.float64)
    return along / max(float(np.linalg.norm(along)), 1e-9)


def _swing(along: np.ndarray) -> np.ndarray:
    """The axis about which a limb is swung forwards."""
    axis = np.cross(along, FORWARDS)
    length = float(np.linalg.norm(axis))
    return axis / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])


def _of_joints(body: Body) -> list[PoseSlider]:
    low, high = _BARE_LIMITS
    return [
        PoseSlider(f"{name} {axis}", (joint,), np.eye(3)[at], low, high)
        for joint, name in enumerate(body.joint_names)
        for at, axis in enumerate("xyz")
    ]
