"""Style, shape and pose of a garment that was seen: the garment with styles is fitted to it by gradients.

    fit = fit_style(garment, frames, start)
    garment.vertices(pose, beta, fit.style)

Letters: N points of a frame, P numbers of style and shape, phi, from -1 to 1.

The energy of some frames together, phi shared:

    mean_n rho(|r_n| / SPREAD_M)  +  sum_p prior_p (phi_p - phi_0p)^2  +  POSE_PRIOR mean_j (turn_j / TURN_RAD)^2

r_n is a vertex minus where it was registered or, of a surface that has other vertices, the distance of one of its
points along its normal and of a point on its border to the border of the same name. rho is Geman and McClure's. It is
minimised by Gauss-Newton on reweighted least squares, in steps that do not leave the ranges; derivatives are
differences of the model's own answers, so that what is fitted is what is predicted. Borders come first, for the lengths
of sleeve and hem are in them, then points, then the pose of the joints that move the garment, near the tracked one.

References: TailorNet (CVPR 2020), whose model is differentiable in style, shape and pose; points to planes: Chen and
Medioni, Object Modelling by Registration of Multiple Range Images (1992); rho: Geman and McClure (1987).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import skin, with_pose, with_shape
from capture4d.errors import InputError
from capture4d.geometry.mesh import vertex_normals
from capture4d.geometry.ray_casting import closest_points
from capture4d.types import Mesh
from retarget.mixture.lesson import person_under
from retarget.mixture.styled_garment import StyledGarment

__all__ = ["SeenFrame", "StyleFit", "fit_style"]

SPREAD_M = 0.02
"""Residual from which a point counts less: a model of a dozen prototypes is off by 10 to 16 mm itself."""
BORDER_SHARE = 0.3
"""Weight of all points on borders together, beside 1 of all others."""
NUMBERS_PRIOR, TRACKED_PRIOR = 2e-4, 0.3
"""Of a number that nobody knows, and of the shape of a person who was tracked: a garment says little of who is in it,
and what a model of few prototypes gets wrong would be put down to the person."""
POSE_PRIOR, TURN_RAD = 0.05, np.radians(3.0)
"""A joint that turns by this costs as much as a twentieth of the whole energy of points that are far off."""
STEP, TURN_STEP, SHIFT_STEP = 0.02, 0.01, 1e-3
"""Of differences: of a number, radians, metres."""
ROUNDS = {"borders": 4, "points": 6, "pose": 4}
"""Steps; nearest points are looked up before each."""
GATE_M, GATE_COSINE = 0.08, 0.3
"""A point of a surface is left out where the model is farther away or faces elsewhere."""
MOST_POINTS = 2500
"""Of a surface, drawn evenly among its vertices: more say the same."""
BOUNDED = 0.98
"""A number as near as this to the end of its range has run into it."""

Stage = Literal["borders", "points", "pose"]


@dataclass(frozen=True, slots=True, eq=False)
class SeenFrame:
    """What was seen of a garment in a pose."""

    rotations: Float[np.ndarray, "joints 3 3"]
    """Of the joints, as tracked."""
    translation: Float[np.ndarray, "3"]
    """Of the root, metres."""
    mesh: Mesh
    """The garment, metres, world."""
    same_vertices: bool
    """Whether its vertices are those of the model, one by one; else it is any surface."""
    border_points: Float32[np.ndarray, "points 3"]
    """On its borders, metres; not looked at if the vertices are the model's."""
    border_names: tuple[str, ...]
    """The border each is on; an empty name where nobody knows."""


@dataclass(frozen=True, slots=True, eq=False)
class StyleFit:
    """A style and a person, and how well they explain what was seen."""

    style: dict[str, float]
    """Numbers of the pattern, by name."""
    beta: tuple[float, ...]
    """In standard deviations."""
    numbers: Float64[np.ndarray, " numbers"]
    """Both, from -1 to 1."""
    at_limit: tuple[str, ...]
    """What has run into the end of what was learned: the garment may be beyond."""
    rotations: Float64[np.ndarray, "frames joints 3 3"]
    translations: Float64[np.ndarray, "frames 3"]
    residual_mm: Float64[np.ndarray, " frames"]
    """Mean distance of a vertex from where it was registered, or of a point from the model's surface, in each frame."""


def fit_style(
    garment: StyledGarment,
    frames: Sequence[SeenFrame],
    *,
    shape: Float[np.ndarray, " shapes"] | Sequence[float] = (),
    fit_pose: bool = True,
) -> StyleFit:
    """Find the style and the person that explain what was seen in some frames.

    Args:
        shape: of the person as tracked, standard deviations, from which the fit hardly moves; what the garment was not
            learned on is left out. Empty if nobody was tracked: then the garment alone tells it, and not well.
        fit_pose: turn the joints that move the garment a little, if that explains more.
    Raises:
        InputError: there is nothing to fit to, or a frame's pose or vertices are not the model's.
    """
    if not frames:
        raise InputError("frames: expected at least one to fit a style to, found none")
    search = _Search(garment, frames, shape)
    plain = all(frame.same_vertices for frame in frames)
    if not plain and any(len(frame.border_points) for frame in frames):
        search.run("borders")
    search.run("points")
    if fit_pose:
        search.run("pose")
    return search.result()


class _Model:
    """A garment with styles as a function of phi and pose, without what a fit has no use for.

    What is linear in the shape is kept as such: single precision would drown the differences.
    """

    def __init__(self, garment: StyledGarment) -> None:
        self.garment, self.ranges = garment, garment.ranges
        size = len(garment.ranges.shape)
        ends = [np.zeros(size), *np.eye(size)]
        people = [with_shape(garment.body, end) for end in ends]
        under = np.stack([person_under(garment.garment, garment.body, end.astype(np.float32)) for end in ends])
        joints = np.stack([person.joints for person in people])
        self._person = people[0]
        self._under, self._joints = (under[0], under[1:] - under[0]), (joints[0], joints[1:] - joints[0])
        weights = garment.garment.skin_weights
        assert weights is not None
        self._weights = weights

    def vertices(
        self, numbers: np.ndarray, rotations: np.ndarray, translation: np.ndarray
    ) -> Float64[np.ndarray, "verts 3"]:
        """Metres, world; inside the body or not."""
        garment = self.garment
        _, beta = self.ranges.values(numbers)
        (under, directions), (joints, moved) = self._under, self._joints
        canonical = garment.canonical(numbers)
        said = garment.predictor.displacements(garment.pose.of(rotations[None]), numbers, canonical)[0]
        rest = under + np.tensordot(beta, directions, axes=1) + said + (canonical if garment.over_drape else 0)
        centres = joints + np.tensordot(beta, moved, axes=1)
        person = replace(self._person, shape=np.asarray(beta), joints=centres)  # its skin is not looked at
        return skin(rest, self._weights, with_pose(person, rotations, translation).transforms)


@dataclass(slots=True)
class _Placed:
    """The pose of a frame while it is fitted, and what it is drawn to."""

    frame: SeenFrame
    rotations: np.ndarray
    translation: np.ndarray
    turns: np.ndarray
    """(joints, 3) rotation vectors by which the garment's joints have been turned from the tracked pose."""
    chosen: np.ndarray
    """Vertices of the seen mesh that are looked at."""
    normals: np.ndarray


@dataclass(frozen=True, slots=True)
class _Rows:
    """Residuals of a frame as functions of the model's vertices: normal . (weights . x[corners] - target)."""

    corners: np.ndarray
    """(N, 3) vertices of the model."""
    weights: np.ndarray
    """(N, 3)"""
    target: np.ndarray
    """(N, 3) metres."""
    normals: np.ndarray | None
    """(N, 3), or None if all three coordinates count."""
    total: float
    """Weight of all of them together."""

    def residuals(self, vertices: np.ndarray) -> np.ndarray:
        """(N, 1) or (N, 3), metres."""
        apart = np.einsum("nk,nkx->nx", self.weights, vertices[self.corners]) - self.target
        return apart if self.normals is None else np.einsum("nx,nx->n", apart, self.normals)[:, None]


class _Search:
    """What is fitted, and how far it has come."""

    def __init__(
        self, garment: StyledGarment, frames: Sequence[SeenFrame], shape: Sequence[float] | np.ndarray
    ) -> None:
        self.model, self.garment = _Model(garment), garment
        self.numbers = self.first = _begin(garment, shape)
        styles = np.arange(len(self.first)) < len(garment.ranges.style)
        self.priors = np.where(styles | (len(shape) == 0), NUMBERS_PRIOR, TRACKED_PRIOR)
        self.faces = garment.garment.template.faces
        self.joints = np.array([0, *garment.pose.joints])  # the root turns the garment as a whole
        self.frames = [self._placed(index, frame) for index, frame in enumerate(frames, 1)]

    def _placed(self, index: int, frame: SeenFrame) -> _Placed:
        joints, count = len(self.garment.body.joint_names), len(self.garment.garment.template.vertices)
        if frame.rotations.shape != (joints, 3, 3):
            raise InputError(f"frame {index}: expected a pose of {joints} joints, found {frame.rotations.shape}")
        found = len(frame.mesh.vertices)
        if not found or (frame.same_vertices and found != count):
            raise InputError(f"frame {index}: expected {count} vertices, those of the model, found {found}")
        step = max(1, -(-found // MOST_POINTS))
        chosen = np.arange(found) if frame.same_vertices else np.arange(0, found, step)
        points = frame.mesh.vertices.astype(np.float64)
        normals = vertex_normals(points, frame.mesh.faces) if not frame.same_vertices else np.zeros_like(points)
        chosen = chosen if frame.same_vertices else chosen[np.linalg.norm(normals[chosen], axis=1) > 0.5]
        return _Placed(
            frame, np.asarray(frame.rotations, np.float64), np.asarray(frame.translation, np.float64),
            np.zeros((len(self.joints), 3)), chosen, normals,
        )  # fmt: skip

    def run(self, stage: Stage) -> None:
        """Some steps of Gauss-Newton."""
        for _ in range(ROUNDS[stage]):
            self._step(stage)

    def _step(self, stage: Stage) -> None:
        """One step; a frame's own unknowns are eliminated, for no other frame knows them."""
        size = len(self.numbers)
        shared = np.diag(self.priors)
        drawn = self.priors * (self.first - self.numbers)
        own: list[tuple[_Placed, np.ndarray, np.ndarray, np.ndarray]] = []
        for placed in self.frames:
            squares, right = self._normal_equations(placed, stage)
            squares, right = squares / len(self.frames), right / len(self.frames)
            if stage == "pose":
                prior = POSE_PRIOR / (len(self.frames) * len(self.joints) * TURN_RAD**2)
                turned = np.arange(size + 3, len(right))
                squares[turned, turned] += prior
                right[turned] -= prior * placed.turns.reshape(-1)
            held = squares[size:, size:] + 1e-9 * np.eye(len(right) - size)
            shared += squares[:size, :size] - squares[:size, size:] @ np.linalg.solve(held, squares[size:, :size])
            drawn += right[:size] - squares[:size, size:] @ np.linalg.solve(held, right[size:])
            own.append((placed, held, squares[size:, :size], right[size:]))
        wanted = _bounded_step(shared, drawn, self.numbers)
        self.numbers = self.numbers + wanted
        for placed, held, across, right in own:
            self._move(placed, np.linalg.solve(held, right - across @ wanted))

    def _normal_equations(self, placed: _Placed, stage: Stage) -> tuple[np.ndarray, np.ndarray]:
        """J^T W J and -J^T W r of a frame: numbers, translation and, in the last stage, turns of the joints."""
        vertices = self._vertices(placed)
        moved = [(self._vertices(placed, numbers=each) - vertices) / h for h, each in self._nudged()]
        moved += [np.broadcast_to(axis, vertices.shape) for axis in np.eye(3)]
        if stage == "pose":
            moved += [
                (self._vertices(placed, turned=(joint, TURN_STEP * axis)) - vertices) / TURN_STEP
                for joint in range(len(self.joints)) for axis in np.eye(3)
            ]  # fmt: skip
        squares, right = np.zeros((len(moved), len(moved))), np.zeros(len(moved))
        for rows in self._rows(placed, vertices, stage):
            if not len(rows.target):
                continue
            off = rows.residuals(vertices)
            apart = (off**2).sum(axis=1) / SPREAD_M**2
            weight = rows.total / (len(off) * SPREAD_M**2 * (1 + apart) ** 2)
            at_zero = rows.residuals(np.zeros_like(vertices))
            columns = np.stack([rows.residuals(each) - at_zero for each in moved], axis=-1)  # residuals are affine
            squares += np.einsum("n,nxa,nxb->ab", weight, columns, columns, optimize=True)
            right -= np.einsum("n,nxa,nx->a", weight, columns, off, optimize=True)
        return squares, right

    def _nudged(self) -> list[tuple[float, np.ndarray]]:
        """Each number moved a little, towards the middle of its range, and by how much."""
        found = []
        for index, value in enumerate(self.numbers):
            h = -STEP if value > 0 else STEP
            found.append((h, self.numbers + h * (np.arange(len(self.numbers)) == index)))
        return found

    def _vertices(
        self, placed: _Placed, *, numbers: np.ndarray | None = None, turned: tuple[int, np.ndarray] | None = None
    ) -> np.ndarray:
        rotations = placed.rotations
        if turned is not None:
            rotations = rotations.copy()
            joint = self.joints[turned[0]]
            rotations[joint] = rotations[joint] @ Rotation.from_rotvec(turned[1]).as_matrix()
        return self.model.vertices(self.numbers if numbers is None else numbers, rotations, placed.translation)

    def _rows(self, placed: _Placed, vertices: np.ndarray, stage: Stage) -> list[_Rows]:
        """What a frame is drawn to, by where the model is now."""
        frame = placed.frame
        if frame.same_vertices:
            corners = np.repeat(np.arange(len(vertices))[:, None], 3, axis=1)
            return [_Rows(corners, np.full((len(vertices), 3), 1 / 3), frame.mesh.vertices.astype(float), None, 1.0)]
        found = [self._border_rows(frame, vertices)]
        if stage != "borders":
            found.append(self._surface_rows(placed, vertices))
        return found

    def _border_rows(self, frame: SeenFrame, vertices: np.ndarray) -> _Rows:
        """Points on borders to the nearest point of the border of that name, or of any where nobody knows it."""
        loops = self.garment.garment.loops
        names = np.array(frame.border_names, dtype=object)
        corners, weights, targets = [], [], []
        for name in dict.fromkeys(frame.border_names):
            chosen = [loops[name]] if name in loops else [] if name else list(loops.values())
            if not chosen:
                continue
            points = frame.border_points[names == name].astype(np.float64)
            starts = np.concatenate(chosen)
            ends = np.concatenate([np.roll(loop, -1) for loop in chosen])
            where, share = _nearest_on_segments(points, vertices[starts], vertices[ends])
            corners.append(np.stack([starts[where], ends[where], ends[where]], axis=1))
            weights.append(np.stack([1 - share, share, 0 * share], axis=1))
            targets.append(points)
        if not corners:
            return _Rows(np.zeros((0, 3), int), np.zeros((0, 3)), np.zeros((0, 3)), None, 0.0)
        return _Rows(np.concatenate(corners), np.concatenate(weights), np.concatenate(targets), None, BORDER_SHARE)

    def _surface_rows(self, placed: _Placed, vertices: np.ndarray) -> _Rows:
        """Points of the seen surface to planes through them: the nearest point of the model that faces as they do."""
        points, normals = placed.frame.mesh.vertices[placed.chosen].astype(np.float64), placed.normals[placed.chosen]
        model = Mesh(vertices.astype(np.float32), self.faces)
        nearest, faces, weights = closest_points(model, points)
        outwards = vertex_normals(vertices, self.faces)
        facing = np.einsum("nk,nkx->nx", weights, outwards[self.faces[faces]])
        near = np.linalg.norm(nearest - points, axis=1) < GATE_M
        near &= np.einsum("nx,nx->n", facing, normals) > GATE_COSINE
        return _Rows(self.faces[faces][near], weights[near].astype(float), points[near], normals[near], 1.0)

    def _move(self, placed: _Placed, step: np.ndarray) -> None:
        placed.translation = placed.translation + step[:3]
        if len(step) == 3:
            return
        turns = step[3:].reshape(-1, 3)
        turns *= np.minimum(1.0, 0.2 / np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), 1e-9))
        placed.rotations = placed.rotations.copy()
        placed.rotations[self.joints] = placed.rotations[self.joints] @ Rotation.from_rotvec(turns).as_matrix()
        placed.turns = placed.turns + turns

    def result(self) -> StyleFit:
        style, beta = self.garment.ranges.values(self.numbers)
        names = [*style, *(f"beta {k}" for k, (low, high) in enumerate(self.garment.ranges.shape, 1) if low < high)]
        return StyleFit(
            style, beta, self.numbers,
            tuple(name for name, value in zip(names, self.numbers, strict=True) if abs(value) > BOUNDED),
            np.stack([placed.rotations for placed in self.frames]),
            np.stack([placed.translation for placed in self.frames]),
            np.array([self._residual_mm(placed) for placed in self.frames]),
        )  # fmt: skip

    def _residual_mm(self, placed: _Placed) -> float:
        vertices, seen = self._vertices(placed), placed.frame.mesh.vertices
        if placed.frame.same_vertices:
            return 1e3 * float(np.linalg.norm(vertices - seen, axis=1).mean())
        points = seen[placed.chosen]
        nearest = closest_points(Mesh(vertices.astype(np.float32), self.faces), points)[0]
        return 1e3 * float(np.linalg.norm(nearest - points, axis=1).mean())


def _begin(garment: StyledGarment, shape: Sequence[float] | np.ndarray) -> Float64[np.ndarray, " numbers"]:
    """The middle of all styles, on the tracked person as far as the garment was learned on such."""
    known = garment.ranges.shape
    kept = [float(np.clip(value, low, high)) for value, (low, high) in zip(shape, known, strict=False)]
    kept += [float(np.clip(0.0, *limits)) for limits in known[len(kept) :]]
    return garment.ranges.numbers({}, kept)


def _bounded_step(
    squares: Float64[np.ndarray, "P P"], right: Float64[np.ndarray, " P"], numbers: Float64[np.ndarray, " P"]
) -> Float64[np.ndarray, " P"]:
    """The step that solves the equations, with those numbers held that would leave -1 to 1."""
    step = np.zeros_like(numbers)
    free = np.ones(len(numbers), bool)
    while free.any():
        held = right[free] - squares[np.ix_(free, ~free)] @ step[~free]
        step[free] = np.linalg.solve(squares[np.ix_(free, free)], held)
        over = free & (np.abs(numbers + step) > 1 + 1e-12)
        if not over.any():
            break
        step[over] = np.clip(numbers[over] + step[over], -1, 1) - numbers[over]
        free &= ~over
    return step


def _nearest_on_segments(
    points: Float64[np.ndarray, "N 3"], starts: Float64[np.ndarray, "S 3"], ends: Float64[np.ndarray, "S 3"]
) -> tuple[Int32[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
    """The segment nearest to each point, among the eight whose middles are, and how far along it the point is."""
    middles = (starts + ends) / 2
    count = min(8, len(starts))
    candidates = np.asarray(KDTree(middles).query(points, k=count)[1]).reshape(len(points), count)
    along = (ends - starts)[candidates]
    lengths = np.maximum(np.einsum("nsx,nsx->ns", along, along), 1e-18)
    share = np.clip(np.einsum("nsx,nsx->ns", points[:, None] - starts[candidates], along) / lengths, 0, 1)
    apart = np.linalg.norm(starts[candidates] + share[..., None] * along - points[:, None], axis=2)
    best, rows = np.argmin(apart, axis=1), np.arange(len(points))
    return candidates[rows, best].astype(np.int32), share[rows, best]
