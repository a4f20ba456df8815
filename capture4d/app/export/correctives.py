"""Few shapes for many frames: morph targets on top of a skeleton, as many as a given error asks for.

Letters: T frames, V vertices, K targets. Every frame is turned back by the skeleton with the very weights that are
written, so that the targets make up for what four influences cannot; then its principal directions are taken. The
weights end between 0 and 1, for the base moves to where they would all be least. Frames are worked on a few at a time.

Turning frames back leaves no error longer than it is: a blend of rotations stretches nothing. So K is chosen before
anything is posed, and what is told is measured in the world, of the numbers that are written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from capture4d.app.export.skeleton import Skeleton
from capture4d.body.skinning import blend_transforms, skin, unskin
from capture4d.geometry.mesh import angle_weighted_normals, normalised, vertex_normals
from capture4d.learning.principal_directions import exact_directions
from capture4d.mesh_files.animated.moving_mesh import MovingMesh
from capture4d.mesh_files.gltf.animated_scene import SceneTargets

__all__ = ["FitError", "FitLimits", "exact_targets", "fit_targets"]

_AT_ONCE = 2_000_000
"""Coordinates of the frames that are worked on together: 16 MB in float64."""
_LEARNED_FROM = 400
"""Frames, evenly over the take, that directions are learned from; neighbours are alike."""
_BIN_MM, _BINS = 0.001, 100_000


@dataclass(frozen=True, slots=True)
class FitError:
    """How far vertices are from where they should be, over all frames, millimetres."""

    mean_mm: float
    p99_mm: float
    max_mm: float


@dataclass(frozen=True, slots=True)
class FitLimits:
    """How far off vertices may be, millimetres, and what that may cost."""

    p99_mm: float
    """99 of 100 vertices of all frames, and ..."""
    max_mm: float
    """... all of them."""
    most: int
    """Targets, whatever the error."""


class _Tally:
    """Errors as they come, without keeping them; the percentile is right to a thousandth of a millimetre."""

    def __init__(self) -> None:
        self.counts, self.sum, self.count, self.largest = np.zeros(_BINS, np.int64), 0.0, 0, 0.0

    def add(self, difference_m: Float64[np.ndarray, "... 3"]) -> None:
        each = 1000 * np.linalg.norm(difference_m, axis=-1).ravel()
        self.counts += np.bincount(np.minimum(each / _BIN_MM, _BINS - 1).astype(np.int64), minlength=_BINS)
        self.sum, self.count = self.sum + float(each.sum()), self.count + len(each)
        self.largest = max(self.largest, float(each.max(initial=0)))

    def error(self) -> FitError:
        reached = np.cumsum(self.counts) >= 0.99 * self.count
        p99 = min(_BIN_MM * (int(np.argmax(reached)) + 1), self.largest)
        return FitError(self.sum / max(self.count, 1), p99, self.largest)


def exact_targets(moving: MovingMesh) -> tuple[SceneTargets, FitError]:
    """A target for each frame but the first, in the world: what is written is exact, and as long as the take.

    Returns:
        The targets, and what float32 makes of them.
    """
    frames, faces = list(moving.frames()), moving.mesh.faces
    base = frames[0].astype(np.float64)
    base_normals = angle_weighted_normals(base, faces)
    directions = np.array([each - base for each in frames[1:]], np.float32).reshape(-1, *base.shape)
    shading = [vertex_normals(each.astype(np.float64), faces) - base_normals for each in frames[1:]]
    normal_directions = np.array(shading, np.float32).reshape(-1, *base.shape)
    names = [f"frame_{frame_id:06d}" for frame_id in moving.frame_ids[1:].tolist()]
    weights = np.eye(len(frames), dtype=np.float32)[:, 1:]
    single = base.astype(np.float32)
    targets = SceneTargets(single, base_normals.astype(np.float32), directions, normal_directions, weights, names)
    tally = _Tally()
    for each, direction in zip(frames[1:], directions, strict=True):
        tally.add(single.astype(np.float64) + direction - each)
    return targets, tally.error()


def fit_targets(
    moving: MovingMesh,
    skeleton: Skeleton | None,
    scratch: Path,
    limits: FitLimits,
) -> tuple[SceneTargets, FitError]:
    """As few targets as keep an error.

    Args:
        skeleton: None leaves the frames in the world, as those of a garment without a body have to be.
        scratch: file for the frames in the rest pose, which need not fit into memory.
    Returns:
        The targets, and their error in the world.
    """
    rest = _Rest.write(moving, skeleton, scratch)
    mean, directions = rest.directions(limits.most)
    coefficients = np.concatenate([(block - mean) @ directions.T for block in rest.blocks()])

    def is_enough(count: int) -> bool:
        found = rest.error(mean, directions[:count], coefficients[:, :count])
        return found.p99_mm <= limits.p99_mm and found.max_mm <= limits.max_mm

    count = _fewest(is_enough, len(directions))
    base, directions, weights = _between_0_and_1(mean, directions[:count], coefficients[:, :count])
    shape = (count, len(moving.mesh.vertices), 3)
    base = base.reshape(shape[1:])
    base_normals = angle_weighted_normals(base, moving.mesh.faces)
    shading = _normal_directions(moving, skeleton, base_normals, weights)
    targets = SceneTargets(
        base.astype(np.float32),
        base_normals.astype(np.float32),
        directions.reshape(shape).astype(np.float32),
        shading.astype(np.float32),
        weights.astype(np.float32),
        [f"shape_{each:03d}" for each in range(count)],
    )
    return targets, _world_error(moving, skeleton, targets)


def _fewest(is_enough: Callable[[int], bool], most: int) -> int:
    """The least number that is enough, by halving; the most if none is."""
    low, high = 0, most
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if is_enough(middle) else (middle + 1, high)
    return high


def _between_0_and_1(
    mean: Float64[np.ndarray, " columns"],
    directions: Float64[np.ndarray, "shapes columns"],
    coefficients: Float64[np.ndarray, "frames shapes"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Base, directions and weights of the same frames, such that all weights lie between 0 and 1. Each direction points
    where the base has the shorter way to go."""
    turned = np.where(coefficients.max(axis=0) < -coefficients.min(axis=0), -1.0, 1.0)
    directions, coefficients = directions * turned[:, None], coefficients * turned
    low, high = coefficients.min(axis=0), coefficients.max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    return mean + low @ directions, directions * span[:, None], np.clip((coefficients - low) / span, 0, 1)


@dataclass(frozen=True, slots=True, eq=False)
class _Rest:
    """The frames turned back by the skeleton, on disk."""

    path: Path
    frames: int
    columns: int

    @staticmethod
    def write(moving: MovingMesh, skeleton: Skeleton | None, path: Path) -> _Rest:
        with path.open("wb") as file:
            for frame, vertices in enumerate(moving.frames()):
                if skeleton is not None:
                    vertices = unskin(vertices, skeleton.weights, skeleton.transforms(frame))[0]
                file.write(np.ascontiguousarray(vertices, np.float32).tobytes())
        return _Rest(path, len(moving.frame_ids), 3 * len(moving.mesh.vertices))

    def rows(self, start: int, count: int) -> Float64[np.ndarray, "rows columns"]:
        offset = 4 * self.columns * start
        found = np.fromfile(self.path, np.float32, count * self.columns, offset=offset)
        return found.reshape(-1, self.columns).astype(np.float64)

    def blocks(self) -> Iterator[Float64[np.ndarray, "rows columns"]]:
        size = max(1, _AT_ONCE // self.columns)
        for start in range(0, self.frames, size):
            yield self.rows(start, min(size, self.frames - start))

    def directions(self, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Mean and principal directions, learned from frames evenly over the take."""
        chosen = _evenly(self.frames, _LEARNED_FROM)
        learned = np.concatenate([self.rows(int(each), 1) for each in chosen])
        mean = learned.mean(axis=0)
        wanted = min(most, len(chosen) - 1)
        if wanted < 1:
            return mean, np.zeros((0, self.columns))
        found = exact_directions(lambda block: learned[block] - mean, len(learned), self.columns, wanted)[0]
        return mean, found

    def error(self, mean: np.ndarray, directions: np.ndarray, coefficients: np.ndarray) -> FitError:
        tally, start = _Tally(), 0
        for block in self.blocks():
            made = mean + coefficients[start : start + len(block)] @ directions
            tally.add((made - block).reshape(len(block), -1, 3))
            start += len(block)
        return tally.error()


def _evenly(count: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _normal_directions(
    moving: MovingMesh,
    skeleton: Skeleton | None,
    base_normals: Float64[np.ndarray, "verts 3"],
    weights: Float64[np.ndarray, "frames targets"],
) -> Float64[np.ndarray, "targets verts 3"]:
    """What targets add to the normals: least squares over frames evenly over the take, without a constant."""
    chosen, wanted = _evenly(len(weights), _LEARNED_FROM), []
    among = set(chosen.tolist())
    for frame, vertices in enumerate(moving.frames()):
        if frame in among:
            normals = vertex_normals(vertices.astype(np.float64), moving.mesh.faces)
            if skeleton is not None:  # clients turn normals by the blend itself, not by its inverse transposed
                blended = blend_transforms(skeleton.weights, skeleton.transforms(frame))[:, :, :3]
                normals = normalised(np.linalg.solve(blended, normals[..., None])[..., 0])
            wanted.append((normals - base_normals).ravel())
    found = np.linalg.lstsq(weights[chosen], np.array(wanted), rcond=None)[0]
    return found.reshape(weights.shape[1], *base_normals.shape)


def _world_error(moving: MovingMesh, skeleton: Skeleton | None, targets: SceneTargets) -> FitError:
    """Of the numbers as they are written."""
    tally = _Tally()
    flat = targets.directions.reshape(len(targets.directions), targets.base.size)
    for frame, vertices in enumerate(moving.frames()):
        made = targets.base.astype(np.float64) + (targets.weights[frame] @ flat).reshape(targets.base.shape)
        if skeleton is not None:
            made = skin(made, skeleton.weights, skeleton.transforms(frame))
        tally.add(made - vertices)
    return tally.error()
