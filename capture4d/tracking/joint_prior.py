"""What is known about a pose before any scan: which joints turn at all, how far, and that they do not jump.

Everything is a Gaussian on rotation vectors: log(R_j T_j^-1) about a target T_j (the rest pose, or where the motion
leads), and one-sided beyond a joint's limits. Moving R_j to exp(w) R_j moves the rotation vector e by J_l^-1(e) w,
which keeps the normal equations exact far from the target.

References: left Jacobian of SO(3) as in Barfoot, State Estimation for Robotics, eq. 7.77.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from capture4d.types import Body

__all__ = ["JointPrior", "inverse_left_jacobian", "joint_prior", "limit_terms", "pull_terms"]

# (joint name, spread about the rest pose in radians, largest turn in degrees); the first that fits. Names are anny's,
# SMPL's, and what others commonly use. Twist bones in the middle of a limb hardly turn on their own.
KINDS: tuple[tuple[str, float, float], ...] = (
    (r"^(root|pelvis|hips)$", 10.0, 180.0),
    (r"^pelvis\.|shoulder01", 0.03, 15.0),
    (r"(upperleg|lowerleg|upperarm|lowerarm)02", 0.03, 20.0),
    (r"clavicle|collar", 0.2, 50.0),
    (r"upperarm01|shoulder", 0.9, 170.0),
    (r"lowerarm01|elbow|lowerleg01|knee", 0.8, 160.0),
    (r"upperleg01|hip", 0.7, 130.0),
    (r"wrist|ankle|foot", 0.3, 80.0),
    (r"neck03", 0.05, 20.0),
    (r"neck|head", 0.2, 50.0),
    (r"spine", 0.08, 35.0),
)
UNKNOWN_KIND = (0.2, 60.0)
HINGES: tuple[tuple[str, float, float], ...] = (
    (r"lowerarm01|elbow", -12.0, 150.0),
    (r"lowerleg01|knee", -12.0, 150.0),
)
"""Joints that bend one way: smallest and largest bend of the limb, degrees, 0 is straight."""
STRAIGHT_DEG = 5.0
"""A limb bent less than this at rest does not show its hinge; then arms bend to the front and legs to the back."""


@dataclass(frozen=True, slots=True, eq=False)
class JointPrior:
    """Per joint of one body."""

    spread: Float64[np.ndarray, " joints"]
    """Standard deviation about the rest pose, radians."""
    reach: Float64[np.ndarray, " joints"]
    """Largest turn, radians."""
    hinge_axes: Float64[np.ndarray, "joints 3"]
    """Zero for joints that are no hinges."""
    hinge_ranges: Float64[np.ndarray, "joints 2"]
    """Smallest and largest turn about the axis from the rest pose, radians."""


def joint_prior(body: Body) -> JointPrior:
    """Spreads and limits by joint name."""
    names = body.joint_names
    kinds = [next((kind[1:] for kind in KINDS if re.search(kind[0], name)), UNKNOWN_KIND) for name in names]
    spread, reach = np.array(kinds).T
    spread[0], reach[0] = KINDS[0][1], KINDS[0][2]
    axes, ranges = np.zeros((len(names), 3)), np.tile([-np.pi, np.pi], (len(names), 1))
    for joint, name in enumerate(names):
        for pattern, least, most in HINGES:
            if re.search(pattern, name):
                found = _hinge(body, joint)
                if found is not None:
                    axes[joint], at_rest = found
                    ranges[joint] = np.radians([least, most]) - at_rest
    return JointPrior(spread, np.radians(reach), axes, ranges)


def _hinge(body: Body, joint: int) -> tuple[np.ndarray, float] | None:
    """Unit axis about which the limb bends further, and its bend at rest in radians."""
    below = _end_of_limb(body, joint)
    above = body.parents[joint]
    while above > 0 and re.search(r"02", body.joint_names[above]):
        above = body.parents[above]
    if below is None or above < 0:
        return None
    upper = body.joints[joint].astype(np.float64) - body.joints[above]
    lower = body.joints[below].astype(np.float64) - body.joints[joint]
    upper, lower = upper / np.linalg.norm(upper), lower / np.linalg.norm(lower)
    across = np.cross(upper, lower)
    bend = float(np.arctan2(np.linalg.norm(across), upper @ lower))
    is_leg = bool(re.search(r"leg|knee", body.joint_names[joint]))
    if is_leg or bend < np.radians(STRAIGHT_DEG):
        across = np.cross(upper, [0.0, 0.0, -1.0 if is_leg else 1.0])
        bend = 0.0
    return across / np.linalg.norm(across), bend


def _end_of_limb(body: Body, joint: int) -> int | None:
    below = joint
    while True:
        children = np.flatnonzero(body.parents == below)
        if not len(children):
            return None if below == joint else below
        below = int(children[0])
        if not re.search(r"02", body.joint_names[below]):
            return below


def inverse_left_jacobian(vectors: Float64[np.ndarray, "joints 3"]) -> Float64[np.ndarray, "joints 3 3"]:
    """J with log(exp(w) exp(v)) = v + J w to first order."""
    angle = np.linalg.norm(vectors, axis=1)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    # the cotangent form stays finite up to a whole turn, the tangent's half angle does not
    factor = np.where(small, 1 / 12, 1 / safe**2 - np.cos(safe / 2) / (2 * safe * np.sin(safe / 2)))
    cross = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross[:, 1, 0], cross[:, 2, 0], cross[:, 2, 1] = z, -y, x
    return np.eye(3) - cross / 2 + factor[:, None, None] * (cross @ cross)


def pull_terms(
    rotations: Float64[np.ndarray, "joints 3 3"],
    targets: Float64[np.ndarray, "joints 3 3"],
    spread: Float64[np.ndarray, " joints"],
) -> tuple[Float64[np.ndarray, "joints 3 3"], Float64[np.ndarray, "joints 3"]]:
    """Normal equations, one block a joint, of |log(R T^-1)|^2 / spread^2: H and the descent direction."""
    error = Rotation.from_matrix(rotations @ np.swapaxes(targets, 1, 2)).as_rotvec()
    jacobian = inverse_left_jacobian(error)
    weight = 1 / spread**2
    hessian = np.einsum("jba,jbc->jac", jacobian, jacobian) * weight[:, None, None]
    return hessian, -np.einsum("jba,jb->ja", jacobian, error) * weight[:, None]


def limit_terms(
    rotations: Float64[np.ndarray, "joints 3 3"], prior: JointPrior, softness: float
) -> tuple[Float64[np.ndarray, "joints 3 3"], Float64[np.ndarray, "joints 3"]]:
    """The same for turns beyond the joints' limits; `softness` is the overshoot, radians, that costs 1."""
    vector = Rotation.from_matrix(rotations).as_rotvec()
    jacobian = inverse_left_jacobian(vector)
    angle = np.linalg.norm(vector, axis=1)
    axis = vector / np.maximum(angle, 1e-12)[:, None]
    bend = np.einsum("ja,ja->j", vector, prior.hinge_axes)
    excesses = (
        (axis, np.maximum(angle - prior.reach, 0)),
        (prior.hinge_axes, bend - np.clip(bend, prior.hinge_ranges[:, 0], prior.hinge_ranges[:, 1])),
    )
    hessian, descent = np.zeros_like(rotations), np.zeros_like(vector)
    for direction, excess in excesses:
        row = np.einsum("jba,jb->ja", jacobian, direction) / softness
        beyond = (excess != 0)[:, None, None]
        hessian += np.where(beyond, np.einsum("ja,jb->jab", row, row), 0.0)
        descent -= row * (excess / softness)[:, None]
    return hessian, descent
