"""Which pairs of style and shape there are, and which are prototypes or tests.

References: TailorNet (CVPR 2020), sections 4.4 (prototypes), 5.2 (the grid of styles and shapes, test pairs).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise, product
from typing import Literal

import numpy as np
from jaxtyping import Float

from capture4d.errors import InputError
from capture4d.learning.convex_fits import furthest_first
from data_synth.drapes.config import STYLES
from data_synth.styles.config import StyleSetConfig
from data_synth.styles.style_space import LIMIT, StyleSpace

__all__ = ["Pair", "choose_prototypes", "draw_test_pairs", "grid", "offered", "ranges_of", "require_possible"]


@dataclass(frozen=True, slots=True)
class Pair:
    """A style on a person."""

    style: tuple[float, ...]
    """Values of the numbers that vary, in the order of the settings; or components, in standard deviations."""
    shape: tuple[float, ...]
    """In standard deviations."""

    def style_texts(self, config: StyleSetConfig, space: StyleSpace | None = None) -> tuple[str, ...]:
        """Numbers of the pattern, as `synth-drapes` takes them."""
        cut = dict(zip(config.styles, self.style, strict=True)) if space is None else space.cut(self.style)
        return tuple(f"{name}={value!r}" for name, value in cut.items())


def require_possible(config: StyleSetConfig) -> None:
    """
    Raises:
        InputError: a number is not the garment's, or more pairs or poses are asked for than there are.
    """
    known = [each.name for each in fields(STYLES[config.garment])]
    if not config.styles or not config.shapes:
        raise InputError("styles, shapes: expected at least one number that varies and one person, found none")
    for name, values in config.styles.items():
        if name not in known:
            raise InputError(f"styles: expected numbers of a {config.garment}, {', '.join(known)}; found '{name}'")
        if len(values) < 2 or any(first >= second for first, second in pairwise(values)):
            raise InputError(f"styles.{name}: expected two or more ascending values, found {values}")
    if any(config.shapes[0]) or len({len(shape) for shape in config.shapes}) > 1:
        raise InputError("shapes: expected the mean person first, and as many numbers for all, found others")
    tried = len(grid(offered(config)))
    if config.components > len(config.styles):
        raise InputError(f"components: expected at most {len(config.styles)}, the numbers that vary; "
                         f"found {config.components}")  # fmt: skip
    if config.prototypes + config.test_pairs > tried:
        raise InputError(
            f"prototypes, test_pairs: expected at most the {tried} pairs of styles and shapes, "
            f"found {config.prototypes + config.test_pairs}"
        )
    if config.seen_poses > config.poses:
        raise InputError(f"seen_poses: expected at most the {config.poses} poses, found {config.seen_poses}")


def offered(config: StyleSetConfig, names: Sequence[str] | None = None) -> StyleSetConfig:
    """The settings with what is varied in the end: the numbers of the pattern, or components between their limits.

    Args:
        names: of the components; the first are taken.
    """
    if not config.components:
        return config
    levels = tuple(np.linspace(-LIMIT, LIMIT, config.levels).tolist())
    called = names or [f"component-{k}" for k in range(1, config.components + 1)]
    return replace(config, styles=dict.fromkeys(called[: config.components], levels))


def grid(config: StyleSetConfig) -> list[Pair]:
    """All styles on all people: the middle style on the mean person first, then that style on everybody else."""
    middle = tuple(values[(len(values) - 1) // 2] for values in config.styles.values())
    pairs = [Pair(style, shape) for style in product(*config.styles.values()) for shape in config.shapes]
    return sorted(pairs, key=lambda pair: pair.style != middle)


def ranges_of(config: StyleSetConfig) -> tuple[dict[str, tuple[float, float]], list[tuple[float, float]]]:
    """Least and most of each style number, by name, and of each shape component."""
    styles = {name: (values[0], values[-1]) for name, values in config.styles.items()}
    return styles, [(min(values), max(values)) for values in zip(*config.shapes, strict=True)]


def choose_prototypes(
    displacements: Float[np.ndarray, "pairs verts 3"],
    count: int,
    start: Literal["one", "shapes"],
    people: int,
) -> tuple[list[int], list[tuple[float, float]]]:
    """Pairs whose convex combinations come near all others in the A-pose, the first in the pool among them.

    Args:
        displacements: of each pair in the A-pose over the person in it, metres, as `grid` orders them.
        people: number of shapes; the paper begins with one style on all of them.
    Returns:
        Indices in the order of choice; the worst and mean vertex error after each step, metres.
    """
    first = range(min(people, count) if start == "shapes" else 1)

    def distance(one: np.ndarray, other: np.ndarray) -> float:
        return float(np.linalg.norm((one - other).reshape(-1, 3), axis=1).mean())

    return furthest_first(displacements.reshape(len(displacements), -1), [*first], count, distance)


def draw_test_pairs(
    config: StyleSetConfig, pairs: Sequence[Pair], prototypes: Sequence[int], rng: np.random.Generator
) -> tuple[list[int], list[Pair]]:
    """Pairs to test with: indices of some at random that are no prototypes, and others off the grid."""
    free = np.setdiff1d(np.arange(len(pairs)), prototypes)
    chosen = sorted(rng.choice(free, config.test_pairs, replace=False).tolist()) if config.test_pairs else []
    styles, shapes = ranges_of(config)

    def between(limits: Sequence[tuple[float, float]]) -> tuple[float, ...]:
        return tuple(round(float(rng.uniform(*each)), 4) for each in limits)

    return chosen, [Pair(between([*styles.values()]), between(shapes)) for _ in range(config.off_grid)]
