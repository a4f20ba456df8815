"""What goes into networks and kernels, and what comes out: numbers of a pose, and coefficients of displacements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Float64
from scipy.spatial.transform import Rotation

from capture4d.learning.principal_directions import exact_directions, randomised_directions
from capture4d.types import Body
from retarget.regression.controls import garment_joints

__all__ = ["Head", "PoseNumbers"]

SPREAD = 0.15
"""Added to a number's deviation: one that hardly varied is not blown up."""
EXACT_NUMBERS = 20_000_000
"""Larger matrices are decomposed by subspace iteration."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseNumbers:
    """How a pose is told: the rotations of the joints that can move the garment, the root not among them."""

    joints: tuple[int, ...]
    kind: Literal["matrices", "axis-angle"]
    mean: Float64[np.ndarray, " numbers"]
    scale: Float64[np.ndarray, " numbers"]

    @staticmethod
    def create(
        body: Body,
        skin_weights: Float[np.ndarray, "verts joints"],
        rotations: Float[np.ndarray, "drapes joints 3 3"],
        *,
        kind: Literal["matrices", "axis-angle"],
        share: float,
        standardised: bool,
    ) -> PoseNumbers:
        """Numbers of the joints that carry a share of the garment or lie above one that does, and that ever turn.

        Args:
            rotations: of the poses to learn from.
        """
        turning = np.abs(rotations - np.eye(3, dtype=rotations.dtype)).max(axis=(0, 2, 3), initial=0.0) > 1e-6
        joints = tuple(j for j in garment_joints(skin_weights, body.parents, share) if turning[j])
        size = len(joints) * (9 if kind == "matrices" else 3)
        plain = PoseNumbers(joints, kind, np.zeros(size), np.ones(size))
        if not standardised or not len(rotations):
            return plain
        found = plain.of(rotations).astype(np.float64)
        return PoseNumbers(joints, kind, found.mean(axis=0), found.std(axis=0) + SPREAD)

    def of(self, rotations: Float[np.ndarray, "drapes joints 3 3"]) -> Float32[np.ndarray, "drapes numbers"]:
        """The numbers of some poses."""
        chosen = rotations[:, list(self.joints)].astype(np.float64)
        if self.kind == "axis-angle":
            chosen = Rotation.from_matrix(chosen.reshape(-1, 3, 3)).as_rotvec()
        flat = chosen.reshape(len(rotations), len(self.mean))
        return ((flat - self.mean) / self.scale).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Head:
    """What a network's outputs mean: displacements themselves, or coefficients of some directions about a mean."""

    mean: Float64[np.ndarray, " columns"]
    """3 V numbers, metres."""
    directions: Float64[np.ndarray, "outputs columns"] | None
    """Orthonormal; None if the outputs are the displacements themselves."""
    scale: float
    """Metres in a unit of the outputs."""

    @property
    def outputs(self) -> int:
        return len(self.mean if self.directions is None else self.directions)

    @staticmethod
    def of_vertices(count: int) -> Head:
        """As the paper has it."""
        return Head(np.zeros(3 * count), None, 1.0)

    @staticmethod
    def of_directions(displacements: Float[np.ndarray, "drapes verts 3"], most: int) -> Head:
        """The principal directions of some drapes, at most so many."""
        flat = displacements.reshape(len(displacements), -1)
        mean = flat.mean(axis=0, dtype=np.float64)

        def rows(block: slice) -> np.ndarray:
            return flat[block] - mean

        if flat.size <= EXACT_NUMBERS:
            directions, values = exact_directions(rows, *flat.shape, most)
        else:
            directions, values = randomised_directions(rows, *flat.shape, most, np.random.default_rng(0))
        spread = float(np.sqrt((values**2).sum() / max(len(flat) * max(len(values), 1), 1)))
        return Head(mean, directions, max(spread, 1e-9))

    def encoded(self, displacements: Float[np.ndarray, "drapes verts 3"]) -> Float32[np.ndarray, "drapes outputs"]:
        flat = displacements.reshape(-1, len(self.mean)) - self.mean
        turned = flat if self.directions is None else flat @ self.directions.T
        return (turned / self.scale).astype(np.float32)

    def decoded(self, outputs: Float[np.ndarray, "drapes outputs"]) -> Float64[np.ndarray, "drapes verts 3"]:
        """Metres."""
        flat = outputs.astype(np.float64) * self.scale
        flat = flat if self.directions is None else flat @ self.directions
        return (self.mean + flat).reshape(len(outputs), -1, 3)
