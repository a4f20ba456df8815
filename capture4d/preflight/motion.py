"""Scans against motion capture: which way the axes point, how high the take stands, and whether it is of this person.

Letters: N points.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import KDTree

from capture4d.body.posed_surface import BodyState, TrackedBody, linearise, match, pose_surface
from capture4d.types import Mesh

__all__ = ["CLIP_M", "Motion", "PersonFit", "fit_person", "fit_posed_bodies", "floor_by_poses"]

CLIP_M = 0.12
"""A point farther from the body is simply not explained by it."""
PERSON_STEPS = 10
PERSON_SCALES_M = (0.08, 0.02)
"""First and last: points this far from the body count a quarter (Geman-McClure)."""
POINT_SIGMA_M = 0.005
"""Of a scanned point on skin and suit; `MISMATCH` of the scale is added, for points matched wrongly."""
MISMATCH = 0.3
NORMAL_COSINE = 0.5
"""Points whose normal differs more from the body's are left out."""
SHAPE_SPREAD = 1.5
"""Standard deviation of what another person's shape coefficients differ by; each has one of 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Motion capture in the probe frames."""

    model: TrackedBody
    states: Sequence[BodyState]
    """One a probe, all of one shape."""
    bare: Sequence[Mesh]
    """Skin and suit of the probes, in file coordinates; all of the scans if the cloth is not known."""
    cloth_known: bool

    def surfaces(self) -> list[Float64[np.ndarray, "verts 3"]]:
        """Posed body of every probe."""
        return [pose_surface(self.model, state).vertices for state in self.states]

    def floor(self) -> float:
        """Height of the lowest vertex of the body, metres."""
        return _lowest(self.surfaces())


def _lowest(bodies: Sequence[np.ndarray]) -> float:
    return float(np.median([body[:, 1].min() for body in bodies]))


def fit_posed_bodies(
    probes: Sequence[Float[np.ndarray, "N 3"]], bodies: Sequence[Float[np.ndarray, "verts 3"]]
) -> list[tuple[float, Float64[np.ndarray, "3 3"]]]:
    """Try every signed permutation of the axes against the posed bodies of the probes' frames.

    Args:
        probes: points on scans, metres, in file axes.
        bodies: posed body surface of each.
    Returns:
        The misfit, metres, and the permutation, for all 48; the best first. A common shift of the take is let pass,
        be it of whole people or of their upper halves.
    """
    trees = [KDTree(np.asarray(body, np.float64)) for body in bodies]
    fits = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            axes = np.zeros((3, 3))
            axes[range(3), order] = signs
            fits.append((_misfit([points @ axes.T for points in probes], bodies, trees), axes))
    return sorted(fits, key=lambda fit: fit[0])


def _misfit(probes: list[np.ndarray], bodies: Sequence[np.ndarray], trees: list[KDTree]) -> float:
    middles = np.mean([b.mean(axis=0) - p.mean(axis=0) for p, b in zip(probes, bodies, strict=True)], 0)
    tops = np.mean([b[:, 1].max() - p[:, 1].max() for p, b in zip(probes, bodies, strict=True)])
    starts = (np.zeros(3), middles, np.array([middles[0], tops, middles[2]]))
    best = np.inf
    for shift in starts:
        for step in range(4):
            misfits, moves = [], []
            for points, body, tree in zip(probes, bodies, trees, strict=True):
                distance, nearest = tree.query(points + shift, distance_upper_bound=0.5)
                near = np.isfinite(distance)
                misfits.append(np.minimum(distance, CLIP_M).mean())
                if near.any():
                    moves.append((body[np.asarray(nearest)[near]] - points[near] - shift).mean(axis=0))
            best = min(best, float(np.mean(misfits)))
            if step == 3 or not moves:
                break
            shift = shift + np.mean(moves, axis=0)
    return best


def floor_by_poses(placed: Sequence[Float[np.ndarray, "N 3"]], bodies: Sequence[Float[np.ndarray, "verts 3"]]) -> float:
    """Where the floor is in the scans, metres: their lift over the posed bodies, and that of the bodies over theirs.

    Args:
        placed: points on scans, metres, Y up.
        bodies: posed body surface of each.
    """
    trees = [KDTree(np.asarray(body, np.float64)) for body in bodies]

    def misfit(rise: float) -> float:
        return float(
            np.mean(
                [
                    np.minimum(
                        tree.query(points + np.array([0, rise, 0]), distance_upper_bound=CLIP_M)[0], CLIP_M
                    ).mean()
                    for tree, points in zip(trees, placed, strict=True)
                ]
            )
        )

    rises = np.arange(-1.6, 1.601, 0.08)
    rise = min(rises, key=lambda value: (misfit(value), abs(value)))
    for step in (0.03, 0.012, 0.005):
        rise = min((rise - 2 * step, rise - step, rise, rise + step, rise + 2 * step), key=misfit)
    return _lowest(bodies) - float(rise)


@dataclass(frozen=True, slots=True, eq=False)
class PersonFit:
    """Whose body the scans show, in the poses of the motion capture."""

    shape: Float64[np.ndarray, " shapes"]
    shift: Float64[np.ndarray, " 3"]
    """Of the motion capture onto the scans, metres."""
    difference_m: float
    """Root mean square, over what was scanned, of how far the surface of that body lies from that of the motion
    capture's, once one is moved onto the other."""
    floor_m: float
    """Height of the fitted body's lowest vertex in the scans."""


def fit_person(motion: Motion, samples: Sequence[Float[np.ndarray, "N 6"]], *, rise_m: float = 0.0) -> PersonFit:
    """Fit one shape and one shift to the scans, and keep the joints' rotations: point-to-plane Gauss-Newton.

    A body of other proportions cannot be moved onto the scans, the right one can: this tells motion capture of
    somebody else from scans on another floor.

    Args:
        samples: points of `motion.bare`, metres, Y up, with unit normals.
        rise_m: how much too low the motion capture is, to start from.
    """
    given, pose = motion.states[0].shape, 3 + 3 * len(motion.states[0].rotations)
    shape, shift = given.copy(), np.array([0.0, rise_m, 0.0])
    wanted = [0, 1, 2, *range(pose, pose + len(given))]
    for scale in np.geomspace(*PERSON_SCALES_M, PERSON_STEPS):
        information = np.diag([1e-6] * 3 + [1 / SHAPE_SPREAD**2] * len(shape))
        descent = np.concatenate([np.zeros(3), (given - shape) / SHAPE_SPREAD**2])
        for state, sample in zip(_moved(motion, shape, shift), samples, strict=True):
            points, normals = _halves(sample)
            surface = pose_surface(motion.model, state)
            matches = match(surface, points, normals)
            away = points - matches.points
            agree = np.einsum("na,na->n", normals, matches.normals) > NORMAL_COSINE
            robust = (scale**2 / (scale**2 + (away**2).sum(axis=1))) ** 2
            weight = np.where(agree, robust, 0.0) / (POINT_SIGMA_M**2 + (MISMATCH * scale) ** 2)
            active = weight > 1e-6
            rows = linearise(surface, matches, active)[:, wanted]
            weighted = rows * weight[active, None]
            information += rows.T @ weighted
            descent += weighted.T @ np.einsum("na,na->n", away, matches.normals)[active]
        change = np.linalg.solve(information, descent)
        shift, shape = shift + change[:3], shape + change[3:]
    fitted = [pose_surface(motion.model, state) for state in _moved(motion, shape, shift)]
    apart = []
    for surface, given_body, sample in zip(fitted, motion.surfaces(), samples, strict=True):
        corners = motion.model.body.template.faces[match(surface, *_halves(sample)).faces]
        apart.append((surface.vertices - given_body)[corners].mean(axis=1))
    moved = np.concatenate(apart)
    difference = float(np.sqrt(((moved - moved.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return PersonFit(shape, shift, difference, _lowest([surface.vertices for surface in fitted]))


def _moved(motion: Motion, shape: np.ndarray, shift: np.ndarray) -> list[BodyState]:
    return [replace(state, translation=state.translation + shift, shape=shape) for state in motion.states]


def _halves(sample: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(sample[:, :3]), np.ascontiguousarray(sample[:, 3:])
