"""Poses for garments to be draped in, drawn within the ranges of the joints and looked through for limbs in each other.

Ten joints move a shirt: two of the spine, two of the neck, and collar bone, shoulder and elbow of either arm. Four of
them move a necktie; spine, hips and knees move trousers and skirts.

References: sampling and pruning as in the appendix of Jin et al., A Pixel-Based Framework for Data-Driven Clothing (SCA
2020): half-normal mixtures along the middle, arms uniform in azimuth, in the sine of the altitude and in twist.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import PosedBody, ShapedBody, with_pose
from capture4d.errors import InputError
from data_synth.drapes.config import Limits, PoseConfig
from data_synth.motions import arms_enter_trunk

__all__ = ["draw_pose", "legs_enter", "moved_joints", "sample_pose"]

SIDES = (("L", 1.0), ("R", -1.0))
MIDDLE = {"spine": ("spine04", "spine02"), "neck": ("neck01", "neck02")}
LEG = ("upperleg01", "lowerleg01", "foot")
LEG_PROBES = 106
"""Points on each leg, as many as Jin et al. have on both arms."""
MOST_DRAWN = 2_000
"""Of which one has to do: ranges in which none does are the user's mistake."""


def draw_pose(
    person: ShapedBody, limbs: tuple[str, ...], config: PoseConfig, rng: np.random.Generator
) -> tuple[np.ndarray, int]:
    """A pose whose limbs stay out of each other, (J, 3, 3), and how many were drawn for it."""
    for drawn in range(1, MOST_DRAWN + 1):
        rotations = sample_pose(person, limbs, config, rng)
        if "arms" in limbs and arms_enter_trunk(person, rotations):
            continue
        if "legs" in limbs and legs_enter(with_pose(person, rotations, np.zeros(3))):
            continue
        return rotations, drawn
    raise InputError(f"poses: expected ranges with poses whose limbs are apart, found none in {MOST_DRAWN}")


def moved_joints(limbs: tuple[str, ...]) -> tuple[str, ...]:
    """The joints that poses of these limbs turn, in the order of their control vector."""
    joints = [name for names in MIDDLE.values() for name in names]
    for limb, chain in (("arms", ("clavicle", "upperarm01", "lowerarm01")), ("legs", ("upperleg01", "lowerleg01"))):
        if limb in limbs:
            joints += [f"{name}.{side}" for side, _ in SIDES for name in chain]
    return tuple(joints)


def sample_pose(person: ShapedBody, limbs: tuple[str, ...], config: PoseConfig, rng: np.random.Generator) -> np.ndarray:
    """Joint rotations (J, 3, 3) within the ranges, limbs through each other or not."""
    names = person.body.joint_names
    rotations = np.repeat(np.eye(3)[None], len(names), axis=0)
    ranges = {
        "spine": (config.spine_bend, config.spine_side, config.spine_turn),
        "neck": (config.neck_bend, config.neck_side, config.neck_turn),
    }
    for part, joints in MIDDLE.items():
        for joint in joints:
            angles = [_angle(limits, config, rng) for limits in ranges[part]]
            rotations[names.index(joint)] = Rotation.from_euler("xzy", angles, degrees=True).as_matrix()
    for side, sign in SIDES:
        if "arms" in limbs:
            _turn_arm(rotations, person, side, sign, config, rng)
        if "legs" in limbs:
            _turn_leg(rotations, person, side, sign, config, rng)
    return rotations


def _angle(limits: Limits, config: PoseConfig, rng: np.random.Generator) -> float:
    """Degrees: uniform, or a half-normal on either side of 0 whose limit lies at two deviations; cut there."""
    if config.distribution == "uniform":
        return rng.uniform(*limits)
    limit = limits[rng.integers(2)]
    return limit * min(abs(rng.standard_normal()) / 2, 1.0)


def _turn_arm(
    rotations: np.ndarray,
    person: ShapedBody,
    side: str,
    sign: float,
    config: PoseConfig,
    rng: np.random.Generator,
) -> None:
    """Collar bone, shoulder and elbow of one side."""
    names, joints = person.body.joint_names, person.joints
    collar, shoulder, elbow = (names.index(f"{name}.{side}") for name in ("clavicle", "upperarm01", "lowerarm01"))
    azimuth = rng.uniform(*config.arm_azimuth)
    altitude = np.degrees(np.arcsin(rng.uniform(*np.sin(np.radians(config.arm_altitude)))))
    twist, bent = rng.uniform(*config.arm_twist), rng.uniform(*config.elbow)
    arm = joints[elbow] - joints[shoulder]
    arm /= np.linalg.norm(arm)
    rise = config.collar_bone_share * max(altitude - np.degrees(np.arcsin(arm[1])), 0.0)
    forward = config.collar_bone_share * azimuth
    girdle = Rotation.from_euler("zy", [sign * rise, -sign * forward], degrees=True)
    flat, turned = np.cos(np.radians(altitude)), np.radians(azimuth)
    wanted = np.array([sign * flat * np.cos(turned), np.sin(np.radians(altitude)), flat * np.sin(turned)])
    swing = Rotation.align_vectors(wanted[None], arm[None])[0]
    rotations[collar] = girdle.as_matrix()
    rotations[shoulder] = (girdle.inv() * Rotation.from_rotvec(wanted * np.radians(twist)) * swing).as_matrix()
    rotations[elbow] = Rotation.from_euler("y", -sign * bent, degrees=True).as_matrix()


def _turn_leg(
    rotations: np.ndarray,
    person: ShapedBody,
    side: str,
    sign: float,
    config: PoseConfig,
    rng: np.random.Generator,
) -> None:
    """Hip and knee of one side."""
    names, joints = person.body.joint_names, person.joints
    hip, knee = names.index(f"upperleg01.{side}"), names.index(f"lowerleg01.{side}")
    thigh = joints[knee] - joints[hip]
    thigh /= np.linalg.norm(thigh)
    flexion, abduction, rotation, bent = (
        _angle(limits, config, rng)
        for limits in (config.hip_flexion, config.hip_abduction, config.hip_rotation, config.knee)
    )
    about_thigh = Rotation.from_rotvec(-sign * np.radians(rotation) * thigh)
    spread = Rotation.from_euler("z", sign * abduction, degrees=True)
    rotations[hip] = (spread * Rotation.from_euler("x", -flexion, degrees=True) * about_thigh).as_matrix()
    rotations[knee] = Rotation.from_euler("x", bent, degrees=True).as_matrix()


def legs_enter(body: PosedBody) -> bool:
    """Whether points of a leg lie inside the other leg or inside the trunk above the hips.

    Thigh, shank and foot, and the trunk, are closed by their convex hulls.
    """
    names = np.array(body.shaped.body.joint_names)
    surface = body.vertices()
    owner = names[np.argmax(body.shaped.body.skin_weights, axis=1)]
    segments = {
        side: [surface[np.char.startswith(owner, name[:8]) & np.char.endswith(owner, f".{side}")] for name in LEG]
        for side, _ in SIDES
    }
    trunk = ConvexHull(surface[np.isin(owner, ("spine03", "spine02", "spine01"))][::3])
    hulls = {side: [ConvexHull(points[::3]) for points in segments[side] if len(points)] for side, _ in SIDES}
    for side, other in (("L", "R"), ("R", "L")):
        thigh, *lower = segments[side]
        hip = body.joint_centres()[body.shaped.body.joint_names.index(f"upperleg01.{side}")]
        away = np.linalg.norm(thigh - hip, axis=1)
        leg = np.concatenate([thigh[away > np.median(away)], *lower])  # thighs touch above, in many people at rest
        probes = leg[np.linspace(0, len(leg) - 1, LEG_PROBES).astype(int)]
        if any(_inside(hull, probes).any() for hull in (*hulls[other], trunk)):
            return True
    return False


def _inside(hull: ConvexHull, points: np.ndarray) -> np.ndarray:
    """(N,) bool: behind all planes of a hull."""
    heights = np.asarray(points @ hull.equations[:, :3].T + hull.equations[:, 3])
    return np.all(heights <= 0, axis=1)
