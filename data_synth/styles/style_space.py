"""A space of styles: principal components of garments at rest in the A-pose, and the sewing pattern of each point.

    gamma (K,)  ->  numbers of the pattern  ->  pattern  ->  drape

Patterns are drawn, draped on the mean person and decomposed; then points of that space are drawn, cut, draped and
decomposed again, so that the components are of garments as they lie, not of combinations that nothing holds up. A point
is cut by numbers of the pattern, linear in gamma and regressed on the drapes, kept within the ranges that were drawn
from: every point is a pattern whose seams match. (The paper combines the drapes themselves and has their edges for
lengths at rest.) Components have the name of the pattern's number that goes with them most, and grow with it.

Letters: N garments, V vertices, P numbers of the pattern, K components.

References: TailorNet (CVPR 2020), section 5.1 (two rounds of PCA and simulation).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from capture4d.learning.principal_directions import exact_directions

__all__ = ["LIMIT", "MOST_COMPONENTS", "TERMS", "StyleSpace", "find_space", "subspace_cosines", "two_rounds"]

LIMIT = 1.5
"""Standard deviations of a component that are offered, either way, as in the paper."""
MOST_COMPONENTS = 4
"""That are kept; a set of styles varies the first of them."""
TERMS: Mapping[str, str] = {
    "size": "larger", "ease": "wider", "sleeve_length": "longer_sleeve", "hem_drop_m": "longer", "length": "longer",
    "length_m": "longer", "rise_m": "higher_waist", "hem_width": "wider_hem", "cuff_width": "wider_cuff",
    "flare": "more_flared", "width_m": "broader",
}  # fmt: skip
"""What a garment is of which a number of the pattern is greater."""


@dataclass(frozen=True, slots=True, eq=False)
class StyleSpace:
    """Components of a garment's style."""

    numbers: tuple[str, ...]
    """Numbers of the pattern that vary."""
    ranges: Float64[np.ndarray, "numbers 2"]
    """Least and most of each."""
    names: tuple[str, ...]
    """Of the components."""
    mean: Float64[np.ndarray, "verts 3"]
    """Garment at rest in the A-pose on the mean person, metres."""
    directions: Float64[np.ndarray, "components columns"]
    """Orthonormal, of 3 V numbers."""
    deviations: Float64[np.ndarray, " components"]
    """Metres along a direction in a standard deviation."""
    middle: Float64[np.ndarray, " numbers"]
    """Numbers of the pattern at gamma = 0."""
    slopes: Float64[np.ndarray, "components numbers"]
    """By how much they grow with each component."""
    explained: Float64[np.ndarray, " components"]
    """Share of the garments' variance."""

    def cut(self, gamma: Sequence[float] | Float[np.ndarray, " components"]) -> dict[str, float]:
        """Numbers of the pattern of a style.

        Args:
            gamma: in standard deviations; components left out at the end are 0.
        """
        given = np.asarray(gamma, np.float64)
        found = self.middle + given @ self.slopes[: len(given)]
        return dict(zip(self.numbers, np.clip(found, *self.ranges.T).tolist(), strict=True))

    def scores(self, vertices: Float[np.ndarray, "garments verts 3"]) -> Float64[np.ndarray, "garments components"]:
        """gamma of garments at rest in the A-pose on the mean person, metres."""
        flat = (vertices - self.mean).reshape(len(vertices), -1)
        return flat @ self.directions.T / self.deviations

    def drawn(self, count: int, rng: np.random.Generator) -> Float64[np.ndarray, "garments components"]:
        """Styles at random: normal in each component, none beyond the limit."""
        return np.clip(rng.standard_normal((count, len(self.names))), -LIMIT, LIMIT)


def two_rounds(
    numbers: Mapping[str, tuple[float, float]],
    count: int,
    rng: np.random.Generator,
    drape: Callable[[Sequence[Mapping[str, float]]], Float[np.ndarray, "garments verts 3"]],
) -> tuple[StyleSpace, StyleSpace]:
    """Draw patterns, drape and decompose; draw styles of what was found, drape and decompose again.

    Args:
        numbers: least and most of each number of the pattern, by name; drawn evenly between.
        count: garments in a round.
        drape: brings garments of some patterns to rest in the A-pose on the mean person, metres; called twice.
    Returns:
        What the first round found, and the second, which counts.
    """
    low, high = np.array([*numbers.values()], np.float64).T
    patterns = low + (high - low) * rng.random((count, len(low)))
    cuts = [dict(zip(numbers, row.tolist(), strict=True)) for row in patterns]
    first = find_space(numbers, patterns, drape(cuts))
    cuts = [first.cut(gamma) for gamma in first.drawn(count, rng)]
    patterns = np.array([[*cut.values()] for cut in cuts])
    return first, find_space(numbers, patterns, drape(cuts))


def find_space(
    numbers: Mapping[str, tuple[float, float]],
    patterns: Float[np.ndarray, "garments numbers"],
    vertices: Float[np.ndarray, "garments verts 3"],
) -> StyleSpace:
    """The components of some garments: at most four, and no more than numbers vary.

    Args:
        numbers: least and most of each number of the pattern, by name.
        patterns: these numbers of each garment.
        vertices: each at rest in the A-pose on the mean person, metres.
    """
    mean = vertices.mean(axis=0, dtype=np.float64)
    flat = vertices.reshape(len(vertices), -1) - mean.reshape(-1)
    wanted = min(MOST_COMPONENTS, len(numbers))
    directions, values = exact_directions(lambda block: flat[block], len(flat), flat.shape[1], wanted)
    deviations = values / np.sqrt(len(flat))
    scores = flat @ directions.T / deviations
    given = np.asarray(patterns, np.float64)
    coefficients = np.linalg.lstsq(np.column_stack([np.ones(len(scores)), scores]), given, rcond=None)[0]
    alike = _correlations(scores, given)
    names, signs = _named(list(numbers), alike)
    return StyleSpace(
        numbers=tuple(numbers),
        ranges=np.array([*numbers.values()], np.float64),
        names=names,
        mean=mean,
        directions=directions * signs[:, None],
        deviations=deviations,
        middle=coefficients[0],
        slopes=coefficients[1:] * signs[:, None],
        explained=values**2 / float((flat**2).sum()),
    )


def _correlations(scores: np.ndarray, patterns: np.ndarray) -> np.ndarray:
    """Of each component with each number, (K, P)."""
    ours, theirs = scores - scores.mean(axis=0), patterns - patterns.mean(axis=0)
    sizes = np.linalg.norm(ours, axis=0)[:, None] * np.linalg.norm(theirs, axis=0)
    return ours.T @ theirs / np.maximum(sizes, 1e-12)


def _named(numbers: list[str], alike: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
    """Names of the components, each after another number, and the signs that make them grow with it."""
    names, signs, free = [], [], np.ones(len(numbers), bool)
    for row in alike:
        chosen = int(np.argmax(np.where(free, np.abs(row), -1.0)))
        free[chosen] = False
        names.append(TERMS.get(numbers[chosen], f"more_{numbers[chosen]}"))
        signs.append(-1.0 if row[chosen] < 0 else 1.0)
    return tuple(names), np.array(signs)


def subspace_cosines(
    ours: Float[np.ndarray, "components columns"], theirs: Float[np.ndarray, "components columns"]
) -> Float64[np.ndarray, " components"]:
    """Cosines of the principal angles between the spans of orthonormal rows, the greatest first."""
    return np.clip(np.linalg.svd(ours @ theirs.T, compute_uv=False), 0.0, 1.0)
