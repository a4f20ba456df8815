"""A motion that is understood: whose joint is which part, and upright as our bodies are, Y up and facing +Z at rest.

A file has two frames of reference that need not agree. Its skeleton at rest may stand, lie or face anywhere; its world
may have any axis up. The first is read off the rest pose (hips, shoulders, trunk), the second off the posed skeleton:
where heads are, seen from feet. Letters: T frames, J joints.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.motions.anatomy import NAMINGS, Anatomy, find_anatomy, named_parts
from capture4d.motions.bvh import Bvh
from capture4d.units import METRES

__all__ = ["AXES", "UPRIGHT_DEG", "Axis", "Clip", "MotionWords", "axis_name", "axis_turn", "understood", "world_frame"]

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
AXES: dict[Axis, np.ndarray] = {
    "x": np.array([1.0, 0.0, 0.0]), "y": np.array([0.0, 1.0, 0.0]), "z": np.array([0.0, 0.0, 1.0]),
    "-x": np.array([-1.0, 0.0, 0.0]), "-y": np.array([0.0, -1.0, 0.0]), "-z": np.array([0.0, 0.0, -1.0]),
}  # fmt: skip
_SNAP_DEG = 30.0
"""A trunk leans by less than this at rest; one that is further from all axes was turned."""
UPRIGHT_DEG = 50.0
"""No two bones of a trunk that stands or lies straight are turned more against each other."""
_LEVEL_DEG = 4.0
"""The same of the line through both hips."""
_STANDS = 0.8
"""Length of the mean direction from feet to head along an axis, of a clip whose subject stands or walks."""
_LEG_M = (0.5, 1.3)
"""Thigh and shin of people."""
_UNITS = {**METRES, "dm": 0.1, "ft": 0.3048}
_UNIT_WORDS = {
    "m": "metres",
    "cm": "centimetres",
    "mm": "millimetres",
    "in": "inches",
    "dm": "decimetres",
    "ft": "feet",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionWords:
    """What a user says of a motion file; what is not said is found."""

    names: str = "auto"
    """Whose joint names they are, one of `anatomy.NAMINGS`."""
    given: Mapping[str, str] | None = None
    """Part -> joint, which goes before what is found."""
    up: Axis | None = None
    """Axis of the file's world that points up."""
    facing: Axis | None = None
    """Axis of the file's world that becomes our +Z, where our bodies face at rest."""

    @staticmethod
    def of(names: str, up: Axis | None = None, facing: Axis | None = None) -> MotionWords:
        """As a command line has them: `names` may also be a JSON file, our joint: their joint."""
        if names.lower().endswith(".json"):
            return MotionWords(given=named_parts(Path(names)), up=up, facing=facing)
        return MotionWords(names=names, up=up, facing=facing)

    def __post_init__(self) -> None:
        if self.names != "auto" and self.names not in NAMINGS:
            known = ", ".join(NAMINGS)
            raise InputError(f"--names: expected auto, {known} or a JSON file, found '{self.names}'")
        if self.up and self.facing and self.up[-1] == self.facing[-1]:
            raise InputError(f"--facing: expected an axis across that of --up, found {self.facing} and {self.up}")


@dataclass(frozen=True, slots=True, eq=False)
class Clip:
    """A motion whose world has Y up and whose skeleton stands facing +Z when nothing is turned; its own unit."""

    path: Path
    anatomy: Anatomy
    rest: Float64[np.ndarray, "joints 3"]
    """Joints when nothing is turned."""
    world: Float64[np.ndarray, "frames joints 3 3"]
    """Rotations from that rest pose."""
    pelvis: Float64[np.ndarray, "frames 3"]
    """Where it is."""
    frame_time_s: float

    def bone(self, start: str, end: str) -> np.ndarray:
        """From one joint of a limb to another at rest."""
        limbs = self.anatomy.limbs
        return self.rest[limbs[end]] - self.rest[limbs[start]]

    @property
    def leg(self) -> float:
        """Thigh and shin."""
        left = np.linalg.norm(self.bone("left_hip", "left_knee")) + np.linalg.norm(self.bone("left_knee", "left_ankle"))
        return float(left)


def understood(bvh: Bvh, words: MotionWords | None = None) -> tuple[Clip, list[str]]:
    """A BVH clip, and what was found of it, to be told.

    Raises:
        InputError: parts of a person that are not there, or bones without a length; names the file.
    """
    words = MotionWords() if words is None else words
    try:
        bvh, anatomy = _with_anatomy(bvh, words)
        rest = bvh.rest_places()
        rest_frame, snapped = _rest_frame(rest, anatomy)
        world = bvh.world_rotations()
        places = bvh.world_places(world)
        up, doubt = _world_up(places, anatomy, rest_frame[:, 1] if snapped else None)
        up = AXES[words.up] if words.up else up
        facing = world[0, anatomy.pelvis] @ rest_frame[:, 2]
        axes = world_frame(up, words, rest_frame if snapped else None, facing)
    except InputError as error:
        raise error if error.where is not None else error.at(bvh.path) from None
    clip = Clip(
        bvh.path,
        anatomy,
        rest @ rest_frame,
        axes.T @ world @ rest_frame,
        places[:, anatomy.pelvis] @ axes,
        bvh.frame_time_s,
    )
    if not clip.leg > 0:
        raise InputError("expected legs with a length, found none", where=bvh.path)
    axes_said = f"{axis_name(axes[:, 1])} up, {axis_name(axes[:, 2])} forward"
    found = f"joints named as by {anatomy.title}; {axes_said}; {unit_words(clip.leg)}"
    doubts = [doubt if not words.up else "", _mirror_doubt(clip)]
    return clip, [*bvh.notes, found, *filter(None, doubts)]


def _with_anatomy(bvh: Bvh, words: MotionWords) -> tuple[Bvh, Anatomy]:
    """The parts of the skeleton; of one that lacks some, with a joint where its bones end."""
    try:
        return bvh, find_anatomy(bvh.joint_names, bvh.parents, naming=words.names, given=words.given)
    except InputError:
        whole = bvh.with_ends()
        with contextlib.suppress(InputError):
            return whole, find_anatomy(whole.joint_names, whole.parents, naming=words.names, given=words.given)
        raise


def _mirror_doubt(clip: Clip) -> str:
    """A world of left-handed axes turns feet backwards, as left and right mistaken for each other do."""
    limbs = clip.anatomy.limbs
    feet = [clip.bone(f"{side}_ankle", f"{side}_foot") for side in ("left", "right") if f"{side}_foot" in limbs]
    backwards = len(feet) == 2 and all(foot[2] < -0.5 * np.linalg.norm(foot) for foot in feet)
    return "toes point backwards at rest: left and right may be swapped, or the file mirrored" if backwards else ""


def unit_words(leg: float) -> str:
    """The unit in which a leg of that length is a person's."""
    for name, metres in _UNITS.items():
        if _LEG_M[0] <= leg * metres <= _LEG_M[1]:
            return f"in {_UNIT_WORDS[name]}"
    return f"in a unit of its own (a leg of {leg:.3g})"


def axis_name(direction: np.ndarray) -> str:
    at = int(np.argmax(np.abs(direction)))
    return f"{'-' if direction[at] < 0 else ''}{'XYZ'[at]}"


def _unit(vector: np.ndarray, what: str) -> np.ndarray:
    length = np.linalg.norm(vector)
    if not length > 1e-9:
        raise InputError(f"expected {what} apart at rest, found them in one place")
    return vector / length


def _rest_frame(rest: np.ndarray, anatomy: Anatomy) -> tuple[np.ndarray, bool]:
    """Left, up and forward of the skeleton at rest as columns, (3, 3); whether they are axes."""
    limbs = anatomy.limbs
    hips = (rest[limbs["left_hip"]] + rest[limbs["right_hip"]]) / 2
    up = _unit(_trunk(rest, anatomy, hips), "hips and head")
    left = _unit(rest[limbs["left_hip"]] - rest[limbs["right_hip"]], "left and right hip")
    frame = _square(left, up)
    turns = Rotation.create_group("O").as_matrix()
    nearest = turns[np.argmax(np.einsum("nab,ab->n", turns, frame))].round()
    # Trunks lean at rest, hips are level: a hip line that is off all axes was turned.
    lean = np.degrees(np.arccos(np.clip([up @ nearest[:, 1], left @ nearest[:, 0]], -1, 1)))
    if lean[0] < _SNAP_DEG and lean[1] < _LEVEL_DEG:
        return nearest, True
    feet = (rest[limbs["left_ankle"]] + rest[limbs["right_ankle"]]) / 2
    tall = rest[anatomy.head] - feet
    return (_square(left, tall) if tall @ up > 0.9 * np.linalg.norm(tall) else frame), False


def _trunk(rest: np.ndarray, anatomy: Anatomy, hips: np.ndarray) -> np.ndarray:
    """From hips to neck; where the bones between them have axes of their own, and lie anywhere, the first of them."""
    bones = np.diff(rest[[anatomy.pelvis, *anatomy.spine, *anatomy.neck, anatomy.head]], axis=0)
    lengths = np.linalg.norm(bones, axis=1)
    least = np.cos(np.radians(UPRIGHT_DEG)) * lengths * lengths[0]
    if lengths[0] > 1e-9 and (bones @ bones[0] < least - 1e-12).any():
        return bones[0]
    return rest[anatomy.neck[0] if anatomy.neck else anatomy.head] - hips


def _square(left: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Left as it is, up made square to it, and forward, as columns."""
    up = _unit(up - (up @ left) * left, "hips and head")
    return np.stack([left, up, np.cross(left, up)], axis=1)


def _world_up(places: np.ndarray, anatomy: Anatomy, rest_up: np.ndarray | None) -> tuple[np.ndarray, str]:
    """The axis that points up, and what is doubtful about it."""
    limbs = anatomy.limbs
    feet = places[:, [limbs["left_ankle"], limbs["right_ankle"]]]
    hips = places[:, [limbs["left_hip"], limbs["right_hip"]]].mean(axis=1)
    mean = np.zeros(3)
    for end in (feet.mean(axis=1), hips):
        along = places[:, anatomy.head] - end
        mean += (along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)).mean(axis=0) / 2
    posed = max(AXES.values(), key=lambda axis: float(axis @ mean))
    stands = posed @ mean >= _STANDS
    if rest_up is None:
        return posed, "" if stands else f"{axis_name(posed)} up is doubtful; --up says which it is"
    if (posed == rest_up).all() or (stands and _on_a_floor(feet, hips, posed)):
        return posed, ""
    if stands and (posed == AXES["y"]).all():
        return posed, (f"Y up, as heads stand, though at rest they stand along {axis_name(rest_up)}; "
                       "--up says which it is")  # fmt: skip
    return rest_up, (f"{axis_name(rest_up)} up, from the rest pose, though heads are towards {axis_name(posed)}; "
                     "--up says which it is")  # fmt: skip


def _on_a_floor(feet: np.ndarray, hips: np.ndarray, up: np.ndarray) -> bool:
    """Whether feet stay near a floor through the origin, as they do where an axis is up."""
    leg = np.median(np.linalg.norm(hips[:, None] - feet, axis=2))
    lowest = (feet @ up).min(axis=1)
    return bool(np.abs(lowest).max() < 0.6 * leg and abs(lowest.min()) < 0.35 * leg)


def world_frame(
    up: np.ndarray, words: MotionWords, rest_frame: np.ndarray | None = None, facing: np.ndarray | None = None
) -> np.ndarray:
    """Axes of the file's world that become our X, Y and Z, as columns.

    Where the rest pose stands in that world, and the clip starts turned little from it, it faces +Z with us as well;
    where not, the world is set up by the least turn, and keeps its heading.
    """
    if words.facing is not None:
        forward = AXES[words.facing]
        if abs(forward @ up) > 0.5:
            raise InputError(f"--facing: expected an axis across the one that is up, {axis_name(up)}, "
                             f"found {words.facing}")  # fmt: skip
        return np.stack([np.cross(up, forward), up, forward], axis=1)
    if rest_frame is not None and facing is not None and (rest_frame[:, 1] == up).all():
        level = facing - (facing @ up) * up
        if level @ rest_frame[:, 2] > np.cos(np.radians(45)) * np.linalg.norm(level):
            return rest_frame
    return axis_turn(up)


def axis_turn(up: np.ndarray) -> np.ndarray:
    """The file's axes that become ours if nothing but its up is known: Z up keeps X, as Blender and AMASS have it."""
    forward: dict[str, Axis] = {"Y": "z", "-Y": "-z", "Z": "-y", "-Z": "y", "X": "z", "-X": "z"}
    ahead = AXES[forward[axis_name(up)]]
    return np.stack([np.cross(up, ahead), up, ahead], axis=1)
