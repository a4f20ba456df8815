"""What a garment with styles is learned from: drapes without their pose, over the person in them.

Letters: V vertices, N drapes of a pair, P numbers of a pair of style and shape, phi.

A drape is unposed with one binding for all pairs, that of the first prototype. Displacements are over `under`: that
prototype's garment moved to the person with the skin under it. The paper's are over the skin itself, `I T(beta)`; the
two differ by the same constant in every pair, which no difference of two displacements sees, and here nothing jumps
where the skin under a sleeve turns from arm to trunk.

References: TailorNet (CVPR 2020), section 4.1 (unposing, equation 5), section 5.3 (the four parts).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int

from capture4d.body.binding import with_body_shape
from capture4d.body.skinning import ShapedBody, skin, unskin, with_pose, with_shape
from capture4d.captures.drapes.style_sets import Ranges, StylePair, StyleSet
from capture4d.errors import InputError
from capture4d.types import Body, Garment

__all__ = ["PARTS", "PairDrapes", "Part", "StyleLesson", "person_under", "style_lesson"]

Part = Literal["train-train", "train-test", "test-train", "test-test"]
"""Pairs that were learned from or not; poses that were learned from or not."""
PARTS: tuple[Part, ...] = ("train-train", "train-test", "test-train", "test-test")


@dataclass(frozen=True, slots=True, eq=False)
class PairDrapes:
    """The good drapes of a pair, unposed."""

    name: str
    test: bool
    """Nothing is learned from the pair."""
    numbers: Float64[np.ndarray, " numbers"]
    """phi, from -1 to 1."""
    person: ShapedBody
    under: Float64[np.ndarray, "verts 3"]
    """What displacements are over, metres."""
    canonical: Float64[np.ndarray, "verts 3"]
    """The drape in the A-pose, which is the rest pose."""
    poses: Int[np.ndarray, " drapes"]
    """Numbers of the poses, the same for all pairs."""
    unseen: Bool[np.ndarray, " drapes"]
    """Poses that nothing is learned from."""
    rotations: Float32[np.ndarray, "drapes joints 3 3"]
    unposed: Float32[np.ndarray, "drapes verts 3"]

    def posed(
        self, unposed: Float[np.ndarray, "drapes verts 3"], skin_weights: Float32[np.ndarray, "verts joints"]
    ) -> Float64[np.ndarray, "drapes verts 3"]:
        """Garments, one for each drape, in the drapes' poses, metres."""
        still = np.zeros(3)
        transforms = [with_pose(self.person, rotations, still).transforms for rotations in self.rotations]
        return np.array(
            [skin(each, skin_weights, moved) for each, moved in zip(unposed, transforms, strict=True)], np.float64
        ).reshape(unposed.shape)


@dataclass(frozen=True, slots=True, eq=False)
class StyleLesson:
    """Pairs to learn from and to test with, and the pool of those at rest in the A-pose."""

    garment: Garment
    """Of the first prototype; its binding is that of all."""
    body: Body
    ranges: Ranges
    pairs: Sequence[PairDrapes]
    pool_numbers: Float64[np.ndarray, "pool numbers"]
    pool: Float64[np.ndarray, "pool verts 3"]
    """Displacements in the A-pose of every pair that is no test pair, metres."""

    @property
    def skin_weights(self) -> Float32[np.ndarray, "verts joints"]:
        assert self.garment.skin_weights is not None
        return self.garment.skin_weights

    @property
    def prototypes(self) -> list[PairDrapes]:
        return [pair for pair in self.pairs if not pair.test]

    def of_part(self, part: Part) -> list[tuple[PairDrapes, Bool[np.ndarray, " drapes"]]]:
        """The pairs that have drapes in a part, and which these are."""
        pairs, poses = part.split("-")
        found = [(each, each.unseen == (poses == "test")) for each in self.pairs if each.test == (pairs == "test")]
        return [(pair, rows) for pair, rows in found if rows.any()]


def person_under(garment: Garment, body: Body, shape: Float[np.ndarray, " shapes"]) -> Float64[np.ndarray, "verts 3"]:
    """What the displacements of a person's garments are over, metres."""
    return with_body_shape(garment, body, shape).template.vertices.astype(np.float64)


def style_lesson(styles: StyleSet) -> StyleLesson:
    """Unpose a style set.

    Raises:
        InputError: a style or shape is outside the ranges that the set states, or its body is posed by more than its
            skeleton.
    """
    first = styles.pairs[0].drapes
    garment, body = first.garment, first.body
    if body.pose_directions is not None:
        raise InputError("body: expected one that its skeleton alone moves, found one with pose correctives")
    assert garment.skin_weights is not None
    known, people = ~styles.canonical.test, styles.canonical.shapes
    under = {tuple(shape): person_under(garment, body, shape.astype(np.float32)) for shape in people[known]}
    names = list(styles.ranges.style)
    numbers = [
        styles.ranges.numbers(dict(zip(names, style.tolist(), strict=True)), shape)
        for style, shape in zip(styles.canonical.styles[known], people[known], strict=True)
    ]
    pool = [
        vertices - under[tuple(shape)]
        for vertices, shape in zip(styles.canonical.vertices[known], people[known], strict=True)
    ]
    pairs = [_unposed(pair, garment, styles) for pair in styles.pairs]
    return StyleLesson(garment, body, styles.ranges, pairs, np.array(numbers), np.array(pool, np.float64))


def _unposed(pair: StylePair, garment: Garment, styles: StyleSet) -> PairDrapes:
    """The good drapes of a pair in the rest pose of the person in them."""
    drapes = pair.drapes
    assert garment.skin_weights is not None
    person, still = with_shape(drapes.body, drapes.shape), np.zeros(3)
    good = np.flatnonzero(drapes.kept)
    unposed = np.empty((len(good), *drapes.vertices.shape[1:]), np.float32)
    for row, drape in enumerate(good):
        transforms = with_pose(person, drapes.rotations[drape], still).transforms
        unposed[row] = unskin(drapes.vertices[drape].astype(np.float64), garment.skin_weights, transforms)[0]
    return PairDrapes(
        name=pair.name,
        test=pair.role == "test",
        numbers=styles.ranges.numbers(pair.style, drapes.shape),
        person=person,
        under=person_under(garment, drapes.body, drapes.shape),
        canonical=pair.canonical.astype(np.float64),
        poses=drapes.numbers[good],
        unseen=drapes.numbers[good] <= styles.unseen_poses,
        rotations=drapes.rotations[good],
        unposed=unposed,
    )
