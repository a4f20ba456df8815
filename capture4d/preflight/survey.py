"""Where a take's coordinates come from: its units, which way is up, whether it is mirrored or inside out.

Told from a few frames of a standing person in clothes. Size comes from the surface. Without motion capture, up is the
direction in which a rough mannequin (head on top, trunk, legs; arms wherever they may be) fits best. With it, all 48
ways to swap and turn over the axes are tried against the posed bodies (`capture4d.preflight.motion`); that also finds a
mirrored take, which nothing else can tell from one whose faces wind the wrong way round.

Letters: N points, P probe frames. A placement maps file coordinates to metres, Y up: `scale * axes @ x`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import KDTree

from capture4d.captures.placement import Placement
from capture4d.geometry.mesh import doubled_area_vectors, face_areas
from capture4d.preflight.motion import CLIP_M, Motion, fit_person, fit_posed_bodies, floor_by_poses
from capture4d.preflight.statistics import outwardness
from capture4d.types import Mesh
from capture4d.units import METRES, Units

__all__ = [
    "MannequinFit",
    "Survey",
    "find_units",
    "find_up",
    "fit_mannequin",
    "sample_surface",
    "survey_take",
    "upright",
]

SUBJECT_SIZE_M = 1.2
"""Square root of a scanned subject's surface: 0.95 m for a bare shirt, 1.5 m for a clothed person from head to toe."""


MAX_SIZE_RATIO = 1.65
"""Beyond this a subject is no person in the declared unit; inches taken for centimetres are off by 2.54."""


FAULT = 1.12
"""A fault is believed if it explains the frames better by this factor."""


TRUSTED_POSES_M = 0.035
"""Motion capture that fits no better than this, whatever the axes, is not of this take."""


MAX_PERSON_M = 0.015
"""Root mean square distance between the body of the motion capture and the one that the scans show. Coefficients of two
standard deviations make 25 to 60 mm, one that was fitted to the scans has less than 1."""


MAX_PERSON_DRESSED_M = 0.025
"""The same where cloth cannot be told from the body, and adds 8 mm."""


MAX_FLOOR_M = 0.05


FEET_SEEN_M = 0.3
"""A scan that ends less than this above the mannequin's soles shows the feet."""


MANNEQUIN_SINKS_M = 0.13
"""The mannequin comes to stand this much too low: clothes and hair make people look larger."""


SOLE_LOST_M = 0.03
"""Soles are not scanned; a scan ends at the edge of the foot."""


PROBE_POINTS = 200


BARE_POINTS = 400
"""Of skin and suit, for telling who it is."""


NORMAL_M = 0.06
"""A unit of difference between normals counts as much as this distance."""


UNIT_NORMALS = np.array([1.0] * 3 + [NORMAL_M] * 3)


SCALE_RANGE = (0.8, 1.2)
"""Sizes of adults relative to the mannequin's 1.72 m."""


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """What a few frames say about the coordinates of a take. Ratios are 1 where there is nothing to say."""

    placement: Placement
    """What brings the take to metres, Y up, faces outside, feet on the floor; only what was found to be wrong."""
    units: Units | None
    """What the files are in, None if no unit makes the subject a person."""
    size_ratio: float
    """How many times too large or too small the subject is as declared, never below 1."""
    axes_ratio: float
    """Misfit as the axes are, over the misfit of the best other rotation of them."""
    mirror_ratio: float | None
    """The same for mirrored axes; None without motion capture, which alone tells."""
    outwardness: float
    """As the file's faces wind; negative is inside out."""
    floor_m: float
    """Height of the floor, once the axes are right."""
    floor_exact: bool
    """The feet were seen, or motion capture tells; else the floor is known to a hand's breadth or two."""
    by_poses: bool
    person_ratio: float | None = None
    """How far the body that the scans show is from that of the motion capture, over what is tolerated; None without."""
    poses_lift_m: float = 0.0
    """What lifts the motion capture with the scans, where it shares their floor."""
    person_m: float = 0.0
    """That distance: root mean square over what was scanned."""


def survey_take(probes: Sequence[Mesh], declared: float, motion: Motion | None = None) -> Survey:
    """Find units, axes, handedness, winding and floor.

    Args:
        probes: scans of a few frames as their files have them.
        declared: metres in a unit of the files, as the capture says.
        motion: motion capture in these frames.
    """
    size = float(np.median([np.sqrt(_area(mesh)) for mesh in probes]))
    ratio = size * declared / SUBJECT_SIZE_M
    size_ratio = max(ratio, 1 / max(ratio, 1e-12))
    units: Units | None = next((name for name, metres in METRES.items() if metres == declared), None)
    scale = declared
    if size_ratio > MAX_SIZE_RATIO:
        units, left = find_units(size)
        scale = METRES[units]
        if left > MAX_SIZE_RATIO:
            units, scale = None, SUBJECT_SIZE_M / max(size, 1e-12)
    sign = float(np.median([outwardness(mesh) for mesh in probes]))
    points = [_sampled(mesh, scale, sign) for mesh in probes]

    bodies = [] if motion is None else motion.surfaces()
    fits = fit_posed_bodies([sample[:, :3] for sample in points], bodies) if bodies else []
    by_poses = bool(fits) and fits[0][0] < TRUSTED_POSES_M
    if by_poses:
        axes, axes_ratio, mirror_ratio = _choose_by_poses(fits, inside_out=sign < 0)
    else:
        axes, axes_ratio = _choose_by_mannequin(find_up(points))
        mirror_ratio = None
    flip = (sign < 0) != bool(np.linalg.det(axes) < 0)
    turn = np.kron(np.eye(2), axes)
    placed = [sample @ turn.T for sample in points]
    survey = Survey(
        Placement(scale, axes, flip), units, size_ratio, axes_ratio, mirror_ratio, sign, 0.0, False, by_poses
    )
    if by_poses and motion is not None:
        rise = floor_by_poses([sample[:, :3] for sample in placed], bodies) - motion.floor()
        bare = [_sampled(mesh, scale, sign, count=BARE_POINTS) @ turn.T for mesh in motion.bare]
        person = fit_person(motion, [sample / UNIT_NORMALS for sample in bare], rise_m=rise)
        ratio = person.difference_m / (MAX_PERSON_M if motion.cloth_known else MAX_PERSON_DRESSED_M)
        survey = replace(survey, person_ratio=ratio, person_m=person.difference_m)
        if ratio <= 1:
            survey = _with_floor(survey, person.floor_m, exact=True)
            apart = float(person.shift[1])
            shared = abs(apart) < abs(person.floor_m - apart)  # theirs is nearer to that of the scans than to 0
            return replace(survey, poses_lift_m=survey.placement.lift_m if shared else 0.0)
    return _with_floor(survey, *_floor_by_feet(placed))


def _sampled(mesh: Mesh, scale: float, sign: float, *, count: int = PROBE_POINTS) -> np.ndarray:
    sample = sample_surface(mesh, outward=sign >= 0, count=count)
    return np.hstack([scale * sample[:, :3], sample[:, 3:]])


def _with_floor(survey: Survey, floor: float, exact: bool) -> Survey:
    lift = -floor if exact and abs(floor) > MAX_FLOOR_M else 0.0
    placement = replace(survey.placement, lift_m=lift)
    return replace(survey, placement=placement, floor_m=floor, floor_exact=exact)


def _area(mesh: Mesh) -> float:
    return float(face_areas(mesh.vertices.astype(np.float64), mesh.faces).sum())


def _choose_by_poses(fits: list[tuple[float, np.ndarray]], *, inside_out: bool) -> tuple[np.ndarray, float, float]:
    """The axes, and how much better than the file's own the best rotation and the best mirroring of them are.

    Each fault costs `FAULT`: other axes, and faces that would have to be turned over.
    """

    def cost(misfit: float, axes: np.ndarray) -> float:
        flipped = inside_out != (np.linalg.det(axes) < 0)
        return misfit * (1 if (axes == np.eye(3)).all() else FAULT) * (FAULT if flipped else 1)

    costs = [(cost(misfit, axes), axes) for misfit, axes in fits]
    own = next(value for value, axes in costs if (axes == np.eye(3)).all())
    turned = min(value for value, axes in costs if np.linalg.det(axes) > 0 and (axes != np.eye(3)).any())
    mirrored = min(value for value, axes in costs if np.linalg.det(axes) < 0)
    best = min(costs, key=lambda entry: entry[0])[1]
    return best, own / turned, own / mirrored


def _choose_by_mannequin(fits: dict[int, MannequinFit]) -> tuple[np.ndarray, float]:
    costs = {up: fit.misfit_m * {1: 1.0, 4: FAULT}.get(up, 1.06) for up, fit in fits.items()}
    other = min(cost for up, cost in costs.items() if up != 1)
    return upright(min(costs, key=lambda up: costs[up])), costs[1] / other


def _floor_by_feet(placed: list[np.ndarray]) -> tuple[float, bool]:
    """The floor under feet that were scanned, or else under those of a mannequin."""
    lowest = float(np.median([np.percentile(points[:, 1], 0.5) for points in placed]))
    sole = float(np.median([fit_mannequin(points).sole_m for points in placed])) + MANNEQUIN_SINKS_M
    if lowest - sole < FEET_SEEN_M:
        return lowest - SOLE_LOST_M, True
    return sole, False


def sample_surface(mesh: Mesh, *, outward: bool = True, count: int = PROBE_POINTS) -> Float64[np.ndarray, "N 6"]:
    """Points spread evenly over the area of a surface, the same ones every time, with normals times `NORMAL_M`.

    Args:
        outward: the faces wind counter-clockwise seen from outside.
    """
    vertices = mesh.vertices.astype(np.float64)
    normals = doubled_area_vectors(vertices, mesh.faces)
    size = np.linalg.norm(normals, axis=1)
    area = size.cumsum()
    chosen = np.searchsorted(area, (np.arange(count) + 0.5) / count * area[-1])
    unit = normals[chosen] / np.maximum(size[chosen, None], 1e-12) * (NORMAL_M if outward else -NORMAL_M)
    return np.hstack([vertices[mesh.faces[chosen]].mean(axis=1), unit])


def find_units(size: float) -> tuple[Units, float]:
    """The unit in which a subject of this size, the square root of its surface, is a person; and how far off it is.

    Returns:
        The unit, and the ratio of the size in it to that of a person, never below 1.
    """
    ratios: dict[Units, float] = {unit: size * metres / SUBJECT_SIZE_M for unit, metres in METRES.items()}
    unit, _ = min(ratios.items(), key=lambda item: abs(np.log(max(item[1], 1e-12))))
    return unit, float(np.exp(abs(np.log(max(ratios[unit], 1e-12)))))


# --- without motion capture ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class MannequinFit:
    """How well a mannequin explains a scan."""

    misfit_m: float
    """Mean distance, each point's at most `CLIP_M`."""
    sole_m: float
    """Where the mannequin stands, along the direction that was taken for up."""


def find_up(probes: Sequence[Float[np.ndarray, "N 6"]]) -> dict[int, MannequinFit]:
    """Fit the mannequin for each direction that may be up.

    Args:
        probes: points on scans, metres, with outward normals times `NORMAL_M`, in file axes.
    Returns:
        By axis 0, 1, 2 for x, y, z up and 3, 4, 5 for the same downwards: the mean over the probes.
    """
    fits = {}
    for up in range(6):
        turn = np.kron(np.eye(2), upright(up))
        turned = [fit_mannequin(points @ turn.T) for points in probes]
        fits[up] = MannequinFit(
            float(np.mean([fit.misfit_m for fit in turned])), float(np.median([fit.sole_m for fit in turned]))
        )
    return fits


def upright(up: int) -> Float64[np.ndarray, "3 3"]:
    """The rotation by quarter turns that takes axis `up` (3 to 5: downwards) to Y."""
    axis, sign = up % 3, -1.0 if up >= 3 else 1.0
    if axis == 1:
        return np.diag([1.0, sign, sign])
    other = 2 - axis
    rotation = np.zeros((3, 3))
    rotation[1, axis] = sign
    rotation[axis, 1] = -sign
    rotation[other, other] = 1.0
    return rotation


def fit_mannequin(points: Float[np.ndarray, "N 6"]) -> MannequinFit:
    """Stand a mannequin into oriented points by closest points: turn about the vertical, shift, and scale a little."""
    figure, tree, top = _mannequin()
    points = np.asarray(points, np.float64)
    low, high = np.percentile(points[:, 1], (1, 99))
    shifts = (top - high, -low, 1.15 - points[:, 1].mean())
    best = MannequinFit(np.inf, 0.0)
    for quarter, shift in itertools.product(range(6), shifts):
        pose = _Pose(_about_y(quarter * np.pi / 6), 1.0, np.zeros(3))
        centre = points[:, :3].mean(axis=0) * (1, 0, 1) - (0, shift, 0)
        pose = _Pose(pose.rotation, 1.0, -pose.rotation @ centre)
        for _ in range(8):
            moved = pose.apply(points)
            distance, nearest = tree.query(moved)
            pose = _about_y_pose(points[:, :3], figure[nearest, :3], 1.0 / (1 + (distance / CLIP_M) ** 2) ** 2)
        distance, _ = tree.query(pose.apply(points))
        misfit = float(np.minimum(distance, CLIP_M).mean())
        if misfit < best.misfit_m:
            best = MannequinFit(misfit, float(-pose.shift[1] / pose.scale))
    return best


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    rotation: np.ndarray
    scale: float
    shift: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        moved = self.scale * points[:, :3] @ self.rotation.T + self.shift
        return np.hstack([moved, points[:, 3:] @ self.rotation.T])


def _about_y(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def _about_y_pose(points: np.ndarray, target: np.ndarray, weight: np.ndarray) -> _Pose:
    """The turn about the vertical, scale and shift that bring points nearest to their targets."""
    weight = weight / weight.sum()
    here, there = weight @ points, weight @ target
    a, b = points - here, target - there
    cosine = float(weight @ (a[:, 0] * b[:, 0] + a[:, 2] * b[:, 2]))
    sine = float(weight @ (a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]))
    rotation = _about_y(np.arctan2(sine, cosine))
    scale = float(weight @ np.einsum("na,na->n", b, a @ rotation.T)) / max(float(weight @ (a * a).sum(axis=1)), 1e-12)
    scale = float(np.clip(scale, *SCALE_RANGE))
    return _Pose(rotation, scale, there - scale * rotation @ here)


@lru_cache(maxsize=1)
def _mannequin() -> tuple[np.ndarray, KDTree, float]:
    """Points on a rough person 1.72 m tall facing +Z, feet on y = 0; proportions after Drillis and Contini (1966)."""
    bones = [
        ((0, 1.55, 0.01), (0, 1.63, 0.02), 0.08, 0.09),
        ((0, 1.42, 0), (0, 1.54, 0), 0.06, 0.055),
        ((-0.16, 1.39, 0), (0.16, 1.39, 0), 0.055, 0.055),
        ((0, 0.95, 0), (0, 1.36, 0), 0.12, 0.12),
    ]
    for side in (-1.0, 1.0):
        bones += [
            ((side * 0.09, 0.95, 0), (side * 0.1, 1.33, 0), 0.11, 0.105),
            ((side * 0.09, 0.88, 0), (side * 0.1, 0.48, 0), 0.085, 0.055),
            ((side * 0.1, 0.48, 0), (side * 0.1, 0.08, 0), 0.055, 0.04),
            ((side * 0.1, 0.04, -0.04), (side * 0.12, 0.035, 0.16), 0.035, 0.03),
        ]
        shoulder = np.array([side * 0.18, 1.39, 0])
        for lateral, rise, forward in ((0.15, -1, 0.1), (0.7, -0.7, 0), (1, 0, 0), (0.4, 0.9, 0), (0.1, 0, 1)):
            arm = np.array([side * lateral, rise, forward]) / np.linalg.norm((lateral, rise, forward))
            bones.append((tuple(shoulder), tuple(shoulder + 0.68 * arm), 0.05, 0.03))
    points = np.concatenate([_capsule(np.array(start), np.array(end), r, s) for start, end, r, s in bones])
    return points, KDTree(points), float(points[:, 1].max())


def _capsule(start: np.ndarray, end: np.ndarray, first: float, last: float) -> np.ndarray:
    """Points some 25 mm apart on a cone with round ends, and their normals times `NORMAL_M`."""
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, (0.3, 0.5, 0.81))
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    length = np.linalg.norm(end - start)
    rings = []
    for along in np.arange(-0.8 * first, length + 0.8 * last + 1e-9, 0.025):
        share = np.clip(along / length, 0, 1)
        radius = first + share * (last - first)
        beyond = max(-along, along - length, 0.0)
        radius = np.sqrt(max(radius**2 - beyond**2, 1e-4))
        angle = np.arange(0, 2 * np.pi, 0.025 / max(radius, 0.02))
        ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
        tip = np.sign(along - length / 2) * beyond
        normal = radius * ring + tip * axis
        normal *= NORMAL_M / np.linalg.norm(normal, axis=1, keepdims=True)
        rings.append(np.hstack([start + along * axis + radius * ring, normal]))
    return np.concatenate(rings)
