"""A learned garment on a motion and a person, frame by frame: arrays in, arrays out.

References: DeepWrinkles (ECCV 2018), sections 3.3 and 3.5.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64

from capture4d.body.binding import with_body_shape
from capture4d.body.limbs import WornBody
from capture4d.body.sewing_pattern import rest_lengths, with_known_pattern
from capture4d.body.skinning import ShapedBody, pose_frame
from capture4d.captures.animations.frame_files import AnimatedFrame
from capture4d.geometry.intersection_removal import IntersectionRemoval
from capture4d.geometry.mesh import edge_lengths, edge_stretch, stretch_p99, unique_edges
from capture4d.types import BlendshapeModel, PoseSequence
from retarget.config import AnimateConfig
from retarget.shapes.blendshapes import reconstruct, skin_frames

__all__ = ["Animator"]


class Animator:
    """A garment on one person, with everything computed once that frames share.

    Args:
        mean: the garment's mean in that person's rest pose, metres.
    """

    def __init__(
        self,
        model: BlendshapeModel,
        person: ShapedBody,
        mean: Float64[np.ndarray, "verts 3"],
        config: AnimateConfig,
    ) -> None:
        garment = with_body_shape(model.garment, person.body, np.asarray(person.shape, np.float32))
        assert garment.skin_weights is not None
        self._basis, self._weights = model.basis, garment.skin_weights
        self._person, self._mean = person, mean.astype(np.float32)
        faces = garment.template.faces
        self._edges = unique_edges(faces)
        graded, own = (
            edge_lengths(each.template.vertices.astype(np.float64), self._edges) for each in (garment, model.garment)
        )
        known = rest_lengths(with_known_pattern(model.garment), self._edges)
        self._lengths = graded / np.maximum(own, 1e-12) * known
        # a garment that is tight on the captured person is not drawn into its wearer
        worn = edge_stretch(mean, self._edges, self._lengths)
        longest = np.maximum(config.longest, worn) if config.longest else np.inf
        self._removal = IntersectionRemoval(faces, len(mean), self._lengths, longest, config.removal)
        self._worn = WornBody(person, mean, self._weights)

    def frames(
        self, poses: PoseSequence, coefficients: Float32[np.ndarray, "frames shapes"], rows: Sequence[int]
    ) -> list[AnimatedFrame]:
        """The garment in some frames of a motion, out of the body."""
        posed = [pose_frame(self._person, poses, row) for row in rows]
        rest = reconstruct(self._mean, self._basis, coefficients[list(rows)])
        placed = skin_frames(rest, self._weights, np.stack([each.transforms for each in posed]))
        found = []
        for vertices, body in zip(placed, posed, strict=True):
            removed = self._removal(vertices, self._worn.posed(body.vertices()))
            stretch = stretch_p99(edge_stretch(removed.vertices, self._edges, self._lengths))
            found.append(AnimatedFrame(removed.vertices.astype(np.float32), removed, stretch))
        return found
