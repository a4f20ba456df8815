"""Where a take's coordinates come from: its units, which way is up, whether it is mirrored or inside out.

Told from a few frames of a standing person in clothes. Size comes from the surface. Without motion capture, up is the
direction in which a rough mannequin fits best (`capture4d.preflight.mannequin`). With it, all 48 ways to swap and turn
over the axes are tried against the posed bodies (`capture4d.preflight.motion`); that also finds a mirrored take, which
nothing else can tell from one whose faces wind the wrong way round.

A placement maps file coordinates to metres, Y up: `scale * axes @ x`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from capture4d.captures.placement import Placement
from capture4d.geometry.mesh import face_areas
from capture4d.preflight.mannequin import (
    PROBE_POINTS,
    UNIT_NORMALS,
    MannequinFit,
    find_up,
    fit_mannequin,
    sample_surface,
    upright,
)
from capture4d.preflight.motion import Motion, fit_person, fit_posed_bodies, floor_by_poses
from capture4d.preflight.statistics import outwardness
from capture4d.types import Mesh
from capture4d.units import METRES, Units

__all__ = ["MAX_FLOOR_M", "MAX_SIZE_RATIO", "Survey", "find_units", "survey_take"]

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
BARE_POINTS = 400
"""Of skin and suit, for telling who it is."""


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


def find_units(size: float) -> tuple[Units, float]:
    """The unit in which a subject of this size, the square root of its surface, is a person; and how far off it is.

    Returns:
        The unit, and the ratio of the size in it to that of a person, never below 1.
    """
    ratios: dict[Units, float] = {unit: size * metres / SUBJECT_SIZE_M for unit, metres in METRES.items()}
    unit, _ = min(ratios.items(), key=lambda item: abs(np.log(max(item[1], 1e-12))))
    return unit, float(np.exp(abs(np.log(max(ratios[unit], 1e-12)))))
