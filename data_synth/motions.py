"""Motions for the synthetic subject: scripted clips, sampled poses, and BVH files.

Every motion is a `PoseSequence` at the wanted frame rate for one person, standing on the floor y = 0.

References: pose sampling and pruning follow the appendix of Jin et al., A Pixel-Based Framework for Data-Driven
Clothing (SCA 2020): half-normal mixtures along the spine, uniform directions for the arms, probes on the arms.
"""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from capture4d.body.skinning import ShapedBody, with_pose
from capture4d.errors import InputError
from capture4d.motions.bvh import read_bvh
from capture4d.motions.clips import understood
from capture4d.motions.motion_files import rate_note, same_rate, told
from capture4d.motions.retargeting import pose_sequence, retarget
from capture4d.types import PoseSequence
from data_synth.config import ClipName, MotionConfig

__all__ = ["make_motion", "random_pose", "sample_poses", "scripted_clip"]

Keyframe = tuple[float, dict[str, float]]
"""Time in seconds, and controls in degrees, or in centimetres where their names say so; a control that is not named
keeps its last value, 0 at the start."""

PLANTED = "ankle_left"
"""A clip that moves the ankles keeps its feet on the floor: knees bend, and the person sinks."""
HANGING, OVERHEAD = -25.0, 116.0
"""Lateral arm raise from the rest pose, whose arms point about 49 degrees below the horizontal. Hanging arms keep 16
degrees from the vertical, as subjects are asked to: 3 degrees less, and the sides of a shirt are out of sight."""


def _mirrored(controls: dict[str, float]) -> dict[str, float]:
    """The same with left and right exchanged, of limbs alone."""
    swap = {"left": "right", "right": "left"}
    parts = {name: name.split("_") for name in controls}
    return {"_".join(swap.get(part, part) for part in parts[name]): value for name, value in controls.items()}


def _walk(steps: int) -> list[Keyframe]:
    """Steps of half a second, there and back again; arms swing against the legs."""
    frames: list[Keyframe] = [(0.0, {"raise_both": HANGING})]
    for step in range(steps):
        side = 1 if step % 2 == 0 else -1
        frames.append((0.5 * step + 0.25, {"lift_cm": 1.5}))
        swing = {"leg_left": 22.0 * side, "leg_right": -22.0 * side, "knee_left": 6.0, "knee_right": 6.0}
        arms = {"forward_left": -24.0 * side, "forward_right": 24.0 * side, "twist": 7.0 * side}
        away = 12.0 * (step + 1 if step < steps / 2 else steps - step - 1)
        frames.append((0.5 * step + 0.5, {**swing, **arms, "lift_cm": -2.0, "travel_cm": away}))
    return frames


_STANDING = {
    "raise_both": 12.0, "spread_both": 5.0, "tilt": 0.0, "bend": 0.0, "leg_both": 0.0, "knee_both": 0.0,
    "ankle_both": 0.0, "forward_both": 0.0,
}  # fmt: skip
_SQUATTING = {
    "tilt": 26.0, "bend": 16.0, "leg_both": 88.0, "knee_both": 88.0, "ankle_both": 26.0, "spread_both": 14.0,
    "forward_both": 70.0,
}  # fmt: skip
_LUNGING = {
    "leg_left": 62.0, "knee_left": 68.0, "ankle_left": 6.0, "leg_right": -8.0, "knee_right": 62.0, "ankle_right": 25.0,
    "raise_both": 18.0, "bend": 6.0,
}  # fmt: skip
_SQUAT: list[Keyframe] = [(0.0, _STANDING), (1.0, _SQUATTING), (1.2, {}), (2.2, _STANDING)]
_LUNGE: list[Keyframe] = [
    (0.0, _STANDING),
    (0.9, _LUNGING),
    (1.7, _STANDING),
    (2.6, _mirrored(_LUNGING)),
    (3.4, _STANDING),
]
_SIT: list[Keyframe] = [
    (0.0, _STANDING),
    (0.7, {"tilt": 24.0, "bend": 14.0, "leg_both": 66.0, "knee_both": 62.0, "ankle_both": 20.0, "forward_both": 30.0}),
    (1.3, {"tilt": 2.0, "bend": 2.0, "leg_both": 86.0, "knee_both": 84.0, "ankle_both": 0.0, "forward_both": 20.0}),
    (1.6, {}),
    (2.1, {"tilt": 24.0, "bend": 14.0, "leg_both": 66.0, "knee_both": 62.0, "ankle_both": 20.0, "forward_both": 30.0}),
    (2.8, _STANDING),
]
_REACH_DOWN: list[Keyframe] = [
    (0.0, _STANDING),
    (1.1, {"tilt": 62.0, "bend": 46.0, "leg_both": 84.0, "knee_both": 36.0, "ankle_both": 14.0, "forward_both": 82.0}),
    (1.3, {}),
    (2.3, _STANDING),
]
_RANGE_OF_LEGS: list[Keyframe] = [
    (0.0, _STANDING),
    (0.6, {"leg_left": 48.0, "knee_left": 62.0, "raise_both": 20.0}),
    (1.1, _mirrored(_LUNGING)),
    (1.6, {**_STANDING, "side": 10.0}),
    (2.3, {**_SQUATTING, "side": 0.0}),
    (2.45, {}),
    (3.1, _STANDING),
]

CLIPS: dict[str, list[Keyframe]] = {
    "range-of-motion": [
        (0.0, {"raise_both": 0}),
        (0.35, {"raise_both": HANGING}),
        (1.25, {"raise_both": OVERHEAD}),
        (1.5, {"raise_both": OVERHEAD, "twist": 12}),
        (2.0, {"raise_both": 30, "twist": -22}),
        (2.6, {"raise_both": HANGING, "twist": 18}),
        (3.2, {"raise_both": 0, "twist": 0}),
    ],
    "twist": [
        (0.0, {"raise_both": -20}),
        (0.6, {"twist": 34, "elbow_both": 40}),
        (1.4, {"twist": -34}),
        (2.2, {"twist": 25, "bend": 12}),
        (3.0, {"twist": 0, "bend": 0, "elbow_both": 0}),
    ],
    "reach": [
        (0.0, {"raise_both": -25}),
        (0.7, {"forward_left": 70, "elbow_left": 10, "twist": -15}),
        (1.5, {"forward_left": 0, "forward_right": 75, "raise_right": 10, "twist": 18}),
        (2.3, {"forward_left": 80, "forward_right": 80, "twist": 0, "bend": 15}),
        (3.0, {"forward_left": 0, "forward_right": 0, "raise_right": -25, "bend": 0}),
    ],
    "side-bend": [
        (0.0, {"raise_both": -28}),
        (0.7, {"side": 18, "raise_left": 95}),
        (1.5, {"side": -18, "raise_left": -28, "raise_right": 95}),
        (2.3, {"side": 0, "raise_both": 60, "bend": 18}),
        (3.0, {"raise_both": -28, "bend": 0}),
    ],
    "walk": _walk(6),
    "lunge": _LUNGE,
    "squat": _SQUAT,
    "sit": _SIT,
    "reach-down": _REACH_DOWN,
    "range-of-legs": _RANGE_OF_LEGS,
    "hop": [
        (0.0, {"raise_both": -22}),
        (0.4, {"leg_both": 28, "knee_both": 56, "lift_cm": -10, "bend": 14, "forward_both": -20}),
        (0.6, {"leg_both": 0, "knee_both": 4, "lift_cm": 4, "bend": 0, "forward_both": 55}),
        (0.75, {"lift_cm": 13}),
        (0.95, {"lift_cm": 0}),
        (1.1, {"leg_both": 22, "knee_both": 44, "lift_cm": -6, "bend": 10, "forward_both": 0}),
        (1.5, {"leg_both": 26, "knee_both": 52, "lift_cm": -8, "raise_both": -10}),
        (1.7, {"leg_both": 0, "knee_both": 4, "lift_cm": 5, "bend": 0, "raise_both": 70}),
        (1.85, {"lift_cm": 14}),
        (2.05, {"lift_cm": 0, "raise_both": 20}),
        (2.25, {"leg_both": 15, "knee_both": 30, "lift_cm": -3}),
        (2.7, {"leg_both": 0, "knee_both": 0, "lift_cm": 0, "raise_both": -22}),
    ],
    "arm-circles": [
        (0.0, {"raise_both": -20}),
        (0.5, {"forward_both": 85}),
        (1.0, {"forward_both": 20, "raise_both": 95}),
        (1.4, {"forward_both": -20, "raise_both": 35}),
        (1.8, {"forward_both": 0, "raise_both": -20}),
        (2.2, {"raise_left": 60, "forward_right": 70, "elbow_right": 50}),
        (2.6, {"raise_left": -20, "forward_right": 0, "elbow_right": 0}),
    ],
    "reach-twist": [
        (0.0, {"raise_both": -22}),
        (0.6, {"twist": 24, "forward_right": 60, "raise_right": 15}),
        (1.2, {"twist": -10, "forward_right": 10, "raise_right": 60, "bend": 8}),
        (1.8, {"twist": -26, "forward_left": 65, "raise_right": -22, "side": -8}),
        (2.5, {"twist": 0, "forward_left": 0, "bend": 0, "side": 0, "raise_both": -22}),
    ],
}


def make_motion(
    shaped: ShapedBody, config: MotionConfig, fps: float, frames: int, rng: np.random.Generator
) -> PoseSequence:
    """The clip that a configuration names, cut or held to a number of frames.

    Raises:
        InputError: an unknown clip, an unreadable BVH file, or fewer frames in it than asked for.
    """
    wanted = config.skip_frames + frames
    if config.bvh is not None:
        clip, notes = understood(read_bvh(Path(config.bvh)))
        poses = retarget(shaped, clip, fps, first_frame=config.skip_frames)
        found, own_fps = config.skip_frames + len(poses.frame_ids), round(1 / clip.frame_time_s, 3)
        if len(poses.frame_ids) < frames:
            raise InputError(f"expected at least {wanted} frames at {fps:g} fps, found {found}", where=config.bvh)
        if not same_rate(own_fps, fps):
            notes = [*notes, rate_note(own_fps, len(clip.pelvis), fps, found, whose="the capture's")]
        for note in notes:
            told(Path(config.bvh))(note)
        return _cut(poses, 0, frames, reverse=config.reverse)
    if config.clip == "sampled":
        poses = sample_poses(shaped, fps, wanted, rng)
    elif config.clip in CLIPS:
        poses = scripted_clip(shaped, CLIPS[config.clip], fps, wanted, rng)
    else:
        raise InputError(f"clip: expected one of {', '.join(get_args(ClipName))}, found {config.clip!r}")
    return _cut(poses, config.skip_frames, frames, reverse=config.reverse)


def _cut(poses: PoseSequence, start: int, frames: int, *, reverse: bool) -> PoseSequence:
    kept = np.arange(start, start + frames)[:: -1 if reverse else 1]
    return PoseSequence(
        poses.rotations[kept],
        poses.translations[kept],
        poses.shape,
        poses.frame_ids[:frames],
        poses.fps,
        poses.joint_names,
    )


def scripted_clip(
    shaped: ShapedBody, keyframes: list[Keyframe], fps: float, frames: int, rng: np.random.Generator
) -> PoseSequence:
    """Interpolate controls between keyframes, monotonically; the last keyframe is held.

    A seed varies amplitudes by a few percent, so that two subjects do not move alike.
    """
    times = np.array([time for time, _ in keyframes])
    keyframes = [(time, _both_sides(controls)) for time, controls in keyframes]
    names = sorted({name for _, controls in keyframes for name in controls})
    at = np.minimum(np.arange(frames) / fps, times[-1])
    values = {}
    for name in names:
        levels, last = [], 0.0
        for _, controls in keyframes:
            last = controls.get(name, last)
            levels.append(last)
        amplitude = 1 + 0.04 * rng.standard_normal()
        values[name] = amplitude * PchipInterpolator(times, levels)(at)
    still = np.zeros(frames)
    path = np.stack([still, values.get("lift_cm", still), values.get("travel_cm", still)], axis=1) / 100
    rotations = _control_rotations(shaped, values, frames)
    if PLANTED in values:
        path = path + _planted(shaped, rotations)
    return pose_sequence(shaped, rotations, fps, path)


def _planted(shaped: ShapedBody, rotations: np.ndarray) -> np.ndarray:
    """Where the root goes, (T, 3) metres, that keeps the lowest point on the floor and the feet in place."""
    feet = [shaped.body.joint_names.index(f"foot.{side}") for side in "LR"]
    path = np.zeros((len(rotations), 3))
    for frame, pose in enumerate(rotations):
        body = with_pose(shaped, pose, np.zeros(3))
        path[frame] = -body.joint_centres()[feet].mean(axis=0)
        path[frame, 1] = -body.vertices()[:, 1].min()
    return path - path[0]


def _both_sides(controls: dict[str, float]) -> dict[str, float]:
    """Spell "raise_both" out as "raise_left" and "raise_right"."""
    expanded = {}
    for name, value in controls.items():
        stem = name.removesuffix("_both")
        expanded |= {name: value} if stem == name else {f"{stem}_left": value, f"{stem}_right": value}
    return expanded


def _control_rotations(shaped: ShapedBody, values: dict[str, np.ndarray], frames: int) -> np.ndarray:
    """Joint rotations (T, J, 3, 3) from controls in degrees, (T,) each."""
    names = shaped.body.joint_names
    turned = {name: [Rotation.identity(frames)] for name in names}

    def control(name: str) -> np.ndarray:
        return values.get(name, np.zeros(frames))

    def turn(joint: str, axis: str, degrees: np.ndarray) -> None:
        turned[joint].append(Rotation.from_euler(axis, degrees[:, None], degrees=True))

    for side, word, sign in (("L", "left", 1), ("R", "right", -1)):
        lateral, forward, elbow = (control(f"{name}_{word}") for name in ("raise", "forward", "elbow"))
        girdle = 0.22 * np.maximum(lateral, 0) + 0.05 * np.minimum(lateral, 0)
        turn(f"clavicle.{side}", "z", sign * girdle)
        turn(f"clavicle.{side}", "y", -sign * 0.15 * forward)
        turn(f"upperarm01.{side}", "x", -0.85 * forward)
        turn(f"upperarm01.{side}", "z", sign * (lateral - girdle))
        turn(f"lowerarm01.{side}", "y", -sign * elbow)
        turn(f"upperleg01.{side}", "x", -control(f"leg_{word}"))
        turn(f"lowerleg01.{side}", "x", control(f"knee_{word}"))
        if f"spread_{word}" in values:
            turn(f"upperleg01.{side}", "z", sign * control(f"spread_{word}"))
        if f"ankle_{word}" in values:
            turn(f"foot.{side}", "x", -control(f"ankle_{word}"))
    if "tilt" in values:
        turn("root", "x", control("tilt"))
    for joint in ("spine04", "spine03", "spine02"):
        turn(joint, "y", control("twist") / 3)
        turn(joint, "x", control("bend") / 3)
        turn(joint, "z", control("side") / 3)
    turn("neck01", "y", 0.3 * control("twist"))
    rotations = np.empty((frames, len(names), 3, 3))
    for joint, name in enumerate(names):
        total = turned[name][0]
        for rotation in turned[name][1:]:
            total = rotation * total
        rotations[:, joint] = total.as_matrix()
    return rotations


SPINE_LIMITS = {  # degrees, (negative, positive) about x (bend), y (twist), z (side); clinical ranges split over joints
    "spine04": ((-10, 20), (-12, 12), (-9, 9)),
    "spine03": ((-8, 16), (-12, 12), (-9, 9)),
    "spine02": ((-6, 12), (-10, 10), (-8, 8)),
    "neck01": ((-15, 15), (-25, 25), (-12, 12)),
    "neck02": ((-15, 15), (-25, 25), (-12, 12)),
}
ARM_LIMITS = {"azimuth": (-30, 110), "altitude": (-80, 75), "twist": (-35, 35), "elbow": (0, 110)}
"""Degrees. Azimuth turns the arm forward about the vertical, altitude is above the horizontal."""
POSE_INTERVAL_S = 0.7


def sample_poses(shaped: ShapedBody, fps: float, frames: int, rng: np.random.Generator) -> PoseSequence:
    """Random poses within joint limits, joined by spherical interpolation with rests in between.

    Spine and neck: each axis from a mixture of two half-normals, one per sign, scaled by that sign's limit. Arms:
    azimuth uniform, altitude uniform in its sine, twist uniform. A pose whose arms enter the trunk is drawn again.
    """
    interval = max(1, round(POSE_INTERVAL_S * fps))
    count = int(np.ceil(frames / interval)) + 1
    anchors = [np.repeat(np.eye(3)[None], len(shaped.body.joint_names), axis=0)]
    while len(anchors) < count:
        anchors.append(random_pose(shaped, rng))
    phase = np.arange(frames) / interval
    phase = np.floor(phase) + (lambda x: x * x * (3 - 2 * x))(phase - np.floor(phase))
    stacked = np.stack(anchors)
    rotations = np.stack(
        [
            Slerp(np.arange(count), Rotation.from_matrix(stacked[:, joint]))(phase).as_matrix()
            for joint in range(stacked.shape[1])
        ],
        axis=1,
    )
    return pose_sequence(shaped, rotations, fps)


def random_pose(shaped: ShapedBody, rng: np.random.Generator) -> np.ndarray:
    """One pose, (J, 3, 3), as `sample_poses` draws them: the arms stay out of the trunk."""
    while True:
        candidate = _sample_pose(shaped, rng)
        if not arms_enter_trunk(shaped, candidate):
            return candidate


def _sample_pose(shaped: ShapedBody, rng: np.random.Generator) -> np.ndarray:
    names, joints = shaped.body.joint_names, shaped.joints
    pose = np.repeat(np.eye(3)[None], len(names), axis=0)
    for name, limits in SPINE_LIMITS.items():
        angles = [_half_normal(limit, rng) for limit in limits]
        pose[names.index(name)] = Rotation.from_euler(
            "xzy", [angles[0], angles[2], angles[1]], degrees=True
        ).as_matrix()
    for side, sign in (("L", 1), ("R", -1)):
        shoulder, elbow = names.index(f"upperarm01.{side}"), names.index(f"lowerarm01.{side}")
        azimuth = np.radians(rng.uniform(*ARM_LIMITS["azimuth"]))
        low, high = np.sin(np.radians(ARM_LIMITS["altitude"]))
        altitude = np.arcsin(rng.uniform(low, high))
        wanted = np.array(
            [sign * np.cos(altitude) * np.cos(azimuth), np.sin(altitude), np.cos(altitude) * np.sin(azimuth)]
        )
        at_rest = joints[elbow] - joints[shoulder]
        swing = Rotation.align_vectors(wanted[None], at_rest[None] / np.linalg.norm(at_rest))[0]
        twist = Rotation.from_rotvec(wanted * np.radians(rng.uniform(*ARM_LIMITS["twist"])))
        pose[shoulder] = (twist * swing).as_matrix()
        pose[elbow] = Rotation.from_euler("y", -sign * rng.uniform(*ARM_LIMITS["elbow"]), degrees=True).as_matrix()
    return pose


def _half_normal(limit: tuple[float, float], rng: np.random.Generator) -> float:
    """A half-normal of either sign whose limit lies at two standard deviations; cut there."""
    side = limit[rng.integers(2)]
    return side * min(abs(rng.standard_normal()) / 2, 1.0)


def arms_enter_trunk(shaped: ShapedBody, rotations: np.ndarray, probes: int = 106) -> bool:
    """Whether probe points on the forearms and hands lie inside the trunk, which is closed by its convex hull."""
    from scipy.spatial import Delaunay

    names = shaped.body.joint_names
    surface = with_pose(shaped, rotations, np.zeros(3)).vertices()
    dominant = np.array(names)[np.argmax(shaped.body.skin_weights, axis=1)]
    trunk = surface[np.char.startswith(dominant, "spine") | np.char.startswith(dominant, "root")]
    arms = np.flatnonzero(np.char.startswith(dominant, "lowerarm") | np.char.startswith(dominant, "wrist"))
    chosen = arms[np.linspace(0, len(arms) - 1, probes).astype(int)]
    return bool((Delaunay(trunk[::4]).find_simplex(surface[chosen]) >= 0).any())
