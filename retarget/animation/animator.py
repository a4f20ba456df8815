"""A learned garment on a motion and a person, frame by frame: arrays in, arrays out.

References: DeepWrinkles (ECCV 2018), sections 3.3 and 3.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from capture4d.body.skinning import ShapedBody, pose_frame
from capture4d.geometry.intersection_removal import ClosedSurface, IntersectionRemoval, Removed
from capture4d.geometry.mesh import unique_edges
from capture4d.types import BlendshapeModel, PoseSequence
from retarget.animation.strain import StrainLimit
from retarget.config import AnimateConfig
from retarget.shapes.blendshapes import reconstruct, skin_frames

__all__ = ["FRAMES_AT_ONCE", "AnimatedFrame", "Animator"]

FRAMES_AT_ONCE = 16
"""More take more memory; another number, too, changes the last bits of matrix products."""


@dataclass(frozen=True, slots=True, eq=False)
class AnimatedFrame:
    """The garment in one frame."""

    vertices: Float32[np.ndarray, "verts 3"]
    """Metres, world."""
    removed: Removed
    stretch_p99: float
    """Edge length over the mean garment's on this person, 99th percentile."""


class Animator:
    """A garment on one person, with everything computed once that frames share.

    Args:
        mean: the garment's mean in that person's rest pose, metres.
        stretch_p99: how far its edges stretched in what it was learned from, `KnownRange.stretch_p99`.
    """

    def __init__(
        self,
        model: BlendshapeModel,
        person: ShapedBody,
        mean: Float64[np.ndarray, "verts 3"],
        config: AnimateConfig,
        *,
        stretch_p99: float = 1.0,
    ) -> None:
        assert model.garment.skin_weights is not None
        self._basis, self._weights = model.basis, model.garment.skin_weights
        self._person, self._mean = person, mean.astype(np.float32)
        faces = model.garment.template.faces
        self._edges = unique_edges(faces)
        self._lengths = self._edge_lengths(mean)
        self._removal = IntersectionRemoval(faces, len(mean), config.removal)
        longest = max(config.longest, stretch_p99) if config.longest else np.inf
        self._limit = StrainLimit(self._edges, self._lengths, len(mean), longest)

    def _edge_lengths(self, vertices: np.ndarray) -> np.ndarray:
        return np.linalg.norm(vertices[self._edges[:, 0]] - vertices[self._edges[:, 1]], axis=1)

    def frames(
        self, poses: PoseSequence, coefficients: Float32[np.ndarray, "frames shapes"], rows: Sequence[int]
    ) -> list[AnimatedFrame]:
        """The garment in some frames of a motion, out of the body."""
        posed = [pose_frame(self._person, poses, row) for row in rows]
        rest = reconstruct(self._mean, self._basis, coefficients[list(rows)])
        placed = skin_frames(rest, self._weights, np.stack([each.transforms for each in posed]))
        faces = self._person.body.template.faces
        found = []
        for vertices, body in zip(placed, posed, strict=True):
            surface = ClosedSurface(body.vertices(), faces)
            removed = self._removal(self._limit(vertices), surface)
            stretch = self._edge_lengths(removed.vertices) / np.maximum(self._lengths, 1e-9)
            found.append(AnimatedFrame(removed.vertices.astype(np.float32), removed, float(np.percentile(stretch, 99))))
        return found
