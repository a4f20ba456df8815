"""Settings of style sets. Standard library only, so that the command line can list their names at once."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Literal

from capture4d.settings import Count, Number, Range, Seed, Whole, settings
from data_synth.config import Vertices
from data_synth.drapes.config import GarmentName, PoseConfig, SolverConfig

__all__ = ["STYLE_SETS", "StyleSetConfig"]


@settings
class StyleSetConfig:
    """Drapes of one garment in many styles on many people: prototypes in many poses, and test pairs."""

    garment: GarmentName = "trousers"
    """What is draped."""
    styles: dict[str, tuple[Number, ...]] = field(
        default_factory=lambda: {"length": (0.45, 0.9), "hem_width": (0.6, 1.0)}
    )
    """Values of each number of the pattern that varies, ascending; all combinations are tried. With `components`, only
    the least and the most count."""
    components: Annotated[int, Range(least=0, most=4)] = 0
    """Principal components of the garments in the A-pose that are the numbers of a style instead; 0 for the pattern's
    own."""
    drawn: Annotated[int, Range(least=6)] = 40
    """Garments in each of the two rounds in which components are found."""
    levels: Annotated[int, Range(least=2)] = 5
    """Values of each component, evenly from -1.5 to 1.5 standard deviations."""
    shapes: tuple[tuple[Number, ...], ...] = ((0.0, 0.0), (1.0, -1.0), (-1.0, 1.0))
    """People, each by the shape in standard deviations; all wear every style. The first is the mean person."""
    prototypes: Count = 3
    """Pairs of style and shape that are draped in many poses, to learn from."""
    start: Literal["one", "shapes"] = "one"
    """What the choice of prototypes begins with: the middle style on the mean person, or that style on everybody, as in
    the paper, which covers less."""
    poses: Count = 12
    """That each prototype is draped in, to learn from."""
    unseen_poses: Count = 4
    """That all pairs are draped in besides, and nothing is learned from."""
    test_pairs: Whole = 2
    """Pairs drawn at random among those that are no prototypes; nothing is learned from them."""
    off_grid: Whole = 1
    """Test pairs of styles and shapes between those above, drawn at random."""
    seen_poses: Whole = 3
    """Of the test pairs, as many of those that prototypes are learned in."""
    vertices: Vertices = 400
    """Of the garment's mesh."""
    seed: Seed = 0
    """Of poses and test pairs."""
    pose: PoseConfig = field(default_factory=PoseConfig)
    """How poses are drawn."""
    solver: SolverConfig = field(default_factory=SolverConfig)
    """How drapes come to rest."""


_HALVES = (-2.0, -1.0, 1.0, 2.0)
_PAPER_SHAPES = ((0.0, 0.0), *((value, 0.0) for value in _HALVES), *((0.0, value) for value in _HALVES))
"""First and second component at +-1 and +-2, and the mean person, as in the released data."""

STYLE_SETS: dict[str, StyleSetConfig] = {
    "tiny-styles": StyleSetConfig(pose=PoseConfig(hip_flexion=(-10.0, 70.0), knee=(0.0, 100.0))),
    "tshirt-styles": StyleSetConfig(
        garment="tshirt",
        styles={"size": (0.9, 0.96, 1.02, 1.08, 1.15), "sleeve_length": (0.3, 0.48, 0.66, 0.84, 1.02)},
        shapes=_PAPER_SHAPES,
        prototypes=12,
        poses=700,
        unseen_poses=60,
        test_pairs=8,
        off_grid=4,
        seen_poses=20,
        vertices=2500,
    ),
    "tiny-style-space": StyleSetConfig(
        garment="skirt",
        styles={"length_m": (0.35, 0.6), "flare": (1.2, 1.9), "size": (0.97, 1.08)},
        components=2,
        drawn=24,
        levels=3,
        shapes=((0.0, 0.0), (1.0, 0.0)),
        vertices=300,
    ),
    "tshirt-style-space": StyleSetConfig(
        garment="tshirt",
        styles={"size": (0.92, 1.12), "ease": (0.12, 0.35), "sleeve_length": (0.3, 1.02), "hem_drop_m": (0.04, 0.18)},
        components=2,
        shapes=_PAPER_SHAPES,
        prototypes=12,
        poses=700,
        unseen_poses=60,
        test_pairs=8,
        off_grid=4,
        seen_poses=20,
        vertices=2500,
    ),
}
"""`tiny-styles` shows that everything works; `tshirt-styles` is 25 styles on 9 people, as many as the paper has.
`tiny-style-space` and `tshirt-style-space` are likewise, with principal components for numbers of a style."""
