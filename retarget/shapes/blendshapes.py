"""The statistical garment model: mean and principal directions of unposed frames, projection, reconstruction.

Letters: N frames, V vertices, K directions, J joints. The unposed space is the captured person's rest pose, metres.

Unseen vertices are missing data, not data: the model is learned with them filled in from itself, again and again
(weighted low-rank approximation), and a frame is projected with its gaps filled in, by weighted least squares.

References: DeepWrinkles (ECCV 2018), section 3.2, Eq. 3. As printed it projects the frame itself, lambda = V^T R_bar;
here it is the offset, lambda = V^T (R_bar - M_bar), and the directions are those of length 3 V. Srebro and Jaakkola,
Weighted Low-Rank Approximations (ICML 2003).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Integer

from capture4d.body.skinning import blend_transforms
from capture4d.errors import InputError
from capture4d.learning.principal_directions import blocks, exact_directions, randomised_directions
from capture4d.types import BlendshapeModel
from retarget.config import ShapeConfig

__all__ = [
    "ShapeSpace",
    "as_model_arrays",
    "fewest_directions",
    "learn_shape_space",
    "posed_errors",
    "project",
    "reconstruct",
    "shape_space",
    "skin_frames",
    "through_garment",
    "worst_errors",
]

PRIOR_NOISE_M = 0.002
"""How exact a seen vertex is, against which the coefficients' own spread is weighed where vertices are missing."""
FILLING_DIRECTIONS = 50
"""Unseen vertices are filled in from so many directions. The later ones are small, and with as many directions as there
are frames the model would fill in whatever registration had guessed."""
FILLED = 1e-4
"""Rounds of filling end when the unseen vertices move less than this, metres, root mean square."""
SEEN = 0.5
"""Vertices below this weight count for no error."""
SAME_M = 1e-6
"""A garment that the directions miss by less is in the space already, metres, root mean square over the vertices."""


@dataclass(frozen=True, slots=True, eq=False)
class ShapeSpace:
    """Mean and principal directions."""

    mean: Float64[np.ndarray, "verts 3"]
    basis: Float64[np.ndarray, "shapes verts 3"]
    std: Float64[np.ndarray, " shapes"]
    """Of the coefficients, metres."""

    def first(self, count: int) -> ShapeSpace:
        """With fewer directions."""
        return ShapeSpace(self.mean, self.basis[:count], self.std[:count])


def learn_shape_space(
    frames: Float[np.ndarray, "frames verts 3"],
    weights: Float[np.ndarray, "frames verts"],
    rows: Integer[np.ndarray, " kept"],
    config: ShapeConfig,
    rng: np.random.Generator,
) -> ShapeSpace:
    """Mean, directions and their spread, with as many directions as the frames have, at most `most_components`.

    Args:
        frames: unposed, metres; may lie on disk.
        weights: 0 to 1 per vertex.
        rows: the frames to learn from.
    Raises:
        InputError: fewer than two frames, none that differ, or NaN among them.
    """
    if len(rows) < 2:
        raise InputError(f"takes: expected at least 2 good frames to learn from, found {len(rows)}")
    source = _Frames(frames, weights, rows)
    mean = source.weighted_mean()
    space = ShapeSpace(mean, np.zeros((0, *mean.shape)), np.zeros(0))
    wanted = config.components or config.most_components
    space = _directions(source, space, wanted, config, rng)
    if not len(space.std):
        raise InputError(
            f"takes: expected frames that differ in the rest pose, found {len(rows)} that are all the same"
        )
    if not source.has_gaps:
        return space
    spread = np.inf
    for _ in range(config.filling_rounds):
        before = space
        space = _directions(source, _filled_mean(source, space), wanted, config, rng)
        spread = source.change(before, space)
        if spread < FILLED:
            break
    return space


def through_garment(
    space: ShapeSpace,
    garment: Float[np.ndarray, "verts 3"],
    frames: Float[np.ndarray, "frames verts 3"],
    rows: Integer[np.ndarray, " kept"],
) -> ShapeSpace:
    """The space with one more direction, the last, if it takes one to reach a garment: what that has beyond the others.

    Args:
        garment: unposed, metres.
        frames: unposed, metres; may lie on disk.
        rows: the frames that were learned from, for the spread along the direction.
    """
    missed = garment - space.mean
    for _ in range(2):  # once more, for what rounding has left
        missed = missed - np.tensordot(np.tensordot(space.basis, missed, 2), space.basis, 1)
    length = float(np.linalg.norm(missed))
    if length <= SAME_M * np.sqrt(len(garment)):
        return space
    direction = missed / length
    squares = 0.0
    for block in blocks(len(rows), 3 * frames.shape[1]):
        offsets = np.asarray(frames[rows[block]], np.float64) - space.mean
        squares += float((np.tensordot(offsets, direction, 2) ** 2).sum())
    spread = np.sqrt(squares / max(len(rows), 1))
    return ShapeSpace(space.mean, np.concatenate([space.basis, direction[None]]), np.append(space.std, spread))


@dataclass(frozen=True, slots=True, eq=False)
class _Frames:
    """The frames that are learned from, a block at a time."""

    frames: np.ndarray
    weights: np.ndarray
    rows: np.ndarray

    @property
    def columns(self) -> int:
        return 3 * self.frames.shape[1]

    @property
    def has_gaps(self) -> bool:
        return any(bool((self.weights[self.rows[block]] < 1).any()) for block in self.blocks())

    def blocks(self) -> Iterator[slice]:
        return blocks(len(self.rows), self.columns)

    def read(self, block: slice) -> tuple[np.ndarray, np.ndarray]:
        kept = self.rows[block]
        vertices = np.asarray(self.frames[kept], np.float64)
        if not np.isfinite(vertices).all():
            raise InputError("takes: expected finite vertices, found NaN or inf in a frame that counts as good")
        return vertices, np.asarray(self.weights[kept], np.float64)

    def weighted_mean(self) -> np.ndarray:
        """A vertex that is never seen gets the plain mean of its guesses."""
        total, weight = np.zeros((self.frames.shape[1], 3)), np.zeros((self.frames.shape[1], 1))
        for block in self.blocks():
            vertices, weights = self.read(block)
            weights = np.maximum(weights, 1e-6)
            total += np.einsum("nv,nvx->vx", weights, vertices)
            weight[:, 0] += weights.sum(axis=0)
        return total / weight

    def filled(self, block: slice, space: ShapeSpace) -> np.ndarray:
        """Offsets from the mean, (B, V, 3): seen vertices as they are, the others as the space has them."""
        vertices, weights = self.read(block)
        offsets = vertices - space.mean
        return _filled(space, offsets, weights)

    def change(self, before: ShapeSpace, after: ShapeSpace) -> float:
        """How far what was filled in has moved, root mean square, metres."""
        squares = count = 0.0
        for block in self.blocks():
            weights = self.read(block)[1]
            moved = self.filled(block, after) + after.mean - self.filled(block, before) - before.mean
            unseen = weights < SEEN
            squares += float((moved[unseen] ** 2).sum())
            count += float(unseen.sum())
        return float(np.sqrt(squares / max(count, 1.0)))


def _filled_mean(source: _Frames, space: ShapeSpace) -> ShapeSpace:
    total = sum(source.filled(block, space).sum(axis=0) for block in source.blocks())
    return ShapeSpace(space.mean + total / len(source.rows), space.basis, space.std)


def _directions(
    source: _Frames, space: ShapeSpace, wanted: int, config: ShapeConfig, rng: np.random.Generator
) -> ShapeSpace:
    """Principal directions of the frames, filled in from a space, about its mean."""
    count, columns = len(source.rows), source.columns

    def rows(block: slice) -> np.ndarray:
        return source.filled(block, space).reshape(-1, columns)

    exact = config.method == "exact"
    if config.method == "auto":
        exact = count * columns * 8 <= config.memory_mb * 1e6
    if exact:
        basis, values = exact_directions(rows, count, columns, wanted)
    else:
        basis, values = randomised_directions(rows, count, columns, wanted, rng)
    return ShapeSpace(space.mean, basis.reshape(-1, columns // 3, 3), values / np.sqrt(count))


def _filled(
    space: ShapeSpace, offsets: Float[np.ndarray, "frames verts 3"], weights: Float[np.ndarray, "frames verts"]
) -> Float[np.ndarray, "frames verts 3"]:
    """Offsets with what was not seen filled in from the first directions, as far as it was not seen."""
    gaps = np.flatnonzero((weights < 1).any(axis=1))
    if not len(gaps) or not len(space.basis):
        return offsets
    first, share, result = space.first(FILLING_DIRECTIONS), weights[gaps][..., None], offsets.copy()
    flat = first.basis.reshape(len(first.basis), -1)
    guessed = (_least_squares(first, offsets[gaps], weights[gaps]) @ flat).reshape(len(gaps), *offsets.shape[1:])
    result[gaps] = share * offsets[gaps] + (1 - share) * guessed
    return result


def _least_squares(
    space: ShapeSpace, offsets: Float[np.ndarray, "frames verts 3"], weights: Float[np.ndarray, "frames verts"]
) -> Float64[np.ndarray, "frames shapes"]:
    """Weighted projection.

    The normal matrix is I - B_m^T (1 - W_m) B_m over the missing vertices m alone, since the basis is orthonormal; the
    prior on the coefficients grows with what is missing.
    """
    flat = space.basis.reshape(len(space.basis), -1)
    result = (offsets * weights[..., None]).reshape(len(offsets), -1) @ flat.T
    precision = PRIOR_NOISE_M**2 / np.maximum(space.std, 1e-9) ** 2
    for row, known in enumerate(weights):
        missing = np.flatnonzero(known < 1)
        lost = 1 - known[missing]
        scaled = (space.basis[:, missing] * np.sqrt(lost)[:, None]).reshape(len(flat), -1)
        normal = np.eye(len(flat)) - scaled @ scaled.T
        normal[np.diag_indices(len(flat))] += precision * lost.sum() / len(known)
        result[row] = np.linalg.solve(normal, result[row])
    return result


def _coefficients(
    space: ShapeSpace, offsets: Float[np.ndarray, "frames verts 3"], weights: Float[np.ndarray, "frames verts"]
) -> Float64[np.ndarray, "frames shapes"]:
    """Projection with gaps filled in; a frame without gaps is projected plainly, and so exactly."""
    flat = space.basis.reshape(len(space.basis), -1)
    return _filled(space, offsets, weights).reshape(len(offsets), -1) @ flat.T


def project(
    space: ShapeSpace,
    frames: Float[np.ndarray, "frames verts 3"],
    weights: Float[np.ndarray, "frames verts"] | None = None,
    *,
    formula: str = "corrected",
) -> Float64[np.ndarray, "frames shapes"]:
    """Coefficients of unposed frames.

    Args:
        formula: "corrected" projects the offset from the mean; "printed" the frame itself, as the paper's
            lambda = V^T R_bar has it, which adds the projected mean once more.
    Raises:
        InputError: NaN among the frames.
    """
    if not np.isfinite(frames).all():
        raise InputError("frames: expected finite vertices, found NaN or inf")
    result = np.empty((len(frames), len(space.basis)))
    for block in blocks(len(frames), 3 * frames.shape[1]):
        part = np.asarray(frames[block], np.float64)
        offsets = part if formula == "printed" else part - space.mean
        known = np.ones(part.shape[:2]) if weights is None else np.asarray(weights[block], np.float64)
        result[block] = _coefficients(space, offsets, known)
    return result


def reconstruct(
    mean: Float[np.ndarray, "verts 3"],
    basis: Float[np.ndarray, "shapes verts 3"],
    coefficients: Float[np.ndarray, "frames some"],
) -> Float[np.ndarray, "frames verts 3"]:
    """Unposed frames, M_bar + sum_l lambda_l V_l; fewer coefficients than directions use the first.

    Raises:
        InputError: NaN among the coefficients, or more of them than directions.
    """
    used = coefficients.shape[1]
    if used > len(basis):
        raise InputError(f"coefficients: expected at most {len(basis)}, found {used}")
    if not np.isfinite(coefficients).all():
        bad = int((~np.isfinite(coefficients)).any(axis=1).sum())
        raise InputError(
            f"coefficients: expected finite numbers, found NaN or inf in {bad} of {len(coefficients)} frames"
        )
    offsets = coefficients.astype(basis.dtype) @ basis[:used].reshape(used, -1)
    return mean + offsets.reshape(len(coefficients), *mean.shape)


def skin_frames(
    frames: Float32[np.ndarray, "frames verts 3"],
    skin_weights: Float32[np.ndarray, "verts joints"],
    transforms: Float[np.ndarray, "frames joints 4 4"],
) -> Float32[np.ndarray, "frames verts 3"]:
    """Linear blend skinning of many frames in single precision: exact to a micrometre in a room, and quick."""
    placed = np.empty_like(frames)
    for row, matrices in enumerate(transforms):
        blended = (skin_weights @ matrices[:, :3].reshape(-1, 12).astype(np.float32)).reshape(-1, 3, 4)
        placed[row] = (blended[:, :, :3] @ frames[row, :, :, None])[..., 0] + blended[:, :, 3]
    return placed


def posed_errors(
    residual: Float[np.ndarray, "frames verts 3"],
    skin_weights: Float[np.ndarray, "verts joints"],
    transforms: Float64[np.ndarray, "frames joints 4 4"],
) -> Float64[np.ndarray, "frames verts"]:
    """How long differences in the unposed space are in the pose, metres."""
    return np.stack(
        [
            np.linalg.norm(np.einsum("vab,vb->va", blend_transforms(skin_weights, matrices)[:, :, :3], each), axis=1)
            for each, matrices in zip(residual, transforms, strict=True)
        ]
    )


def worst_errors(
    space: ShapeSpace,
    frames: Float[np.ndarray, "frames verts 3"],
    weights: Float[np.ndarray, "frames verts"],
    rows: Integer[np.ndarray, " kept"],
    transforms: Float64[np.ndarray, "frames joints 4 4"],
    skin_weights: Float[np.ndarray, "verts joints"],
    counts: Sequence[int],
) -> dict[int, tuple[float, float]]:
    """Mean and largest distance, metres, of seen vertices from what the first so many directions make of them.

    Args:
        rows: the frames to measure; `transforms` are those of all frames.
        counts: numbers of directions.
    """
    worst, total, seen_vertices = dict.fromkeys(counts, 0.0), dict.fromkeys(counts, 0.0), 0
    flat = space.basis.reshape(len(space.basis), -1)
    for block in blocks(len(rows), 2 * 3 * frames.shape[1]):
        kept = rows[block]
        part, known = np.asarray(frames[kept], np.float64), np.asarray(weights[kept], np.float64)
        seen = known >= SEEN
        seen_vertices += int(seen.sum())
        for count in worst:
            space_k = space.first(count)
            coefficients = _coefficients(space_k, part - space.mean, known)
            residual = part - space.mean - (coefficients @ flat[:count]).reshape(part.shape)
            errors = posed_errors(residual, skin_weights, transforms[kept])[seen]
            worst[count] = max(worst[count], float(errors.max(initial=0.0)))
            total[count] += float(errors.sum())
    return {count: (total[count] / max(seen_vertices, 1), worst[count]) for count in counts}


def fewest_directions(
    space: ShapeSpace,
    frames: Float[np.ndarray, "frames verts 3"],
    weights: Float[np.ndarray, "frames verts"],
    rows: Integer[np.ndarray, " kept"],
    transforms: Float64[np.ndarray, "frames joints 4 4"],
    skin_weights: Float[np.ndarray, "verts joints"],
    *,
    limit_m: float,
) -> int | None:
    """The fewest directions with which no seen vertex of these frames is off by more than a limit, by bisection.

    The worst vertex does not fall strictly with every direction; the number found holds, one less may hold as well.

    Returns:
        None if all directions do not suffice.
    """

    def holds(count: int) -> bool:
        return worst_errors(space, frames, weights, rows, transforms, skin_weights, [count])[count][1] <= limit_m

    low, high = 0, len(space.basis)
    if not holds(high):
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


def as_model_arrays(space: ShapeSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, basis and spread in single precision, as `BlendshapeModel` holds them."""
    return space.mean.astype(np.float32), space.basis.astype(np.float32), space.std.astype(np.float32)


def shape_space(model: BlendshapeModel) -> ShapeSpace:
    """The space of a model that was read from a file, in double precision."""
    return ShapeSpace(model.mean.astype(np.float64), model.basis.astype(np.float64), model.std.astype(np.float64))
